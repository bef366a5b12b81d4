"""A yard between house fronts: parked cars, trees, lamps, bins; the camera stands in its middle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ambiguous_wild.simulate import built_textures as built
from ambiguous_wild.simulate import textures as tx
from ambiguous_wild.simulate.kernels import BOX, CYLINDER, ELLIPSOID
from ambiguous_wild.simulate.shapes import Shape, capsule_between, figure, transformed, vector
from ambiguous_wild.simulate.spec import PLANS, WorldSpec
from ambiguous_wild.simulate.world import (
    WALL_AXES,
    World,
    baked_sheets,
    box,
    car,
    object_shapes,
    on_wall,
    poster,
    sunlight,
    wall,
    world_of,
)

PLAN = PLANS["yard"]
# x, y and direction of the parked cars, and their paint, in linear light
_PARKED = (
    (-5.1, 5.2, 90.0, (0.42, 0.03, 0.03)),
    (-2.3, 5.3, 92.0, (0.55, 0.56, 0.58)),
    (3.1, 5.2, -90.0, (0.03, 0.08, 0.3)),
    (5.9, 5.4, 88.0, (0.05, 0.05, 0.06)),
    (-3.7, -5.3, -90.0, (0.7, 0.7, 0.66)),
    (1.6, -5.2, 90.0, (0.05, 0.16, 0.09)),
    (4.4, -5.4, -88.0, (0.55, 0.56, 0.58)),
)
_TREES = ((0.4, 5.9), (-6.9, -1.7), (7.0, 2.6), (-1.0, -6.6))
_FRONTS = {
    "wall_back": (0.50, 0.42, 0.28),
    "wall_left": (0.42, 0.27, 0.20),
    "wall_right": (0.45, 0.46, 0.44),
    "wall_front": (0.30, 0.36, 0.40),
}
Circle = tuple[float, float, float]


def yard(rng: np.random.Generator, detail_px_per_m: float, samples: int, what: WorldSpec) -> World:
    """Build the yard; arguments as in `capture_writer.build_world`."""
    d = detail_px_per_m
    hub = (float(rng.uniform(-0.4, 0.4)), float(rng.uniform(-0.4, 0.4)), 0.0)
    shapes, circles = _standing(rng)
    if not what.furniture:
        shapes, circles = [], []
    foot = (float(rng.uniform(4.0, 4.5)), float(rng.uniform(-0.8, -0.3)), 0.0)
    if what.statue:
        circles.append((foot[0], foot[1], 0.65))
    streams = rng.spawn(7)
    ground = built.yard_ground(streams[0], *PLAN.ground_m, d)
    sheets = baked_sheets(rng, d)
    textures = {
        "ground": ground,
        "sky": tx.sky(streams[1]),
        **{
            name: built.facade(stream, *PLAN.surfaces[name], d, colour)
            for stream, (name, colour) in zip(rng.spawn(4), _FRONTS.items())
        },
        **sheets(),
    }
    shapes = [*_fronts(streams[2]), *shapes]
    if what.statue:
        person = transformed(figure("stone", "stone", 0.07, 0.8), (0, 0, 0.75), 0.0, thing="statue")
        plinth = [*object_shapes("yard plinth"), *person]
        shapes += transformed(plinth, foot, float(rng.uniform(-110, -70)))
    light = sunlight(rng, samples, (-150.0, -120.0), (48.0, 58.0))
    return world_of(PLAN, what, shapes, circles, textures, d, light, hub)


def _fronts(rng: np.random.Generator) -> list[Shape]:
    """Make four house fronts with cornices, roof edges and a few bills on the walls."""
    shapes: list[Shape] = []
    for k, name in enumerate(PLAN.walls):
        across, up = PLAN.surfaces[name]
        shapes += wall(PLAN, name)
        for height, out in ((up + 0.1, 0.25), (2.5, 0.06)):
            half = (across / 2 + 0.2, 0.1 if height > up else 0.05, out)
            at = on_wall(PLAN, name, 0.0, height, 0.0)
            shapes.append(Shape(BOX, at, half, "stone", WALL_AXES[name], offset=(0.2 * k, 0.6)))
    bills = (("wall_back", 0.6, "rocket"), ("wall_left", 2.8, "coffee"), ("wall_right", -2.6, "hubble"))
    for name, along, picture in (*bills, ("wall_front", -0.4, "retina"), ("wall_left", -4.6, "chelsea")):
        at = on_wall(PLAN, name, along + rng.uniform(-0.2, 0.2), 1.6 + rng.uniform(-0.1, 0.2), 0.08)
        shapes.append(poster(picture, at, WALL_AXES[name]))
    return shapes


def _tree(rng: np.random.Generator) -> list[Shape]:
    """Make a tree of about 5 m."""
    height = rng.uniform(1.9, 2.4)
    shapes = [capsule_between((0, 0, 0), (0.08, 0.04, height), 0.13, "timber", offset=(0.4, 0.1))]
    for _ in range(4):
        a = rng.uniform(0, 2 * np.pi)
        reach = (0.08 + 0.5 * np.cos(a), 0.04 + 0.5 * np.sin(a), height + rng.uniform(0.5, 1.0))
        shapes.append(capsule_between((0.08, 0.04, height - 0.2), reach, 0.05, "timber"))
    for _ in range(16):
        # No leaves float apart from the crown.
        at = np.array([0.08, 0.04, height + 1.0]) + np.clip(rng.normal(0, 1, 3), -1.2, 1.2) * (0.6, 0.6, 0.5)
        size = rng.uniform(0.35, 0.65, 3)
        offset = (float(rng.random()), float(rng.random()))
        shapes.append(Shape(ELLIPSOID, vector(at), vector(size), "foliage", offset=offset))
    return shapes


def _standing(rng: np.random.Generator) -> tuple[list[Shape], list[Circle]]:
    """Make cars, trees, lamp posts, bins and a bench, and their circles on the ground."""
    shapes: list[Shape] = []
    circles: list[Circle] = []
    for number, (x, y, yaw, paint) in enumerate(_PARKED):
        x, y = x + rng.uniform(-0.2, 0.2), y + rng.uniform(-0.25, 0.25)
        offset = (float(rng.random()), float(rng.random()))
        for part in transformed(car("enamel"), (x, y, 0), yaw + rng.uniform(-3, 3), rng.uniform(0.96, 1.06)):
            plain = part.texture == "enamel" and part.tint == (1.0, 1.0, 1.0) and part.half[0] > 0.25
            painted = _painted(part, paint, offset) if plain else part
            shapes.append(replace(painted, thing=f"car {number}"))
        circles += [(x, y + dy, 1.0) for dy in (-1.0, 1.0)]
    for x, y in _TREES:
        x, y = x + rng.uniform(-0.3, 0.3), y + rng.uniform(-0.3, 0.3)
        shapes += transformed(_tree(rng), (x, y, 0), 0.0)
        shapes.append(box((x, y, 0.04), (0.6, 0.6, 0.05), 20.0, "stone"))
        circles.append((x, y, 0.7))
    for x, y in ((-7.3, 4.4), (6.9, -4.2)):
        shapes += [
            capsule_between((x, y, 0), (x, y, 3.6), 0.05, "asphalt"),
            capsule_between((x, y, 3.6), (x - 0.5 * np.sign(x), y, 3.75), 0.04, "asphalt"),
            Shape(ELLIPSOID, (x - 0.6 * np.sign(x), y, 3.72), (0.22, 0.13, 0.08), "enamel"),
        ]
        circles.append((x, y, 0.2))
    for k, (x, y, tint) in enumerate(
        ((-7.9, 1.1, (0.1, 0.25, 0.09)), (-7.9, 1.8, (0.3, 0.25, 0.03)), (7.9, 5.3, (0.05, 0.1, 0.3)))
    ):
        bin_: dict[str, Any] = {"tint": tint, "offset": (0.3 * k, 0.4)}
        shapes += [
            box((x, y, 0.55), (0.28, 0.28, 0.5), 4.0 * k, "enamel", **bin_),
            box((x, y, 1.08), (0.31, 0.31, 0.04), 4.0 * k, "enamel", **bin_),
        ]
        circles.append((x, y, 0.4))
    shapes += transformed(object_shapes("yard bench"), (-7.4, -4.6, 0), 75.0)
    circles.append((-7.4, -4.6, 0.85))
    for x, y in ((7.2, 0.6), (6.9, -2.3)):
        shapes.append(
            capsule_between((x, y, 0), (x, y, 0.6), 0.4, "clay", CYLINDER, offset=tuple(rng.random(2)))
        )
        for _ in range(6):
            at = np.array([x, y, 0.9]) + rng.uniform(-0.25, 0.25, 3)
            shapes.append(Shape(ELLIPSOID, vector(at), vector(rng.uniform(0.2, 0.36, 3)), "foliage"))
        circles.append((x, y, 0.6))
    return shapes, circles


def _painted(part: Shape, paint: tuple[float, float, float], shift: tuple[float, float]) -> Shape:
    return replace(part, tint=paint, offset=(part.offset[0] + shift[0], part.offset[1] + shift[1]))
