"""Fit a simulator spec whose measured effects match those of a real scene.

What the scene does not show above the simulator's own values is not named in the spec.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import convolve

from ambiguous_wild.builder.screen import BLUR_RATIO, sharpness
from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.harness.effects_plan import (
    APPEARANCE,
    EXPOSURE,
    MIN_SPREAD,
    OF_SHINE,
    OUTWARD,
    SAMPLING,
    Evidence,
    has_tracks,
    measure_evidence,
)
from ambiguous_wild.io.images import load_image_float
from ambiguous_wild.io.motion_points import read_motion_points
from ambiguous_wild.simulate.image_effects import READ, SHOT, PhotoRandom, draw_exposure_drift
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.spec import (
    FULL_FRAME_DIAGONAL_MM,
    CaptureSpec,
    Defocus,
    Effects,
    ExpectedAmbiguity,
    ExposureDrift,
    IsoNoise,
    TimeOfDay,
)
from ambiguous_wild.simulate.spec_file import check_spec
from ambiguous_wild.splat.effects.tracks import BRIGHT, DARK

MAX_PHOTOS = 64  # photos whose noise and blur are measured
LONGEST = 960  # px, longer side of a simulated photo, as in the presets
MOVES = 0.003  # share of features that move: static captures have up to 0.0013, others from 0.0037
# Distractors cover more than the share of features that move: one to eight times it in ten captures.
OCCLUDED = (0.0, 0.1), (0.3, 0.4)  # least and greatest ends of `occlusion`
NOISE = 1.5 / 255  # simulated photos without noise and sharp JPEGs have up to 1.3 codes of texture
BLOCK = 8  # px, side of the blocks of which the smoothest tenth tells the noise
# Response of the simulator, measured on simulated captures: evidence at a setting of 1.
# `exposure` over the standard deviation of the drawn stops: 0.26 to 0.32 in six captures
SPREAD_OF_STOP = 0.28
SPREAD_OF_DAY = 0.036  # `appearance` of time_of_day at strength 1
OWN_SAMPLING = 1.3  # `sampling` without zoom
OF_ZOOM = 0.68  # spread of log `sampling` over that of log zoom: wide photos see more near ground
MISSED = 1.2  # the simulator misses wanted values by up to this factor


@dataclass(frozen=True)
class Likeness:
    """What a spec needs to know of a real capture."""

    name: str
    test: int  # test photos
    size: tuple[int, int]  # width and height of a photo as trained, px
    factor: int  # of the photos as trained
    focal: float  # focal length over the photo's diagonal
    arc_deg: float  # that the axes of the cameras cover
    evidence: Evidence  # also the number of train photos
    noise: float  # standard deviation in the photos as trained, of the colour range; 0: none in the full ones
    soft: float  # share of the train photos that are blurred
    # share of features that move, of photos: 10th percentile, mean, 90th; or NaN
    moving: tuple[float, float, float]


@dataclass(frozen=True)
class FittedSpec:
    """The spec, the factor to build it with, and a line for each property: measured, taken."""

    spec: CaptureSpec
    factor: int
    lines: tuple[str, ...]


def measure_likeness(scene: Scene) -> Likeness:
    """Measure a scene; its photos are read.

    Raises:
        AwError: the scene has no tracks, or a photo cannot be read.
    """
    if not has_tracks(scene):
        raise AwError(
            f"{scene.root}: the sparse model has too few tracks to measure colours; build the scene from "
            "its photos with 'aw build-scene'"
        )
    step = max(-(-len(scene.train) // MAX_PHOTOS), 1)
    noises, smaller, sharp = [], [], []
    for view in scene.train[::step]:
        photo = load_image_float(_full_size(scene, view))
        smaller.append(view.camera.width / photo.shape[1])
        noises.append(noise_of(photo))
        sharp.append(sharpness(np.round(255 * photo).astype(np.uint8)))
    cameras = [view.camera for view in scene.train]
    sizes = Counter((camera.width, camera.height) for camera in cameras)
    points = read_motion_points(scene.root).values()
    shares = [float(p.moves.mean()) for p in points if len(p.xy)]
    low, high = np.percentile(shares, [10, 90]) if shares else (math.nan, math.nan)
    noise = float(np.nanmedian(noises)) if np.isfinite(noises).any() else 0.0
    return Likeness(
        name=scene.name,
        test=len(scene.test),
        size=sizes.most_common(1)[0][0],
        factor=int(scene.info.get("loaded_factor", 1)),
        focal=float(np.median([0.5 * (c.fx + c.fy) / math.hypot(c.width, c.height) for c in cameras])),
        arc_deg=arc_of(np.array([camera.cam_from_world[2, :3] for camera in cameras])),
        evidence=measure_evidence(scene, (load_image_float(view.image_path) for view in scene.train)),
        noise=noise * float(np.median(smaller)) if noise >= NOISE else 0.0,
        soft=float(np.mean(np.array(sharp) < BLUR_RATIO * np.median(sharp))),
        moving=(float(low), float(np.mean(shares)) if shares else math.nan, float(high)),
    )


def spec_like(of: Likeness, width: int | None = None, seed: int = 0, views: int | None = None) -> FittedSpec:
    """Return the spec of a capture that calls for the effects of `of`.

    Args:
        of: the real capture.
        width: of the simulated photos, px; None: as the real ones, with a longer side of at most `LONGEST`.
        seed: of the capture; what its photos draw must spread as in the real ones.
        views: number of train photos; None: as many as the real ones.

    Raises:
        AwError: a size or number of photos that no spec may have.
    """
    seen = of.evidence
    outward = seen.outward > OUTWARD
    factor = min(of.factor, LONGEST // max(of.size)) if width is None else round(width / of.size[0])
    factor = max(factor, 1)
    wide = of.size[0] * factor if width is None else width
    high = max(round(wide * of.size[1] / of.size[0]), 1)
    focal_mm = float(np.clip(of.focal * FULL_FRAME_DIAGONAL_MM, 12, 150))
    arc_deg = float(np.clip(of.arc_deg, 20, 360 if outward else 125))
    zoom = _zoom(_clear(seen.sampling, SAMPLING))
    plain = preset("courtyard-plain")
    base = replace(preset("yard"), distractors=plain.distractors) if outward else plain
    in_focal = float(np.hypot(wide, high)) * focal_mm / FULL_FRAME_DIAGONAL_MM
    least, mean, most = of.moving
    least, most = np.clip((least, most), *OCCLUDED).tolist() if mean >= MOVES else (0.0, 0.0)
    spec = replace(
        base,
        name=re.sub(r"[^\w-]", "-", of.name) or "scene",
        summary=f"a capture that calls for the effects of {of.name}",
        distractors=base.distractors if most else (),
        occlusion=(round(least, 3), round(most, 3)),
        train_views=seen.photos,
        test_views=max(of.test, 1),
        width=wide,
        height=high,
        detail_px_per_m=float(np.clip(round(in_focal * zoom[1] / 6), 20, 220)),
        focal_35mm=round(focal_mm, 1),
        arc_deg=round(arc_deg),
        zoom=zoom,
        effects=_effects(of, factor, seed, views or seen.photos),
        designed=ExpectedAmbiguity(),
    )
    spec = resized(check_spec(spec), views)
    return FittedSpec(spec, factor, tuple(_lines(of, spec, factor)))


def _effects(of: Likeness, factor: int, seed: int, views: int) -> Effects:
    seen = of.evidence
    shine = 0.0 if math.isnan(seen.view_dependence) else OF_SHINE * seen.view_dependence
    by_place = _clear(seen.appearance - shine, APPEARANCE)
    day = by_place if by_place >= APPEARANCE else 0.0  # False for NaN
    strength = min(day / SPREAD_OF_DAY, 2.0)
    count = max(views, 3)
    drawn = [PhotoRandom(seed, k, k / (count - 1)) for k in range(count)]
    spread = SPREAD_OF_STOP * np.std([draw_exposure_drift(ExposureDrift(1.0), r) for r in drawn], ddof=1)
    stops = (
        float(_clear(seen.exposure, EXPOSURE) / spread) if seen.exposure >= MIN_SPREAD and not day else 0.0
    )
    iso = _iso(of.noise * factor) if of.noise else 0.0
    return Effects(
        time_of_day=TimeOfDay(strength=round(strength, 2)) if strength else None,
        exposure_drift=ExposureDrift(round(min(stops, 3.0), 2)) if stops else None,
        iso_noise=IsoNoise((0.8 * iso, 1.2 * iso)) if iso else None,
        defocus=Defocus(share=round(of.soft, 2)) if of.soft else None,
    )


def arc_of(directions: np.ndarray) -> float:
    """Return the arc in degrees over which unit vectors [N, 3] are spread, from the length of their mean.

    Directions spread evenly over an arc a have a mean of length sin(a / 2) / (a / 2).
    """
    arcs = np.linspace(0, 2 * np.pi, 721)
    lengths = np.sinc(arcs / (2 * np.pi))  # falls from 1 to 0
    length = float(np.linalg.norm(directions.mean(axis=0)))
    return float(np.rad2deg(np.interp(-length, -lengths, arcs)))


def noise_of(photo: np.ndarray) -> float:
    """Return the standard deviation of the noise of a photo [H, W, 3] in [0, 1]; NaN: no block can be used.

    It is that of the smoothest tenth of its blocks, so it holds a little texture too. The mask is blind to
    planes. Source: Immerkaer 1996, Computer Vision and Image Understanding 64(2).
    """
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)[..., None] / 6
    squares = convolve(photo.astype(np.float32), mask) ** 2
    height, width = (side // BLOCK * BLOCK for side in photo.shape[:2])
    shape = (height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3)
    blocks = photo[:height, :width].reshape(shape)
    usable = (blocks.min((1, 3, 4)) > DARK) & (blocks.max((1, 3, 4)) < BRIGHT)
    if not usable.any():
        return math.nan
    return float(np.sqrt(np.percentile(squares[:height, :width].reshape(shape).mean((1, 3, 4))[usable], 10)))


def _iso(noise: float) -> float:
    """Return the ISO at which `iso_noise` has this standard deviation, of the colour range, in mid grey."""
    grey = 0.2  # linear light
    slope = 1.055 / 2.4 * grey ** (1 / 2.4 - 1)  # of the sRGB curve
    a, b, c = READ**2, SHOT * grey, -((noise / slope) ** 2)
    return float(np.clip(100 * (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a), 50, 20_000))


def _clear(value: float, limit: float) -> float:
    """Return the value, so far from its limit that the twin's is on the same side; NaN stays NaN."""
    return max(value, limit * MISSED) if value >= limit else min(value, limit / MISSED)


