"""The courtyard: three brick walls, a statue on a plinth, planters, crates, posters, a sky around it.

World axes: x right, y away from the camera's walk, z up; metres; the ground is z = 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambiguous_wild.simulate import textures as tx
from ambiguous_wild.simulate.tracer import BOX, BY_FACE, CAPSULE, CYLINDER, DOME, ELLIPSOID, PLANAR, QUAD
from ambiguous_wild.simulate.tracer import Light, ShapeTable

GROUND_M = (16.0, 14.0)
WALL_HEIGHT_M = 3.4
HALF_WIDTH_M, BACK_M, FRONT_M = 5.6, 4.2, -6.0  # side walls at x = +-5.6, back wall at y = 4.2
SHEET_M = 2.0  # side of the square that an object's texture covers before it mirrors


# What objects are made of and distractors may wear; `brick` and `gravel` are the walls' and the ground's own.
SHEETS = {
    "stone": tx.stone,
    "foliage": tx.foliage,
    "timber": tx.timber,
    "clay": tx.clay,
    "skin": tx.skin,
    "brick": tx.brick,
    "gravel": tx.gravel,
    "vivid": tx.vivid,
}


@dataclass(frozen=True)
class Shape:
    """One primitive; `axes` columns are its local axes in the world."""

    kind: int
    center: tuple[float, float, float]  # m
    half: tuple[float, float, float]  # m
    texture: str
    axes: tuple[tuple[float, float, float], ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))  # rows: local axes in the world
    mapping: int = BY_FACE
    scale: tuple[float, float] = (1.0 / SHEET_M, 1.0 / SHEET_M)  # texture sizes a metre
    offset: tuple[float, float] = (0.0, 0.0)
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    casts: bool = True
    owner: int = 0


@dataclass(frozen=True)
class World:
    """What stands still, what it is painted with, how it is lit, and where no distractor may stand."""

    shapes: tuple[Shape, ...]
    atlas: tx.Atlas
    light: Light
    keep_out: np.ndarray  # [N, 3] float64: x, y, radius in m
    statue: tuple[float, float, float]  # m: where the statue's feet are

    def table(self) -> ShapeTable:
        """The static shapes, ready to be traced."""
        return shape_table(self.shapes, self.atlas)


def bounding_radius(kind: int, half: Sequence[float]) -> float:
    """Radius of the sphere around the shape's centre that holds it, m."""
    if kind == QUAD:
        return float(np.hypot(half[0], half[1]))
    if kind == ELLIPSOID:
        return float(max(half))
    if kind == CAPSULE:
        return float(half[0] + half[2])
    if kind == CYLINDER:
        return float(np.hypot(half[0], half[2]))
    return float(np.linalg.norm(half))


def shape_table(shapes: Iterable[Shape], atlas: tx.Atlas) -> ShapeTable:
    """Shapes as the columns that the ray caster reads; an empty list gives an empty table."""
    listed = list(shapes)
    count = len(listed)
    return ShapeTable(
        kind=np.array([s.kind for s in listed], np.int32),
        rotation=np.array([s.axes for s in listed], np.float64).reshape(count, 3, 3),
        center=np.array([s.center for s in listed], np.float64).reshape(count, 3),
        half=np.array([s.half for s in listed], np.float64).reshape(count, 3),
        radius=np.array([bounding_radius(s.kind, s.half) + 1e-6 for s in listed], np.float64),
        texture=np.array([atlas.index[s.texture] for s in listed], np.int32),
        mapping=np.array([s.mapping for s in listed], np.int32),
        uv=np.array([(*s.scale, *s.offset) for s in listed], np.float64).reshape(count, 4),
        tint=np.array([s.tint for s in listed], np.float64).reshape(count, 3),
        casts=np.array([s.casts for s in listed], np.bool_),
        owner=np.array([s.owner for s in listed], np.int32),
    )


def between(
    start: Sequence[float], end: Sequence[float], radius: float, texture: str, kind: int = CAPSULE, **more: object
) -> Shape:
    """A capsule (or cylinder) from one point to another."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    z = (b - a) / np.linalg.norm(b - a)
    x = np.cross((0.0, 1.0, 0.0) if abs(z[1]) < 0.9 else (1.0, 0.0, 0.0), z)
    x /= np.linalg.norm(x)
    axes = tuple(tuple(float(v) for v in row) for row in (x, np.cross(z, x), z))
    middle = tuple(float(v) for v in (a + b) / 2)
    half = (radius, radius, float(np.linalg.norm(b - a)) / 2)
    return Shape(kind, middle, half, texture, axes, **more)  # type: ignore[arg-type]


def placed(shapes: Iterable[Shape], at: Sequence[float], yaw_deg: float, size: float = 1.0) -> list[Shape]:
    """The shapes turned about z, scaled and moved to `at`; their texture goes with them."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = []
    for shape in shapes:
        center = size * (turn @ np.asarray(shape.center)) + np.asarray(at, float)
        axes = np.asarray(shape.axes) @ turn.T
        moved.append(
            replace(
                shape,
                center=tuple(float(v) for v in center),
                half=tuple(float(size * v) for v in shape.half),
                axes=tuple(tuple(float(v) for v in row) for row in axes),
            )
        )
    return moved


