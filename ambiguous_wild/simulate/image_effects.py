"""Effects of camera and light on a simulated photo, each a pure function with the effect's name.

The function `draw_...` of an effect draws what differs between photos; `spec.Effects` holds the settings, and
`render.py` the order. An effect that the spec does not name is not called.
"""

from __future__ import annotations

import io
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.simulate.kernels import ELLIPSOID
from ambiguous_wild.simulate.shapes import UNSEEN, Shape, vector
from ambiguous_wild.simulate.spec import (
    Defocus,
    ExposureDrift,
    IsoNoise,
    Jpeg,
    MovingShadow,
    TimeOfDay,
    WhiteBalance,
)
from ambiguous_wild.simulate.tracer import Light

_EFFECTS = 1000  # spawn key of effects; world, walk and layout have 0 to 2
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB, ITU-R BT.709
SHOT = 1.2e-4  # variance at full signal and ISO 100: a full well of about 8000 electrons
READ = 5e-4  # standard deviation at ISO 100
_FINE = 9  # subpixels a side that resolve the disc's rim
# Gains of sun, sky and ground light at strength 1; other hours use powers of them, so hour 0 has gain 1.
_MORNING = ((0.45, 0.55, 0.75), (0.80, 0.95, 1.25), (0.80, 0.90, 1.10))  # thin cloud, blue
_EVENING = ((1.25, 0.85, 0.50), (0.85, 0.70, 0.70), (0.95, 0.75, 0.60))  # low and golden
_AWAY_M = 9.0  # distance towards the sun: outside every photo
_TARGET_M = ((-2.4, 2.4), (-1.2, 3.4))  # x and y around which the shadow falls
_LOBES = 4
# Lens distortion, rolling shutter and motion blur share one resampling. The pinhole image is traced larger
# than the photo, and finer by a whole factor; each fine pixel of the photo is looked up in it. All weights
# are non-negative, so a mask resampled with them is positive exactly where masked pixels contribute.
_MAX_BORDER = 2  # greatest border, in longer sides of the photo


@dataclass(frozen=True)
class PhotoRandom:
    """Random numbers of one photo, in independent streams: adding an effect changes no other."""

    seed: int
    number: int  # number of the photo, from 0
    progress: float  # place of the photo in the capture, 0 to 1

    def rng(self, name: str) -> np.random.Generator:
        """Return the generator of one effect for this photo."""
        return _generator(self.seed, name, self.number + 1)

    def phase(self, name: str) -> float:
        """Return a number in [0, 1) for an effect, the same for the whole capture."""
        return float(_generator(self.seed, name, 0).random())

    def drift(self, name: str, cycles: float = 1.5) -> float:
        """Return a value in [-1, 1] that drifts slowly over the capture, with a little jitter."""
        slow = np.sin(2 * np.pi * (cycles * self.progress + self.phase(name)))
        return float(0.8 * slow + 0.2 * self.rng(name).uniform(-1, 1))


def _generator(seed: int, name: str, number: int) -> np.random.Generator:
    key = (_EFFECTS, zlib.crc32(name.encode()), number)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=key))


def draw_exposure_drift(settings: ExposureDrift, random: PhotoRandom) -> float:
    """Draw the exposure error of this photo in stops; positive = brighter."""
    return settings.stops * random.drift("exposure_drift")


def exposure_drift(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    stops: float,
) -> np.ndarray:
    """Multiply the image by 2^stops, without clipping."""
    return image * np.float32(2.0**stops)


def draw_white_balance(settings: WhiteBalance, random: PhotoRandom) -> tuple[float, float, float]:
    """Draw the photo's gains (red, green, blue); white keeps its luminance."""
    warmth = settings.warmth * random.drift("white_balance", cycles=2.3)
    tint = settings.tint * random.drift("white_balance tint", cycles=1.1)
    gains = 2.0 ** np.array([warmth / 2, tint, -warmth / 2])
    r, g, b = (float(v) for v in gains / (gains * _LUMINANCE).sum())
    return r, g, b


