"""The courtyard: three brick walls, a statue on a plinth, planters, crates, posters, a sky around it.

World axes: x right, y away from the camera's walk, z up; metres; the ground is z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ambiguous_wild.simulate import textures as tx
from ambiguous_wild.simulate.atlas import Atlas, build_atlas
from ambiguous_wild.simulate.ground_plan import BACK_M, FRONT_M, GROUND_M, HALF_WIDTH_M, WALL_HEIGHT_M
from ambiguous_wild.simulate.kernels import BOX, CYLINDER, DOME, ELLIPSOID, PLANAR, QUAD
from ambiguous_wild.simulate.shapes import SHEET_M, Axes, Shape, between, figure, placed, shape_table, vector
from ambiguous_wild.simulate.spec import WorldSpec
from ambiguous_wild.simulate.things import circle_of, shapes_of_thing
from ambiguous_wild.simulate.tracer import Light, ShapeTable

POSTERS = ("coffee", "rocket", "chelsea", "hubble", "coins", "camera", "retina")

# Textures of objects and distractors; `brick` and `gravel` are those of the walls and the ground.
SHEETS = {
    "stone": tx.stone,
    "foliage": tx.foliage,
    "timber": tx.timber,
    "clay": tx.clay,
    "skin": tx.skin,
    "brick": tx.brick,
    "gravel": tx.gravel,
    "vivid": tx.vivid,
    "cloth": tx.cloth,
}
# With random streams of their own: a sheet that is added changes no bit of other captures.
_LATER_SHEETS = ("cloth",)


@dataclass(frozen=True)
class World:
    """Static shapes, textures and light, and the circles in which no distractor may stand."""

    shapes: tuple[Shape, ...]
    atlas: Atlas
    light: Light
    keep_out: np.ndarray  # [N, 3] float64: x, y, radius in m
    statue: tuple[float, float, float]  # m: foot of the statue

    def table(self) -> ShapeTable:
        """The static shapes for the ray caster."""
        return shape_table(self.shapes, self.atlas)


def _surface(
    center: tuple[float, float, float],
    half: tuple[float, float],
    texture: str,
    axes: Axes,
    casts: bool,
) -> Shape:
    """A quad that the texture covers once."""
    scale = (0.5 / half[0], 0.5 / half[1])
    return Shape(QUAD, center, (*half, 0.0), texture, axes, PLANAR, scale, (0.5, 0.5), casts=casts)


def _box(center: Sequence[float], half: Sequence[float], yaw_deg: float, texture: str, **more: Any) -> Shape:
    shape = Shape(BOX, (0, 0, 0), vector(half), texture, **more)
    return placed([shape], center, yaw_deg)[0]


def _walls(rng: np.random.Generator) -> list[Shape]:
    z = WALL_HEIGHT_M / 2
    depth = (BACK_M - FRONT_M) / 2
    middle = (BACK_M + FRONT_M) / 2
    back = ((1, 0, 0), (0, 0, 1), (0, -1, 0))
    left = ((0, 1, 0), (0, 0, 1), (1, 0, 0))
    right = ((0, -1, 0), (0, 0, 1), (-1, 0, 0))
    shapes = [
        _surface((0, BACK_M, z), (HALF_WIDTH_M, z), "wall_back", back, True),
        _surface((-HALF_WIDTH_M, middle, z), (depth, z), "wall_left", left, True),
        _surface((HALF_WIDTH_M, middle, z), (depth, z), "wall_right", right, True),
        _box((0, BACK_M + 0.1, 2 * z + 0.06), (HALF_WIDTH_M + 0.3, 0.22, 0.06), 0, "stone"),
        _box((-HALF_WIDTH_M - 0.1, middle, 2 * z + 0.06), (0.22, depth, 0.06), 0, "stone", offset=(0.3, 0.1)),
        _box((HALF_WIDTH_M + 0.1, middle, 2 * z + 0.06), (0.22, depth, 0.06), 0, "stone", offset=(0.6, 0.4)),
        _box((-1.9, BACK_M - 0.12, z), (0.28, 0.14, z), 0, "stone", offset=(0.2, 0.7)),  # two pilasters
        _box((2.1, BACK_M - 0.12, z), (0.28, 0.14, z), 0, "stone", offset=(0.8, 0.2)),
        _box((3.85, BACK_M - 0.04, 1.05), (0.55, 0.06, 1.05), 0, "timber"),  # a door
    ]
    posters = [("coffee", -4.0), ("rocket", -0.75), ("chelsea", 0.85)]
    for name, x in posters:
        at = (x + rng.uniform(-0.15, 0.15), BACK_M - 0.02, rng.uniform(1.6, 2.0))
        shapes.append(_poster(name, at, back))
    for side, axes, pair in ((-1, left, ("hubble", "coins")), (1, right, ("camera", "retina"))):
        for name, y in zip(pair, (1.7, -1.1)):
            at = (side * (HALF_WIDTH_M - 0.02), y + rng.uniform(-0.3, 0.3), rng.uniform(1.5, 2.0))
            shapes.append(_poster(name, at, axes))
    return shapes


def _poster(name: str, at: tuple[float, float, float], axes: Axes) -> Shape:
    h, w = tx.photograph(name).shape[:2]
    return _surface(at, (0.55, 0.55 * h / w), f"poster_{name}", axes, False)


def _furniture(rng: np.random.Generator) -> tuple[list[Shape], list[tuple[float, float, float]]]:
    """Planters with bushes, crates, a bench, a stone ball; and their circles on the ground."""
    shapes: list[Shape] = []
    circles: list[tuple[float, float, float]] = []
    for x, y in ((-3.1, 2.6), (3.0, 2.3), (-4.5, -0.6)):
        x, y = x + rng.uniform(-0.25, 0.25), y + rng.uniform(-0.25, 0.25)
        shapes.append(between((x, y, 0), (x, y, 0.55), 0.36, "clay", CYLINDER, offset=tuple(rng.random(2))))
        for _ in range(5):
            at = np.array([x, y, 0.85]) + rng.uniform(-0.24, 0.24, 3) * (1, 1, 0.9)
            size = rng.uniform(0.22, 0.36, 3)
            shapes.append(Shape(ELLIPSOID, vector(at), vector(size), "foliage", offset=tuple(rng.random(2))))
        circles.append((x, y, 0.6))
    crates = ((4.1, 0.3, 0.38), (4.4, 1.0, 0.3), (-4.3, 1.5, 0.34))
    for cx, cy, half in crates:
        x, y, yaw = cx + rng.uniform(-0.15, 0.15), cy + rng.uniform(-0.15, 0.15), rng.uniform(-35, 35)
        shapes.append(_box((x, y, half), (half, half, half), yaw, "timber", offset=tuple(rng.random(2))))
        circles.append((x, y, 1.5 * half))
        if half > 0.35:
            top = (x + 0.04, y, 2 * half + 0.2)
            shapes.append(_box(top, (0.26, 0.2, 0.2), yaw + 25, "timber", offset=tuple(rng.random(2))))
    bx, by, yaw = rng.uniform(-2.4, -2.0), rng.uniform(0.5, 0.9), rng.uniform(-30, -10)
    bench = [
        Shape(BOX, (0, 0, 0.43), (0.75, 0.2, 0.035), "timber"),
        Shape(BOX, (-0.6, 0, 0.2), (0.06, 0.18, 0.2), "stone"),
        Shape(BOX, (0.6, 0, 0.2), (0.06, 0.18, 0.2), "stone", offset=(0.3, 0.5)),
    ]
    shapes += placed(bench, (bx, by, 0), yaw)
    circles.append((bx, by, 0.85))
    sx, sy = rng.uniform(1.9, 2.2), rng.uniform(0.5, 0.8)
    shapes += [
        _box((sx, sy, 0.12), (0.3, 0.3, 0.12), rng.uniform(0, 90), "stone", offset=(0.5, 0.9)),
        Shape(ELLIPSOID, (sx, sy, 0.56), (0.33, 0.33, 0.33), "stone", offset=(0.1, 0.35)),
    ]
    circles.append((sx, sy, 0.45))
    return shapes, circles


def _ambient_occlusion(ground: np.ndarray, circles: Iterable[Sequence[float]], px_per_m: float) -> None:
    """Darken the ground, in place, at the foot of walls and objects; without rays."""
    h, w = ground.shape[:2]
    x = (np.arange(w, dtype=np.float32) + 0.5) / px_per_m - GROUND_M[0] / 2
    y = (np.arange(h, dtype=np.float32) + 0.5) / px_per_m - GROUND_M[1] / 2
    for cx, cy, radius in circles:
        away = np.hypot(x[None] - cx, y[:, None] - cy) - 0.7 * radius
        ground *= (1 - 0.5 * np.exp(-np.maximum(away, 0) / 0.18))[..., None]
    gap = np.minimum(HALF_WIDTH_M - np.abs(x)[None], BACK_M - y[:, None])
    ground *= (1 - 0.45 * np.exp(-np.maximum(gap, 0) / 0.25))[..., None]


def courtyard(
    rng: np.random.Generator, detail_px_per_m: float, samples: int = 4, what: WorldSpec | None = None
) -> World:
    """Build the courtyard; positions and textures vary with the generator.

    Objects that are left out use their random numbers all the same: the others do not change.

    Args:
        rng: source of randomness.
        detail_px_per_m: resolution of the textures, px per m.
        samples: rays a pixel, a square number.
        what: its objects; None: furniture and statue.
    """
    what = WorldSpec() if what is None else what
    d = detail_px_per_m
    depth = BACK_M - FRONT_M
    statue = (float(rng.uniform(-0.15, 0.35)), float(rng.uniform(1.2, 1.5)), 0.95)
    furniture, circles = _furniture(rng)
    if not what.furniture:
        furniture, circles = [], []
    if what.statue:
        circles.append((statue[0], statue[1], 0.65))
    circles += [circle_of(thing) for thing in what.things]
    plinth = [
        Shape(BOX, (0, 0, 0.08), (0.55, 0.55, 0.08), "stone"),
        Shape(BOX, (0, 0, 0.52), (0.4, 0.4, 0.36), "stone", offset=(0.4, 0.2)),
        Shape(BOX, (0, 0, 0.915), (0.46, 0.46, 0.035), "stone", offset=(0.7, 0.6)),
    ]
    yaw = float(rng.uniform(-20, 20))
    ground = tx.gravel_ground(rng, *GROUND_M, d)
    _ambient_occlusion(ground, circles, d)
    later = dict(zip(_LATER_SHEETS, rng.spawn(len(_LATER_SHEETS))))
    textures = {
        "ground": ground,
        "wall_back": tx.brick_wall(rng, 2 * HALF_WIDTH_M, WALL_HEIGHT_M, d),
        "wall_left": tx.brick_wall(rng, depth, WALL_HEIGHT_M, d, (0.27, 0.17, 0.11)),
        "wall_right": tx.brick_wall(rng, depth, WALL_HEIGHT_M, d, (0.32, 0.13, 0.07)),
        "sky": tx.sky(rng),
        **{name: bake(later.get(name, rng), SHEET_M, SHEET_M, 1.8 * d) for name, bake in SHEETS.items()},
        **{f"poster_{name}": tx.poster(name) for name in POSTERS},
    }
    shapes = [
        _surface((0, 0, 0), (GROUND_M[0] / 2, GROUND_M[1] / 2), "ground", Shape.axes, False),
        Shape(ELLIPSOID, (0, 0, -0.5), (26.0, 26.0, 26.0), "sky", mapping=DOME, casts=False),
        *_walls(rng),
        *furniture,
    ]
    if what.statue:
        shapes += placed(plinth, (statue[0], statue[1], 0), yaw)
        shapes += placed(figure("stone", "stone", 0.07, 0.8), statue, yaw)
    shapes += [s for thing in what.things for s in shapes_of_thing(thing)]
    keep_out = np.array(circles, float).reshape(-1, 3)
    return World(tuple(shapes), build_atlas(textures), _light(rng, samples), keep_out, statue)


def _light(rng: np.random.Generator, samples: int) -> Light:
    """An afternoon sun from behind left, 0.024 rad wide, and a blue sky."""
    azimuth, elevation = np.deg2rad(rng.uniform(-150, -120)), np.deg2rad(rng.uniform(44, 54))
    side, spread, sun = math.isqrt(samples), 0.024, []
    for n in range(side * side):
        turn, tilt = spread * ((n % side + 0.5) / side - 0.5), spread * ((n // side + 0.5) / side - 0.5)
        a, e = azimuth + turn, elevation + tilt
        sun.append((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))
    return Light(
        np.array(sun),
        np.array([1.75, 1.6, 1.35]),
        np.array([0.62, 0.70, 0.82]),
        np.array([0.34, 0.31, 0.27]),
    )