def figure(body: str, head: str, stride: float = 0.1, lift: float = 0.0, tint: float = 1.0) -> list[Shape]:
    """A standing person, 1.75 m, facing -y, feet at the origin.

    Args:
        body: texture of clothes and limbs.
        head: texture of head and hands.
        stride: half the distance between the feet, m.
        lift: how far the right arm is raised, 0 (hanging) to 1 (pointing forward).
        tint: brightness of the legs against the coat.
    """
    legs = {"tint": (tint, tint, tint)}
    hand = (0.32, -0.12 - 0.42 * lift, 0.82 + 0.5 * lift)
    elbow = (0.34, -0.02 - 0.15 * lift, 1.12)
    return [
        between((-0.1, 0, 0.85), (-0.11, -stride, 0.09), 0.085, body, **legs),
        between((0.1, 0, 0.85), (0.11, stride, 0.09), 0.085, body, **legs),
        Shape(ELLIPSOID, (-0.11, -stride - 0.06, 0.06), (0.065, 0.15, 0.065), body, tint=(tint * 0.7,) * 3),
        Shape(ELLIPSOID, (0.11, stride - 0.06, 0.06), (0.065, 0.15, 0.065), body, tint=(tint * 0.7,) * 3),
        Shape(ELLIPSOID, (0, 0, 0.86), (0.23, 0.18, 0.34), body, offset=(0.31, 0.17)),
        Shape(ELLIPSOID, (0, 0, 1.2), (0.235, 0.155, 0.32), body),
        between((-0.2, 0, 1.4), (0.2, 0, 1.4), 0.085, body),
        between((-0.26, 0, 1.38), (-0.33, 0.03, 1.1), 0.068, body, offset=(0.4, 0.1)),
        between((-0.33, 0.03, 1.1), (-0.3, -0.1, 0.84), 0.06, body, offset=(0.1, 0.3)),
        between((0.26, 0, 1.38), elbow, 0.068, body, offset=(0.2, 0.6)),
        between(elbow, hand, 0.06, body, offset=(0.5, 0.4)),
        Shape(ELLIPSOID, hand, (0.055, 0.055, 0.07), head),
        Shape(ELLIPSOID, (-0.3, -0.11, 0.79), (0.05, 0.055, 0.07), head),
        between((0, 0, 1.4), (0, -0.01, 1.55), 0.06, head),
        Shape(ELLIPSOID, (0, -0.02, 1.635), (0.093, 0.112, 0.13), head, offset=(0.2, 0.45)),
        Shape(ELLIPSOID, (0, 0.015, 1.665), (0.102, 0.112, 0.115), body, tint=(0.35 * tint,) * 3),
    ]


def _surface(
    center: tuple[float, float, float],
    half: tuple[float, float],
    texture: str,
    axes: tuple[tuple[float, float, float], ...],
    casts: bool,
) -> Shape:
    """A quad that its texture covers exactly once."""
    scale = (0.5 / half[0], 0.5 / half[1])
    return Shape(QUAD, center, (*half, 0.0), texture, axes, PLANAR, scale, (0.5, 0.5), casts=casts)


def _box(center: Sequence[float], half: Sequence[float], yaw_deg: float, texture: str, **more: object) -> Shape:
    shape = Shape(BOX, (0, 0, 0), tuple(half), texture, **more)  # type: ignore[arg-type]
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
        shapes.append(_poster(name, (x + rng.uniform(-0.15, 0.15), BACK_M - 0.02, rng.uniform(1.6, 2.0)), back))
    for name, y in (("hubble", 1.6), ("coins", -1.4)):
        shapes.append(_poster(name, (-HALF_WIDTH_M + 0.02, y + rng.uniform(-0.3, 0.3), rng.uniform(1.5, 2.0)), left))
    for name, y in (("camera", 1.8), ("retina", -0.9)):
        shapes.append(_poster(name, (HALF_WIDTH_M - 0.02, y + rng.uniform(-0.3, 0.3), rng.uniform(1.5, 2.0)), right))
    return shapes


def _poster(name: str, at: tuple[float, float, float], axes: tuple[tuple[float, float, float], ...]) -> Shape:
    h, w = tx.photograph(name).shape[:2]
    return _surface(at, (0.55, 0.55 * h / w), f"poster_{name}", axes, False)