def white_balance(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    gains: tuple[float, float, float],
) -> np.ndarray:
    """Multiply each channel by its gain."""
    return image * np.array(gains, np.float32)


def draw_iso_noise(settings: IsoNoise, random: PhotoRandom) -> float:
    """Draw the photo's ISO."""
    return float(random.rng("iso_noise").uniform(*settings.iso))


def normal_noise(random: PhotoRandom, height: int, width: int) -> np.ndarray:
    """Draw standard normal numbers [H, W, 3] float32, the same for a photo and its clean version."""
    return random.rng("iso_noise pattern").standard_normal((height, width, 3), dtype=np.float32)


def iso_noise(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    normal: np.ndarray,  # [H, W, 3] float32, standard normal
    iso: float,
) -> np.ndarray:
    """Add noise of variance `SHOT` gain signal + (`READ` gain)^2, gain = iso / 100.

    Source: the affine noise model of Foi et al. 2008, IEEE TIP 17(10).
    """
    gain = iso / 100.0
    variance = SHOT * gain * np.clip(image, 0.0, None) + (READ * gain) ** 2
    return image + np.sqrt(variance).astype(np.float32) * normal


def vignetting(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    falloff: float,  # share of the light that the corners lack, in [0, 1)
) -> np.ndarray:
    """Multiply the image by (1 + c r^2)^-2, r = 1 in the corners; cos^4 of the angle has this form."""
    height, width = image.shape[:2]
    x = (np.arange(width, dtype=np.float64) + 0.5) / width * 2 - 1
    y = (np.arange(height, dtype=np.float64) + 0.5) / height * 2 - 1
    r2 = ((x[None] * width) ** 2 + (y[:, None] * height) ** 2) / (width**2 + height**2)
    c = (1.0 - falloff) ** -0.5 - 1.0
    return image * ((1.0 + c * r2) ** -2).astype(np.float32)[..., None]


def draw_defocus(settings: Defocus, random: PhotoRandom) -> float:
    """Draw the radius of the blur disc in widths of the photo; 0 = sharp."""
    rng = random.rng("defocus")
    out_of_focus, radius = rng.random() < settings.share, rng.uniform(*settings.radius)
    return float(radius) if out_of_focus else 0.0


def disc_kernel(radius_px: float) -> np.ndarray:
    """Return the point spread function, [K, K] float32, sum 1: a disc with an anti-aliased rim."""
    reach = int(np.ceil(radius_px + 0.5 - 1e-9))
    fine = (np.arange((2 * reach + 1) * _FINE) + 0.5) / _FINE - reach - 0.5
    inside = np.hypot(fine[None], fine[:, None]) <= radius_px
    inside |= np.hypot(fine[None], fine[:, None]) <= 0.5  # never less than a pixel
    kernel = inside.reshape(2 * reach + 1, _FINE, 2 * reach + 1, _FINE).mean((1, 3))
    return np.asarray(kernel / kernel.sum(), np.float32)


def defocus(
    image: np.ndarray,  # [H, W] or [H, W, 3] float32, linear light
    kernel: np.ndarray,  # [K, K] float32
) -> np.ndarray:
    """Convolve the image with the kernel.

    One disc serves all depths, as a focused lens of 4 mm is sharp from 2 m to infinity.
    """
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE))


def draw_jpeg(settings: Jpeg, random: PhotoRandom) -> int:
    """Draw the photo's quality."""
    low, high = settings.quality
    return int(random.rng("jpeg").integers(low, high + 1))


def jpeg(
    pixels: np.ndarray,  # [H, W, 3] uint8, sRGB
    quality: int,  # 1 to 95
) -> np.ndarray:  # [H, W, 3] uint8, sRGB
    """Compress the pixels as JPEG with chroma at half the resolution, and decode them."""
    from PIL import Image

    stored = io.BytesIO()
    Image.fromarray(pixels).save(stored, "JPEG", quality=quality, subsampling=2)
    stored.seek(0)
    return np.array(Image.open(stored).convert("RGB"))


