"""The courtyard: three brick walls, a statue on a plinth, planters, crates, posters, a sky around it."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate import textures as tx
from ambiguous_wild.simulate.kernels import CYLINDER, ELLIPSOID
from ambiguous_wild.simulate.shapes import Shape, capsule_between, figure, transformed, vector
from ambiguous_wild.simulate.spec import PLANS, WorldSpec
from ambiguous_wild.simulate.world import (
    WALL_AXES,
    World,
    baked_sheets,
    box,
    object_shapes,
    poster,
    sunlight,
    surface,
    world_of,
)

PLAN = PLANS["courtyard"]
HALF_WIDTH_M, BACK_M, FRONT_M, WALL_HEIGHT_M = PLAN.x_m[1], PLAN.y_m[1], PLAN.y_m[0], PLAN.wall_m


def _walls(rng: np.random.Generator) -> list[Shape]:
    z = WALL_HEIGHT_M / 2
    depth = (BACK_M - FRONT_M) / 2
    middle = (BACK_M + FRONT_M) / 2
    back, left, right = (WALL_AXES[name] for name in PLAN.walls)
    shapes = [
        surface((0, BACK_M, z), (HALF_WIDTH_M, z), "wall_back", back, True),
        surface((-HALF_WIDTH_M, middle, z), (depth, z), "wall_left", left, True),
        surface((HALF_WIDTH_M, middle, z), (depth, z), "wall_right", right, True),
        box((0, BACK_M + 0.1, 2 * z + 0.06), (HALF_WIDTH_M + 0.3, 0.22, 0.06), 0, "stone"),
        box((-HALF_WIDTH_M - 0.1, middle, 2 * z + 0.06), (0.22, depth, 0.06), 0, "stone", offset=(0.3, 0.1)),
        box((HALF_WIDTH_M + 0.1, middle, 2 * z + 0.06), (0.22, depth, 0.06), 0, "stone", offset=(0.6, 0.4)),
        box((-1.9, BACK_M - 0.12, z), (0.28, 0.14, z), 0, "stone", offset=(0.2, 0.7)),  # two pilasters
        box((2.1, BACK_M - 0.12, z), (0.28, 0.14, z), 0, "stone", offset=(0.8, 0.2)),
        box((3.85, BACK_M - 0.04, 1.05), (0.55, 0.06, 1.05), 0, "timber"),  # a door
    ]
    posters = [("coffee", -4.0), ("rocket", -0.75), ("chelsea", 0.85)]
    for name, x in posters:
        at = (x + rng.uniform(-0.15, 0.15), BACK_M - 0.02, rng.uniform(1.6, 2.0))
        shapes.append(poster(name, at, back))
    for side, axes, pair in ((-1, left, ("hubble", "coins")), (1, right, ("camera", "retina"))):
        for name, y in zip(pair, (1.7, -1.1)):
            at = (side * (HALF_WIDTH_M - 0.02), y + rng.uniform(-0.3, 0.3), rng.uniform(1.5, 2.0))
            shapes.append(poster(name, at, axes))
    return shapes


def _furniture(rng: np.random.Generator) -> tuple[list[Shape], list[tuple[float, float, float]]]:
    """Make planters with bushes, crates, a bench and a stone ball, and their circles on the ground."""
    shapes: list[Shape] = []
    circles: list[tuple[float, float, float]] = []
    for x, y in ((-3.1, 2.6), (3.0, 2.3), (-4.5, -0.6)):
        x, y = x + rng.uniform(-0.25, 0.25), y + rng.uniform(-0.25, 0.25)
        shapes.append(
            capsule_between((x, y, 0), (x, y, 0.55), 0.36, "clay", CYLINDER, offset=tuple(rng.random(2)))
        )
        for _ in range(5):
            at = np.array([x, y, 0.85]) + rng.uniform(-0.24, 0.24, 3) * (1, 1, 0.9)
            size = rng.uniform(0.22, 0.36, 3)
            shapes.append(Shape(ELLIPSOID, vector(at), vector(size), "foliage", offset=tuple(rng.random(2))))
        circles.append((x, y, 0.6))
    crates = ((4.1, 0.3, 0.38), (4.4, 1.0, 0.3), (-4.3, 1.5, 0.34))
    for cx, cy, half in crates:
        x, y, yaw = cx + rng.uniform(-0.15, 0.15), cy + rng.uniform(-0.15, 0.15), rng.uniform(-35, 35)
        shapes.append(box((x, y, half), (half, half, half), yaw, "timber", offset=tuple(rng.random(2))))
        circles.append((x, y, 1.5 * half))
        if half > 0.35:
            top = (x + 0.04, y, 2 * half + 0.2)
            shapes.append(box(top, (0.26, 0.2, 0.2), yaw + 25, "timber", offset=tuple(rng.random(2))))
    bx, by, yaw = rng.uniform(-2.4, -2.0), rng.uniform(0.5, 0.9), rng.uniform(-30, -10)
    shapes += transformed(object_shapes("courtyard bench"), (bx, by, 0), yaw)
    circles.append((bx, by, 0.85))
    sx, sy = rng.uniform(1.9, 2.2), rng.uniform(0.5, 0.8)
    shapes += [
        box((sx, sy, 0.12), (0.3, 0.3, 0.12), rng.uniform(0, 90), "stone", offset=(0.5, 0.9)),
        Shape(ELLIPSOID, (sx, sy, 0.56), (0.33, 0.33, 0.33), "stone", offset=(0.1, 0.35)),
    ]
    circles.append((sx, sy, 0.45))
    return shapes, circles


def courtyard(rng: np.random.Generator, detail_px_per_m: float, samples: int, what: WorldSpec) -> World:
    """Build the courtyard; arguments as in `capture_writer.build_world`."""
    d = detail_px_per_m
    depth = BACK_M - FRONT_M
    statue = (float(rng.uniform(-0.15, 0.35)), float(rng.uniform(1.2, 1.5)), 0.95)
    furniture, circles = _furniture(rng)
    if not what.furniture:
        furniture, circles = [], []
    if what.statue:
        circles.append((statue[0], statue[1], 0.65))
    yaw = float(rng.uniform(-20, 20))
    ground = tx.gravel_ground(rng, *PLAN.ground_m, d)
    sheets = baked_sheets(rng, d)
    textures = {
        "ground": ground,
        "wall_back": tx.brick_wall(rng, 2 * HALF_WIDTH_M, WALL_HEIGHT_M, d),
        "wall_left": tx.brick_wall(rng, depth, WALL_HEIGHT_M, d, (0.27, 0.17, 0.11)),
        "wall_right": tx.brick_wall(rng, depth, WALL_HEIGHT_M, d, (0.32, 0.13, 0.07)),
        "sky": tx.sky(rng),
        **sheets(),
    }
    shapes = [*_walls(rng), *furniture]
    if what.statue:
        shapes += transformed(object_shapes("courtyard plinth"), (statue[0], statue[1], 0), yaw)
        shapes += transformed(figure("stone", "stone", 0.07, 0.8), statue, yaw, thing="statue")
    return world_of(PLAN, what, shapes, circles, textures, d, sunlight(rng, samples), statue)
