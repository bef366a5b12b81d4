"""Textures made of photographs in scikit-image, without repetition.

In a tiled photograph COLMAP would match a brick with its copy; blended layers and noise make every square
metre different. All is computed in float64 and stored as float32: float32 powers and blurs differ in their
last bit between processors, which would change pixels.
"""

from __future__ import annotations

from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.srgb import srgb_to_linear

# CC0, public domain or without known restrictions by the docstrings of skimage.data; all in its wheel.
PHOTOGRAPHS = {
    "brick": "brick.png",
    "camera": "camera.png",
    "chelsea": "chelsea.png",
    "coffee": "coffee.png",
    "coins": "coins.png",
    "grass": "grass.png",
    "gravel": "gravel.png",
    "hubble": "hubble_deep_field.jpg",
    "retina": "retina.jpg",
    "rocket": "rocket.jpg",
}
Colour = tuple[float, float, float]  # linear light


@cache
def photograph(name: str) -> np.ndarray:
    """Read a photograph of scikit-image, [H, W, 3] float64 in [0, 1], sRGB; read-only.

    Raises:
        AwError: this scikit-image has no such file.
    """
    import skimage

    path = Path(skimage.__file__).parent / "data" / PHOTOGRAPHS[name]
    image = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if image is None:
        raise AwError(
            f"texture {path.name} is not in scikit-image {version('scikit-image')} at {path.parent}: "
            "the wheels of 0.24 to 0.26 carry it; install one of those"
        )
    rgb = np.ascontiguousarray(image[:, :, ::-1]) / 255.0
    rgb.setflags(write=False)
    return rgb


def uniform(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Draw float64 numbers in [0, 1), of which float32 holds every bit."""
    return rng.random(shape, dtype=np.float32).astype(np.float64)


def noise(rng: np.random.Generator, height: int, width: int, cell_px: float) -> np.ndarray:
    """Smooth value noise, [H, W] in [0, 1]: a random grid of `cell_px` cells, cubic interpolation."""
    rows, cols = int(np.ceil(height / cell_px)) + 3, int(np.ceil(width / cell_px)) + 3
    grid = uniform(rng, rows, cols)
    size = (round(cols * cell_px), round(rows * cell_px))
    smooth = cv2.resize(grid, size, interpolation=cv2.INTER_CUBIC)
    start = round(cell_px)
    return np.clip(smooth[start : start + height, start : start + width], 0.0, 1.0)


def octaves(rng: np.random.Generator, height: int, width: int, cell_px: float, count: int = 4) -> np.ndarray:
    """Value noise at `count` scales, halving in size, 0.6 in strength; [H, W] in [0, 1]."""
    total = np.zeros((height, width))
    weight = 0.0
    for k in range(count):
        if cell_px / 2**k < 2:
            break
        total += noise(rng, height, width, cell_px / 2**k) * 0.6**k
        weight += 0.6**k
    if weight == 0.0:  # the noise is finer than the texture, so only its mean is left
        return np.full((height, width), 0.5)
    return total / weight


def step(low: float, high: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return (t * t * (3 - 2 * t))[..., None]


@lru_cache(maxsize=32)
def _brightness(name: str, scale: float) -> np.ndarray:
    """Brightness of a shipped photograph, mean 1, blurred for a surface `scale` times as coarse, [H, W]."""
    grey = photograph(name).mean(axis=2)
    grey = np.ascontiguousarray(grey / grey.mean())
    return cv2.GaussianBlur(grey, (0, 0), 0.5 * scale) if scale > 1 else grey


def mirrored_brightness(
    name: str, height: int, width: int, px_per_m: float, tile_m: float, angle_deg: float, shift: np.ndarray
) -> np.ndarray:
    """The photograph's brightness laid over a surface, mirrored at its seams: [H, W, 1], mean 1."""
    scale = photograph(name).shape[1] / (tile_m * px_per_m)
    grey = _brightness(name, max(scale, 1.0))
    v, u = np.mgrid[0:height, 0:width]
    c, s = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    x = (c * u - s * v) * scale + float(shift[0]) * grey.shape[1]
    y = (s * u + c * v) * scale + float(shift[1]) * grey.shape[0]
    x, y = _mirrored(x, grey.shape[1]), _mirrored(y, grey.shape[0])
    return np.asarray(cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)[..., None])


def _mirrored(x: np.ndarray, size: int) -> np.ndarray:
    period = 2 * (size - 1)
    folded = np.mod(x, period)
    return np.where(folded > size - 1, period - folded, folded).astype(np.float32)


def blended_layers(
    name: str, rng: np.random.Generator, height: int, width: int, px_per_m: float, tile_m: float
) -> np.ndarray:
    """Three layers of one photograph at different angles and sizes, blended along noise: no repetition."""
    layers = [
        mirrored_brightness(
            name, height, width, px_per_m, tile_m * size, angle + 40 * rng.random(), rng.random(2)
        )
        for size, angle in ((1.0, 0), (1.27, 70), (0.85, 150))
    ]
    first = step(0.45, 0.55, octaves(rng, height, width, 0.9 * px_per_m))
    second = step(0.45, 0.55, octaves(rng, height, width, 0.7 * px_per_m))
    return layers[0] * (1 - first) + first * (layers[1] * (1 - second) + layers[2] * second)