def draw_time_of_day(settings: TimeOfDay, random: PhotoRandom) -> float:
    """Draw the photo's hour: -1 morning, 0 as in the test photos, 1 evening; in random order."""
    return float(random.rng("time_of_day").uniform(-1, 1))


def time_of_day(light: Light, hour: float, strength: float, sweep_deg: float) -> tuple[Light, np.ndarray]:
    """Return the light at `hour`, and the gain [3] of the background sky."""
    ends = _EVENING if hour > 0 else _MORNING
    sun, sky, ground = (np.array(g) ** (abs(hour) * strength) for g in ends)
    turn = np.deg2rad(sweep_deg * hour)
    c, s = np.cos(turn), np.sin(turn)
    about_z = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    lit = replace(
        light,
        sun=(light.sun[:, None] * about_z).sum(-1),
        sun_colour=light.sun_colour * sun,
        sky_colour=light.sky_colour * sky,
        ground_colour=light.ground_colour * ground,
    )
    return lit, sky


def draw_moving_shadow(settings: MovingShadow, random: PhotoRandom) -> tuple[tuple[float, float, float], ...]:
    """Draw the lobes of the shadow on the ground as (x, y, radius), m; none in photos without a shadow."""
    rng = random.rng("moving_shadow")
    if rng.random() >= settings.presence:
        return ()
    middle = np.array([rng.uniform(*span) for span in _TARGET_M])
    lobes = []
    for _ in range(_LOBES):
        x, y = middle + rng.normal(0, 0.9 * settings.size_m, 2)
        lobes.append((float(x), float(y), float(settings.size_m * rng.uniform(0.6, 1.1))))
    return tuple(lobes)


def moving_shadow(
    lobes: tuple[tuple[float, float, float], ...],
    sun: np.ndarray,  # [3] unit, towards the sun
) -> list[Shape]:
    """Make invisible ellipsoids towards the sun whose shadows fall on the lobes.

    The sun is 0.024 rad wide: at this distance the shadow's edge is 0.2 m wide.
    """
    shapes = []
    for x, y, radius in lobes:
        center = np.array([x, y, 0.0]) + _AWAY_M * np.asarray(sun)
        half = (radius, radius, 0.5 * radius)
        shapes.append(Shape(ELLIPSOID, vector(center), half, "stone", owner=UNSEEN))
    return shapes


def specular(
    shapes: Iterable[Shape], textures: tuple[str, ...], strength: float, sharpness: float
) -> list[Shape]:
    """Polish the shapes with the named textures.

    Source: Blinn 1977 for the sun's highlight, Schlick 1994 for the reflection of the sky.
    """
    return [replace(s, gloss=(strength, sharpness)) if s.texture in textures else s for s in shapes]


def lens_distortion(
    points: np.ndarray,  # [..., 2] float64: (u - cx) / fx, (v - cy) / fy of the distorted photo
    k1: float,
    k2: float,
) -> np.ndarray:  # [..., 2] float64, the same of the pinhole camera
    """Undo x_d = x (1 + k1 r^2 + k2 r^4) by Newton's method on the radius.

    Source: COLMAP's RADIAL camera; with k2 = 0 its SIMPLE_RADIAL.
    """
    distorted = np.linalg.norm(points, axis=-1)
    radius = distorted.copy()
    for _ in range(12):
        square = radius * radius  # numpy's fourth power takes ten times as long as two squares
        value = radius * (1 + square * (k1 + k2 * square)) - distorted
        slope = 1 + square * (3 * k1 + 5 * k2 * square)
        radius -= value / np.maximum(slope, 0.05)
    scale = np.divide(radius, distorted, out=np.ones_like(radius), where=distorted > 1e-12)
    return points * scale[..., None]


