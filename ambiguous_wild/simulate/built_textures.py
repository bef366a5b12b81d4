"""Textures of rooms and streets: paint, parquet, rugs, facades, asphalt. Nothing repeats."""

from __future__ import annotations

import cv2
import numpy as np

from ambiguous_wild.simulate.textures import (
    Colour,
    blended_layers,
    mirrored_brightness,
    octaves,
    step,
    tint,
    uniform,
)

PAINT: Colour = (0.52, 0.47, 0.38)  # colour of the room's walls


def plaster(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """The room's painted plaster, for objects, [H, W, 3] linear light."""
    return painted_wall(rng, width_m, height_m, px_per_m)


def painted_wall(
    rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float, colour: Colour = PAINT
) -> np.ndarray:
    """Painted plaster: nearly plain, with faint trowel marks, stains and a few hairline cracks."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    wall = tint(rng, h, w, px_per_m, colour, 0.12)
    wall = wall * blended_layers("gravel", rng, h, w, px_per_m, 3.0) ** 0.12
    ridges = np.abs(octaves(rng, h, w, 0.9 * px_per_m, 6) - 0.5)
    wall = wall * (1 - 0.35 * (1 - step(0.002, 0.008, ridges)) * step(0.5, 0.6, octaves(rng, h, w, px_per_m)))
    stains = step(0.62, 0.8, octaves(rng, h, w, 0.7 * px_per_m, 5))
    return np.asarray(wall * (1 - 0.18 * stains), dtype=np.float32)


def enamel(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Light car paint with dust and scratches, to be tinted, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    dust = 0.75 + 0.3 * octaves(rng, h, w, 0.5 * px_per_m, 5)
    scratches = cv2.GaussianBlur(uniform(rng, h, w), (0, 0), 0.1 * px_per_m, sigmaY=0.7)
    return np.asarray(np.repeat((dust * (0.9 + 0.8 * (scratches - 0.5)))[..., None], 3, 2), dtype=np.float32)


def asphalt(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Patched asphalt, [H, W, 3] linear light."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    grain = blended_layers("gravel", rng, h, w, px_per_m, 1.3) ** 0.8
    road = grain * tint(rng, h, w, px_per_m, (0.10, 0.10, 0.105), 0.4)
    patch = step(0.57, 0.585, octaves(rng, h, w, 1.3 * px_per_m, 3))
    road = road * (1 - 0.45 * patch)
    cracks = 1 - step(0.004, 0.014, np.abs(octaves(rng, h, w, 0.8 * px_per_m, 6) - 0.5))
    return np.asarray(road * (1 - 0.6 * cracks), dtype=np.float32)


def yard_ground(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Asphalt with parking lines, a paved walk along the walls, grass in the joints."""
    road = asphalt(rng, width_m, height_m, px_per_m)
    h, w = road.shape[:2]
    x = ((np.arange(w) + 0.5) / px_per_m - width_m / 2)[None]
    y = ((np.arange(h) + 0.5) / px_per_m - height_m / 2)[:, None]
    paving = mirrored_brightness("brick", h, w, px_per_m, 2.4, 3.0, rng.random(2))
    paving = paving * tint(rng, h, w, px_per_m, (0.3, 0.28, 0.25), 0.4)
    edge = np.maximum(np.abs(x) - (width_m / 2 - 2.6), np.abs(y) - (height_m / 2 - 2.4))
    ragged = 0.12 * (octaves(rng, h, w, 0.3 * px_per_m, 3) - 0.5)
    ground = road + (paving - road) * step(0.0, 0.02, edge + ragged)
    kerb = np.exp(-(((edge - 0.06) / 0.05) ** 2))[..., None]
    ground = ground + (np.array([0.4, 0.39, 0.36]) - ground) * 0.8 * np.minimum(kerb, 1)
    worn = octaves(rng, h, w, 0.15 * px_per_m, 3)
    for at in np.arange(-width_m / 2 + 3.2, width_m / 2 - 3.0, 2.7):
        line = (np.abs(x - at) < 0.06) & (np.abs(y) > height_m / 2 - 6.6) & (np.abs(y) < height_m / 2 - 2.6)
        white = (line * (0.4 + 0.6 * (worn > 0.45)))[..., None]
        ground = ground + (0.62 - ground) * 0.85 * white
    weeds = step(0.6, 0.68, octaves(rng, h, w, 0.5 * px_per_m, 6) + 0.12 * np.exp(-np.abs(edge) / 0.2))
    grass = blended_layers("grass", rng, h, w, px_per_m, 1.2) * np.array([0.1, 0.15, 0.045])
    return np.asarray(ground + 0.9 * (grass - ground) * weeds, dtype=np.float32)


def parquet(rng: np.random.Generator, width_m: float, height_m: float, px_per_m: float) -> np.ndarray:
    """Planks of varying colour along x, with knots and joints."""
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    plank = ((np.arange(h) + 0.5) / (0.11 * px_per_m)).astype(int)
    shift = rng.uniform(0, 1.3, plank.max() + 1)[plank][:, None]
    along = ((np.arange(w)[None] + 0.5) / px_per_m + shift) / 1.3
    board = plank[:, None] * 97 + along.astype(int)
    tone = (0.55 + 0.75 * rng.random(board.max() + 1))[board]
    joint = ((along % 1.0) < 0.012 / 1.3) | (((np.arange(h) + 0.5) / (0.11 * px_per_m) % 1.0) < 0.07)[:, None]
    grain = cv2.GaussianBlur(uniform(rng, h, w), (0, 0), 0.2 * px_per_m, sigmaY=0.6) - 0.5
    value = tone * (1 + 3.0 * grain) * np.where(joint, 0.3, 1.0)
    brown = tint(rng, h, w, px_per_m, (0.34, 0.2, 0.1), 0.25)
    return np.asarray(np.clip(value, 0.05, 2.5)[..., None] * brown, dtype=np.float32)


def rug(rng: np.random.Generator, height: int = 512, width: int = 768) -> np.ndarray:
    """A woven rug: stripes, diamonds that differ, a fringe; [H, W, 3] linear light."""
    y, x = np.mgrid[0:height, 0:width]
    colours = np.array(
        [[0.34, 0.05, 0.04], [0.05, 0.07, 0.16], [0.55, 0.42, 0.24], [0.12, 0.2, 0.16], [0.5, 0.18, 0.05]],
        np.float32,
    )
    row, column = (y // 64).astype(int), (x // 64).astype(int)
    pick = rng.integers(0, 5, (height // 64 + 1, width // 64 + 1, 2))
    inner = np.abs(x % 64 - 32) + np.abs(y % 64 - 32) < 14 + 14 * uniform(rng, height, 1)
    image = np.where(inner[..., None], colours[pick[row, column, 0]], colours[pick[row, column, 1]])
    border = np.minimum(np.minimum(x, width - 1 - x), np.minimum(y, height - 1 - y))
    image = np.where((border < 26)[..., None], colours[2], image)
    image = np.where((np.abs(border - 34) < 7)[..., None], colours[0], image)
    weave = 0.75 + 0.5 * uniform(rng, height, width, 1)
    return np.asarray(image * weave * (0.7 + 0.6 * octaves(rng, height, width, 90.0))[..., None], np.float32)


def muted(rng: np.random.Generator) -> np.ndarray:
    """A colour of cloth or paper: half of its strength is grey, [3] float32 linear light."""
    colour = rng.uniform(0.02, 0.9, 3) * rng.uniform(0.35, 1.0)
    return np.asarray(0.55 * colour.mean() + 0.45 * colour, dtype=np.float32)


def facade(
    rng: np.random.Generator,
    width_m: float,
    height_m: float,
    px_per_m: float,
    colour: Colour,
    storey_m: float = 2.45,
) -> np.ndarray:
    """A rendered house front: a brick foot, window rows that differ in curtains and blinds, doors, downpipes.

    Row 0 is the foot. [H, W, 3] linear light.
    """
    h, w = round(height_m * px_per_m), round(width_m * px_per_m)
    wall = tint(rng, h, w, px_per_m, colour, 0.35) * blended_layers("gravel", rng, h, w, px_per_m, 4.0) ** 0.3
    fallen = step(0.62, 0.635, octaves(rng, h, w, 1.2 * px_per_m, 6))
    courses = mirrored_brightness("brick", h, w, px_per_m, 1.9, 90.0, rng.random(2)) ** 1.2
    brick = courses * tint(rng, h, w, px_per_m, (0.3, 0.14, 0.085), 0.5)
    foot = step(0.0, 0.02, 0.8 - np.arange(h)[:, None] / px_per_m)
    wall = wall + (brick - wall) * np.maximum(fallen, foot)
    streaks = cv2.GaussianBlur(uniform(rng, h, w), (0, 0), 2.0, sigmaY=0.6 * px_per_m) - 0.5
    wall = wall * np.clip(1 + 5.0 * streaks, 0.6, 1.3)[..., None]

    def fill(x0: float, x1: float, y0: float, y1: float, paint: np.ndarray | Colour) -> None:
        a, b, c, d = (round(v * px_per_m) for v in (x0, x1, y0, y1))
        rows, columns = slice(max(c, 0), max(d, 0)), slice(max(a, 0), max(b, 0))
        wall[rows, columns] = np.asarray(paint, np.float32)

    def hue() -> np.ndarray:
        return muted(rng) * np.float32(0.8)

    x = rng.uniform(0.6, 1.1)
    while x + 1.5 < width_m:
        wide = rng.uniform(0.95, 1.35)
        for storey in range(int(height_m / storey_m)):
            base = storey * storey_m
            if storey == 0 and rng.random() < 0.3:  # a door
                fill(x - 0.1, x + wide + 0.1, 0.0, 2.35, (0.35, 0.33, 0.3))
                fill(x, x + wide, 0.0, 2.25, 0.6 * hue())
                fill(x + 0.15, x + wide - 0.15, 1.3, 2.05, (0.05, 0.06, 0.07))
                continue
            low, high = base + 0.95 + rng.uniform(-0.06, 0.06), base + 2.25
            fill(x - 0.1, x + wide + 0.1, low - 0.1, high + 0.1, (0.5, 0.48, 0.43))
            fill(x - 0.14, x + wide + 0.14, low - 0.17, low - 0.06, (0.3, 0.28, 0.25))
            fill(x, x + wide, low, high, np.array([0.05, 0.065, 0.08]) * rng.uniform(0.6, 1.8))
            curtain = hue()
            for side in (0.0, 0.62 + 0.2 * rng.random()):
                fill(x + side * wide, x + (side + rng.uniform(0.12, 0.35)) * wide, low, high, curtain)
            fill(x, x + wide, high - rng.uniform(0.0, 0.8), high, 0.8 * hue())  # a blind
            fill(x + wide / 2 - 0.03, x + wide / 2 + 0.03, low, high, (0.55, 0.54, 0.5))
            fill(x, x + wide, low + 1.0, low + 1.05, (0.55, 0.54, 0.5))
        if rng.random() < 0.35:  # a downpipe
            at = x + wide + rng.uniform(0.25, 0.35)
            fill(at, at + 0.09, 0.0, height_m, (0.16, 0.17, 0.16))
        x += wide + rng.uniform(0.7, 1.3)
    return np.asarray(wall, dtype=np.float32)