def _furniture(rng: np.random.Generator) -> tuple[list[Shape], list[tuple[float, float, float]]]:
    """Planters with bushes, crates, a bench, a stone ball; with the circles that they stand on."""
    shapes: list[Shape] = []
    circles: list[tuple[float, float, float]] = []
    for x, y in ((-3.1, 2.6), (3.0, 2.3), (-4.5, -0.6)):
        x, y = x + rng.uniform(-0.25, 0.25), y + rng.uniform(-0.25, 0.25)
        shapes.append(between((x, y, 0), (x, y, 0.55), 0.36, "clay", CYLINDER, offset=tuple(rng.random(2))))
        for _ in range(5):
            at = np.array([x, y, 0.85]) + rng.uniform(-0.24, 0.24, 3) * (1, 1, 0.9)
            half = rng.uniform(0.22, 0.36, 3)
            shapes.append(Shape(ELLIPSOID, tuple(at), tuple(half), "foliage", offset=tuple(rng.random(2))))
        circles.append((x, y, 0.6))
    crates = ((4.1, 0.3, 0.38), (4.4, 1.0, 0.3), (-4.3, 1.5, 0.34))
    for x, y, half in crates:
        x, y, yaw = x + rng.uniform(-0.15, 0.15), y + rng.uniform(-0.15, 0.15), rng.uniform(-35, 35)
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


def _ambient_occlusion(ground: np.ndarray, circles: Iterable[tuple[float, float, float]], px_per_m: float) -> None:
    """Darken the ground in place where it meets walls and things: contact, without a ray."""
    h, w = ground.shape[:2]
    x = (np.arange(w, dtype=np.float32) + 0.5) / px_per_m - GROUND_M[0] / 2
    y = (np.arange(h, dtype=np.float32) + 0.5) / px_per_m - GROUND_M[1] / 2
    for cx, cy, radius in circles:
        away = np.hypot(x[None] - cx, y[:, None] - cy) - 0.7 * radius
        ground *= (1 - 0.5 * np.exp(-np.maximum(away, 0) / 0.18))[..., None]
    gap = np.minimum(HALF_WIDTH_M - np.abs(x)[None], BACK_M - y[:, None])
    ground *= (1 - 0.45 * np.exp(-np.maximum(gap, 0) / 0.25))[..., None]


def courtyard(rng: np.random.Generator, detail_px_per_m: float, samples: int = 4) -> World:
    """Build the courtyard; the generator moves and repaints it moderately.

    Args:
        rng: where the seed enters.
        detail_px_per_m: resolution of the textures, px a metre.
        samples: rays a pixel, a square number.
    """
    d = detail_px_per_m
    depth = BACK_M - FRONT_M
    statue = (float(rng.uniform(-0.15, 0.35)), float(rng.uniform(1.2, 1.5)), 0.95)
    furniture, circles = _furniture(rng)
    circles.append((statue[0], statue[1], 0.65))
    plinth = [
        Shape(BOX, (0, 0, 0.08), (0.55, 0.55, 0.08), "stone"),
        Shape(BOX, (0, 0, 0.52), (0.4, 0.4, 0.36), "stone", offset=(0.4, 0.2)),
        Shape(BOX, (0, 0, 0.915), (0.46, 0.46, 0.035), "stone", offset=(0.7, 0.6)),
    ]
    yaw = float(rng.uniform(-20, 20))
    ground = tx.gravel_ground(rng, *GROUND_M, d)
    _ambient_occlusion(ground, circles, d)
    textures = {
        "ground": ground,
        "wall_back": tx.brick_wall(rng, 2 * HALF_WIDTH_M, WALL_HEIGHT_M, d),
        "wall_left": tx.brick_wall(rng, depth, WALL_HEIGHT_M, d, (0.27, 0.17, 0.11)),
        "wall_right": tx.brick_wall(rng, depth, WALL_HEIGHT_M, d, (0.32, 0.13, 0.07)),
        "sky": tx.sky(rng),
        **{name: bake(rng, SHEET_M, SHEET_M, 1.8 * d) for name, bake in SHEETS.items()},
        **{f"poster_{n}": tx.poster(n) for n in ("coffee", "rocket", "chelsea", "hubble", "coins", "camera", "retina")},
    }
    shapes = [
        _surface((0, 0, 0), (GROUND_M[0] / 2, GROUND_M[1] / 2), "ground", ((1, 0, 0), (0, 1, 0), (0, 0, 1)), False),
        Shape(ELLIPSOID, (0, 0, -0.5), (26.0, 26.0, 26.0), "sky", mapping=DOME, casts=False),
        *_walls(rng),
        *furniture,
        *placed(plinth, (statue[0], statue[1], 0), yaw),
        *placed(figure("stone", "stone", 0.07, 0.8), statue, yaw),
    ]
    keep_out = np.array(circles)
    return World(tuple(shapes), tx.build_atlas(textures), _light(rng, samples), keep_out, statue)


def _light(rng: np.random.Generator, samples: int) -> Light:
    """An afternoon sun from behind the walk's left, 0.024 rad wide, and a blue sky."""
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