def camera_angular_velocity(random: PhotoRandom, speed_deg_s: float) -> np.ndarray:
    """Draw the angular velocity in camera axes, [3] rad/s: mostly pitch and yaw, a third of it roll.

    Its length is 0.3 to 1 times `speed_deg_s`. The direction does not depend on the speed, so blur and
    rolling shutter show the same motion.
    """
    rng = random.rng("hand")
    direction = rng.normal(size=3) * (1.0, 1.0, 0.35)
    return np.deg2rad(speed_deg_s) * rng.uniform(0.3, 1.0) * direction / np.linalg.norm(direction, axis=-1)


def camera_rotations(
    velocity: np.ndarray,  # [3] rad/s, camera axes
    seconds: float,  # of the exposure, or of reading all rows
    steps: int,  # instants of the exposure, or rows
) -> np.ndarray:  # [steps, 3] rotation vectors
    """Return the rotation of the camera at `steps` instants, evenly over the time; 0 in its middle.

    Translation is left out: it needs depth and leaves holes. At 5 m, 1 m/s blurs like 11 deg/s.
    """
    instants = (np.arange(steps) + 0.5) / steps - 0.5
    return seconds * instants[:, None] * velocity


def subpixel_points(camera: Camera, fine: int) -> np.ndarray:
    """Return normalised coordinates [H fine, W fine, 2] of the photo's fine pixels."""
    u = ((np.arange(camera.width * fine) + 0.5) / fine - camera.cx) / camera.fx
    v = ((np.arange(camera.height * fine) + 0.5) / fine - camera.cy) / camera.fy
    return np.stack(np.meshgrid(u, v), axis=-1)


def rotated_points(points: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Return the points as seen by the camera before it turned.

    Args:
        points: [H, W, 2] normalised, of the turned camera.
        turns: [H, 3] rotation vector of each row, camera axes.

    Returns:
        [H, W, 2] normalised.
    """
    rays = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1)
    rays = (rays[:, :, None] * Rotation.from_rotvec(turns).as_matrix()[:, None]).sum(-1)
    if not (rays[..., 2] > 0).all():
        raise AwError(
            "the hand's motion turns the edge of the photo behind the camera: raise focal_35mm, or lower "
            "speed_deg_s of motion_blur and rolling_shutter"
        )
    return rays[..., :2] / rays[..., 2:]


def to_pixels(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Convert normalised points to px of the pinhole camera, [..., 2]."""
    return points * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def supersampled_camera(camera: Camera, sources: list[np.ndarray], fine: int) -> tuple[Camera, int]:
    """Return a finer camera that covers all sources, and its border in coarse px."""
    low = min(float(s.min()) for s in sources)
    high = max(float((s - (camera.width, camera.height)).max()) for s in sources)
    border = int(np.ceil(max(-low, high, 0.0))) + 1
    if border > _MAX_BORDER * max(camera.width, camera.height):
        raise AwError(
            f"lens and hand reach {border} px beyond a photo of {camera.width} x {camera.height} px: "
            "raise focal_35mm, or lower lens_distortion or speed_deg_s"
        )
    width, height = camera.width + 2 * border, camera.height + 2 * border
    shifted = replace(camera, width=width, height=height, cx=camera.cx + border, cy=camera.cy + border)
    return shifted.resized(width * fine, height * fine), border


def resample(image: np.ndarray, sources: list[np.ndarray], border: int, fine: int) -> np.ndarray:
    """Resample the photo: average over the sources and over the fine pixels of each pixel.

    Args:
        image: [H', W'] or [H', W', 3] float32 of the enlarged camera.
        sources: [H fine, W fine, 2] px of the pinhole camera, one array per instant of the exposure.
        border: of the enlarged camera, coarse px.
        fine: fine pixels a side of a pixel.
    """
    total: np.ndarray = np.zeros(())
    image = image.astype(np.float64)  # float32 sums differ in their last bit between processors
    for source in sources:
        index = ((source + border) * fine - 0.5).astype(np.float32)
        total = total + cv2.remap(
            image, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    mean = total / len(sources)
    height, width = mean.shape[0] // fine, mean.shape[1] // fine
    blocks = mean.reshape(height, fine, width, fine, *mean.shape[2:])
    return np.asarray(blocks.mean((1, 3)), np.float32)