def _zoom(sampling: float) -> tuple[float, float]:
    """Return the range of zooms that adds what the walk lacks of the ratio between pixel sizes.

    Spreads of logarithms add up in squares.
    """
    if math.isnan(sampling) or sampling <= OWN_SAMPLING:
        return 1.0, 1.0
    spread = math.sqrt(math.log(sampling) ** 2 - math.log(OWN_SAMPLING) ** 2) / OF_ZOOM
    half = math.exp(min(spread, math.log(8)) / 2)
    low = max(1 / half, 0.5)
    return round(low, 2), round(min(low * half**2, 4.0), 2)


def _lines(of: Likeness, spec: CaptureSpec, factor: int) -> Iterator[str]:
    """Yield for each property what was measured and what the spec takes."""
    seen, effects = of.evidence, spec.effects

    def line(what: str, value: float, unit: str, taken: object) -> str:
        measured = "not measured" if math.isnan(value) else f"{value:.3g} {unit}".rstrip()
        return f"{what}: {measured} -> {taken}"

    def settings(name: str) -> str:
        chosen = getattr(effects, name)
        return f"no {name}" if chosen is None else f"{name} {to_plain(chosen)}"

    size = "{}x{}".format(*of.size)
    taken = f"{spec.train_views} and {spec.test_views}, factor {factor}"
    yield f"photos: {seen.photos} train and {of.test} test of {size} px -> {taken}"
    yield f"focal length: {of.focal:.2f} of the diagonal -> focal_35mm {spec.focal_35mm:g}"
    yield line(
        "places looked at over cameras", seen.outward, "times", f"walk {spec.walk}, {spec.world.place}"
    )
    yield line("arc of the directions", of.arc_deg, "degrees", f"arc_deg {spec.arc_deg:g}")
    yield line("pixel size", seen.sampling, "times", f"zoom {list(spec.zoom)}")
    yield line("gains", seen.exposure, "of the colour range", settings("exposure_drift"))
    yield line("spread at a point", seen.appearance, "of the colour range", settings("time_of_day"))
    yield line("colour by direction", seen.view_dependence, "of the colour range", "not simulated")
    yield line("noise", 255 * of.noise, "codes of 255 as trained", settings("iso_noise"))
    yield line("blurred photos", of.soft, "of all", settings("defocus"))
    taken = f"occlusion {list(spec.occlusion)}" if spec.distractors else "no distractors"
    yield line("features that move", of.moving[1], "of all", taken)


def _full_size(scene: Scene, view: View) -> Path:
    """Return the file of a photo before it was made smaller, if the scene has it."""
    path = scene.root / "images" / view.name
    return path if path.is_file() else view.image_path