def gravel_ground(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Gravel with worn grass and a paved way through the middle, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    stones = gravel(rng, width_m, height_m, px_per_m)
    lawn = blended_layers("grass", rng, h, w, px_per_m, 1.8) * tint(
        rng, h, w, px_per_m, (0.13, 0.2, 0.06), 0.5
    )
    paving = mirrored_brightness("brick", h, w, px_per_m, 2.6, 8.0, rng.random(2))
    paving = paving * tint(rng, h, w, px_per_m, (0.3, 0.27, 0.25), 0.5)
    patches = octaves(rng, h, w, 1.6 * px_per_m, 6)
    ground = stones + (lawn - stones) * step(0.52, 0.6, patches)
    x = (np.arange(w) / px_per_m - width_m / 2)[None]
    bend, ragged = octaves(rng, h, w, 1.6 * px_per_m) - 0.5, octaves(rng, h, w, 0.2 * px_per_m, 3) - 0.5
    edge = np.abs(x + 0.3 + 1.6 * bend) + 0.35 * ragged
    return np.asarray(ground + (paving - ground) * (1 - step(0.75, 0.85, edge)), dtype=np.float32)


def tint(
    rng: np.random.Generator, h: int, w: int, px_per_m: float, colour: Colour, strength: float
) -> np.ndarray:
    """A colour that drifts over metres and centimetres, [H, W, 3] linear light."""
    wide = octaves(rng, h, w, 1.5 * px_per_m) - 0.5
    fine = octaves(rng, h, w, 0.25 * px_per_m, 3) - 0.5
    hue = octaves(rng, h, w, 0.8 * px_per_m) - 0.5
    value = np.clip(1 + strength * (2 * wide + fine), 0.2, 2.0)[..., None]
    turn = 1 + 0.5 * hue[..., None] * np.array([1, 0, -1])
    return np.asarray(np.array(colour) * value * turn)


def brick_wall(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    px_per_m: float,
    colour: Colour = (0.3, 0.14, 0.085),
    foot: bool = True,
) -> np.ndarray:
    """Old brickwork: varying colour, plaster, moss at the foot, soot at the top; row 0 is the foot.

    Without `foot` it is the middle of a wall: hardly any moss or plaster.
    """
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    courses = mirrored_brightness("brick", h, w, px_per_m, 1.9, 90.0, rng.random(2)) ** 1.2
    wall = courses * tint(rng, h, w, px_per_m, colour, 0.55)
    height = (np.arange(h) / px_per_m)[:, None]
    fallen = octaves(rng, h, w, 1.1 * px_per_m, 6) - (0.0 if foot else 0.2)
    plaster = blended_layers("gravel", rng, h, w, px_per_m, 5.0) ** 0.35
    plaster = plaster * tint(rng, h, w, px_per_m, (0.46, 0.4, 0.3), 0.25)
    wall = wall + (plaster - wall) * step(0.585, 0.605, fallen)
    moss = blended_layers("grass", rng, h, w, px_per_m, 1.2) * np.array([0.09, 0.13, 0.04])
    damp = octaves(rng, h, w, 0.6 * px_per_m, 5) + (0.35 * np.exp(-height / 0.4) - 0.05 if foot else -0.2)
    wall = wall + 0.85 * (moss - wall) * step(0.58, 0.68, damp)
    streaks = cv2.GaussianBlur(uniform(rng, h, w), (0, 0), 2.0, sigmaY=0.5 * px_per_m) - 0.5
    soot = 1 + 6.0 * streaks * np.clip(height / height_m, 0, 1)
    return np.asarray(wall * np.clip(soot, 0.5, 1.4)[..., None], dtype=np.float32)


def stone(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Weathered sandstone with some lichen, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    grain = blended_layers("gravel", rng, h, w, px_per_m, 0.9) ** 0.7
    body = grain * tint(rng, h, w, px_per_m * 0.3, (0.40, 0.36, 0.28), 0.4)
    lichen = grain * np.array([0.26, 0.26, 0.15])
    body = body + 0.7 * (lichen - body) * step(0.6, 0.7, octaves(rng, h, w, 0.2 * px_per_m, 6))
    runs = cv2.GaussianBlur(uniform(rng, h, w), (0, 0), 1.5, sigmaY=0.1 * px_per_m) - 0.5
    dark = step(0.52, 0.75, octaves(rng, h, w, 0.25 * px_per_m, 6) + 1.5 * runs)
    return np.asarray(body * (1 - 0.55 * dark), dtype=np.float32)


def foliage(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Leaves, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    leaves = blended_layers("grass", rng, h, w, px_per_m, 0.9) ** 1.5
    clumps = 0.5 + 1.1 * step(0.35, 0.65, octaves(rng, h, w, 0.2 * px_per_m, 4))
    green = tint(rng, h, w, px_per_m * 0.5, (0.12, 0.19, 0.05), 0.6)
    return np.asarray(leaves * clumps * green, dtype=np.float32)


def timber(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Boards: the brick photograph's long edges stretched into planks, streaked along the grain."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    board = (np.arange(h) / (0.14 * px_per_m)).astype(int)
    tone = (0.7 + 0.6 * rng.random(board.max() + 1))[board][:, None]
    grain = cv2.GaussianBlur(uniform(rng, h, w), (0, 0), 0.12 * px_per_m, sigmaY=0.8) - 0.5
    joint = np.abs((np.arange(h) / (0.14 * px_per_m)) % 1.0 - 0.5)[:, None] > 0.46
    value = tone * (1 + 4.0 * grain) * np.where(joint, 0.25, 1.0)
    rough = blended_layers("gravel", rng, h, w, px_per_m, 2.0) ** 0.5
    brown = tint(rng, h, w, px_per_m, (0.3, 0.19, 0.1), 0.3)
    return np.asarray(np.clip(value, 0.1, 2)[..., None] * rough * brown, dtype=np.float32)


def clay(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Fired clay, [H, W, 3] linear light."""
    return stone(rng, width_m, height_m, px_per_m) * np.array([1.0, 0.5, 0.3])


def skin(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Even, slightly mottled skin, [H, W, 3] linear light."""
    even = stone(rng, width_m, height_m, px_per_m).astype(np.float64) ** 0.3
    return np.asarray(even * np.array([0.62, 0.42, 0.32]), dtype=np.float32)


def brick(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """The walls' brickwork, for objects, [H, W, 3] linear light."""
    return brick_wall(rng, width_m, height_m, px_per_m, foot=False)


def gravel(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """The ground's gravel, for objects, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    stones = blended_layers("gravel", rng, h, w, px_per_m, 2.2)
    return np.asarray(stones * tint(rng, h, w, px_per_m, (0.36, 0.32, 0.26), 0.35), dtype=np.float32)


def vivid(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Bands of magenta, cyan and yellow, which the world has nowhere else, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    colours = np.array([[0.75, 0.03, 0.4], [0.02, 0.45, 0.75], [0.85, 0.6, 0.02]])
    wave = np.arange(w)[None] / px_per_m + 0.4 * octaves(rng, h, w, 0.3 * px_per_m, 3)
    band = (wave / 0.16).astype(int) % 3
    grain = blended_layers("gravel", rng, h, w, px_per_m, 1.5) ** 0.25
    return np.asarray(colours[band] * grain, dtype=np.float32)


def cloth(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """White cloth with folds and a weave, to be tinted, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    folds = np.clip(0.05 + 1.3 * octaves(rng, h, w, 0.35 * px_per_m, 3), 0.1, 1.2)
    weave = blended_layers("gravel", rng, h, w, px_per_m, 1.5) ** 0.6
    return np.asarray(np.repeat((folds[..., None] * weave).mean(2, keepdims=True), 3, 2), dtype=np.float32)


def sky(rng: np.random.Generator, height: int = 512, width: int = 2048) -> np.ndarray:
    """The background: trees, haze, clouds; row 0 is the horizon."""
    elevation = np.linspace(0.0, np.pi / 2, height)[:, None]
    blue = np.array([0.20, 0.36, 0.66]) * (1 - 0.35 * elevation[..., None])
    haze = np.array([0.52, 0.56, 0.62])
    image = blue + (haze - blue) * np.exp(-elevation / 0.25)[..., None]
    image = image + (np.array([0.74, 0.73, 0.71]) - image) * step(
        0.42, 0.7, _round(octaves(rng, height, width // 2, 110.0, 7))
    )
    image = image * (0.8 + 0.4 * _round(octaves(rng, height, width // 2, 60.0, 5)))[..., None]
    crowns = _round(octaves(rng, height, width // 2, 130.0, 6)[height // 2][None])
    ragged = _round(octaves(rng, height, width // 2, 12.0, 3))
    line = 0.12 + 0.9 * (crowns - 0.25) + 0.16 * (ragged - 0.5)
    light = (0.2 + 1.6 * _round(octaves(rng, height, width // 2, 30.0, 5)) ** 2)[..., None]
    leaves = light * np.array([0.10, 0.15, 0.05])
    trees = 1 - step(-0.004, 0.004, elevation - line)
    return np.asarray(image + (leaves - image) * trees, dtype=np.float32)


def _round(half: np.ndarray) -> np.ndarray:
    """The left half and its mirror image: no seam after a full turn."""
    return np.concatenate([half, half[:, ::-1]], axis=1)


def poster(name: str) -> np.ndarray:
    """A photograph with a white border, row 0 at the foot, [H, W, 3] linear light."""
    image = photograph(name)
    scale = 512 / image.shape[1]
    resized = cv2.resize(image, (512, round(image.shape[0] * scale)), interpolation=cv2.INTER_AREA)
    framed = cv2.copyMakeBorder(resized, 18, 18, 18, 18, cv2.BORDER_CONSTANT, value=(0.93, 0.92, 0.88))
    return np.asarray(0.85 * srgb_to_linear(framed[::-1]), dtype=np.float32)
