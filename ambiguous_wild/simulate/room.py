"""A furnished room: painted walls, two windows, parquet, shelves, a sofa, a table, a bust in the middle."""

from __future__ import annotations

from typing import Any

import numpy as np

from ambiguous_wild.simulate import built_textures as built
from ambiguous_wild.simulate import textures as tx
from ambiguous_wild.simulate.kernels import BOX, ELLIPSOID, PLANAR, QUAD
from ambiguous_wild.simulate.shapes import Shape, capsule_between, transformed, vector
from ambiguous_wild.simulate.spec import PLANS, WorldSpec
from ambiguous_wild.simulate.world import (
    WALL_AXES,
    World,
    baked_sheets,
    box,
    object_shapes,
    on_wall,
    poster,
    statue,
    sunlight,
    wall,
    world_of,
)

PLAN = PLANS["room"]
WHITE = (2.0, 2.0, 2.0)  # tint of stone that gives painted wood
CURTAIN = (0.42, 0.30, 0.12)
# Left, right, bottom and top of each window in m, along the wall from its middle.
_WINDOWS = {"wall_left": (-1.4, 0.5, 0.95, 2.3), "wall_back": (1.2, 2.6, 0.95, 2.3)}
Circle = tuple[float, float, float]


def room(rng: np.random.Generator, detail_px_per_m: float, samples: int, what: WorldSpec) -> World:
    """Build the room; arguments as in `capture_writer.build_world`."""
    d = detail_px_per_m
    wide, deep = PLAN.surfaces["wall_back"][0], PLAN.surfaces["wall_left"][0]
    hub = (float(rng.uniform(-0.1, 0.1)), float(rng.uniform(0.35, 0.5)), 0.0)
    shapes, circles = _furniture(rng)
    if not what.furniture:
        shapes, circles = [], []
    if what.statue:
        circles.append((hub[0], hub[1], 0.4))
    streams = rng.spawn(7)
    ground = built.parquet(streams[0], *PLAN.ground_m, d)
    sheets = baked_sheets(rng, d)
    colours = {"wall_back": built.PAINT, "wall_left": (0.50, 0.46, 0.39), "wall_right": (0.36, 0.42, 0.40)}
    colours["wall_front"] = built.PAINT
    textures = {
        "ground": ground,
        "ceiling": built.painted_wall(streams[1], *PLAN.ground_m, d, (0.62, 0.61, 0.58)),
        "rug": built.rug(streams[2]),
        "sky": tx.sky(streams[3]),
        **{
            name: built.painted_wall(stream, wide if name in ("wall_back", "wall_front") else deep, 2.7, d, c)
            for stream, (name, c) in zip(rng.spawn(4), colours.items())
        },
        **sheets(),
    }
    shapes = [*_hull(), *_pictures(streams[4]), *shapes]
    if what.statue:
        bust = transformed([statue("bust", "stone", 0.75)], (0, 0, 0.87), 0.0, thing="statue")
        pedestal = [*object_shapes("room pedestal"), *bust]
        shapes += transformed(pedestal, hub, float(rng.uniform(-20, 20)))
    # The sun comes in through the windows; light reflected by walls is part of the sky light.
    light = sunlight(rng, samples, (-178.0, -165.0), (26.0, 34.0), sky=1.4)
    return world_of(PLAN, what, shapes, circles, textures, d, light, hub)


def _hull() -> list[Shape]:
    """Make walls around windows, window frames, curtains, skirting, a door, and a ceiling with a lamp."""
    shapes: list[Shape] = []
    for name in PLAN.walls:
        opening = _WINDOWS.get(name)
        shapes += wall(PLAN, name, [opening] if opening else [])
        if opening:
            shapes += _window(name, *opening)
    half_x, half_y = PLAN.x_m[1], PLAN.y_m[1]
    down = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
    shapes.append(
        Shape(
            QUAD, (0, 0, PLAN.wall_m), (half_x, half_y, 0), "ceiling", down, PLANAR,
            (0.5 / half_x, 0.5 / half_y), (0.5, 0.5),
        )
    )  # fmt: skip
    for y in (-half_y, half_y):
        shapes.append(box((0, y, 0.06), (half_x, 0.015, 0.06), 0, "stone", tint=WHITE))
    for x in (-half_x, half_x):
        shapes.append(box((x, 0, 0.06), (0.015, half_y, 0.06), 0, "stone", tint=WHITE, offset=(0.1, 0.8)))
    door = on_wall(PLAN, "wall_right", 1.9, 1.02, 0.03)
    shapes += [
        box(door, (0.03, 0.46, 1.02), 0, "timber", tint=(1.5, 1.5, 1.4)),
        box(on_wall(PLAN, "wall_right", 1.9, 1.05, 0.01), (0.015, 0.54, 1.09), 0, "stone", tint=WHITE),
        Shape(ELLIPSOID, on_wall(PLAN, "wall_right", 1.55, 1.0, 0.09), (0.05, 0.05, 0.03), "enamel"),
        capsule_between((0, 0.4, 2.7), (0, 0.4, 2.25), 0.012, "asphalt"),
        Shape(ELLIPSOID, (0, 0.4, 2.2), (0.24, 0.24, 0.13), "cloth", tint=(0.9, 0.75, 0.5)),
    ]
    return shapes


def _window(name: str, left: float, right: float, bottom: float, top: float) -> list[Shape]:
    """Make frame, bars and sill of a window, and curtains on both sides."""
    frame: dict[str, Any] = {"tint": WHITE, "axes": WALL_AXES[name]}
    middle, height = (left + right) / 2, (bottom + top) / 2
    wide, high = (right - left) / 2, (top - bottom) / 2
    pieces = [
        (middle, bottom - 0.02, wide + 0.08, 0.03, 0.11),
        (middle, top, wide + 0.04, 0.035, 0.05),
        (left, height, 0.035, high, 0.05),
        (right, height, 0.035, high, 0.05),
        (middle, height, 0.03, high, 0.03),
        (middle, height + 0.25 * high, wide, 0.018, 0.025),
    ]
    shapes = [
        Shape(BOX, on_wall(PLAN, name, x, z, 0.0), (a, b, c), "stone", **frame) for x, z, a, b, c in pieces
    ]
    for side, x in ((-1, left - 0.05), (1, right + 0.05)):
        for fold in range(3):
            at = on_wall(PLAN, name, x + side * 0.11 * fold, 1.2, 0.1)
            foot, head = (*at[:2], 0.12), (*at[:2], 2.45)
            shapes.append(
                capsule_between(
                    foot, head, 0.065, "cloth", tint=CURTAIN, offset=(0.2 * fold, 0.3 + 0.2 * side)
                )
            )
    return shapes


def _pictures(rng: np.random.Generator) -> list[Shape]:
    spots = (
        ("wall_back", -2.75, 1.75, "coffee", 0.36),
        ("wall_back", 0.55, 1.7, "rocket", 0.36),
        ("wall_right", -1.9, 1.65, "hubble", 0.42),
        ("wall_right", 0.1, 1.75, "camera", 0.3),
        ("wall_right", 0.95, 1.55, "coins", 0.27),
        ("wall_left", 1.75, 1.7, "chelsea", 0.42),
        ("wall_left", -2.35, 1.6, "retina", 0.3),
    )
    shapes = []
    for name, along, height, picture, half in spots:
        at = on_wall(PLAN, name, along + rng.uniform(-0.08, 0.08), height + rng.uniform(-0.06, 0.06))
        shapes.append(poster(picture, at, WALL_AXES[name], half))
    return shapes


def _books(rng: np.random.Generator, wide: float, high: float) -> list[Shape]:
    """Make a row of books from x = 0 to `wide`, at most `high` tall."""
    books, x = [], 0.02
    while x < wide - 0.03:
        thick, tall = rng.uniform(0.02, 0.055), high * rng.uniform(0.6, 0.95)
        tint = vector(built.muted(rng))
        if rng.random() > 0.08:
            at = (x + thick / 2, 0.0, tall / 2)
            offset = (float(rng.random()), float(rng.random()))
            books.append(
                Shape(BOX, at, (thick / 2 - 0.002, 0.1, tall / 2), "cloth", tint=tint, offset=offset)
            )
        x += thick
    return books


def _shelf(rng: np.random.Generator, wide: float) -> list[Shape]:
    """Make a bookcase, 2.05 m tall, that faces -y."""
    boards = [Shape(BOX, (0, 0, 0.05 + 0.4 * k), (wide / 2, 0.15, 0.015), "timber") for k in range(6)]
    sides = [Shape(BOX, (x, 0, 1.03), (0.02, 0.15, 1.03), "timber") for x in (-wide / 2, wide / 2)]
    back = Shape(BOX, (0, 0.145, 1.03), (wide / 2, 0.008, 1.03), "timber", tint=(0.6, 0.6, 0.6))
    rows = [
        s
        for k in range(5)
        for s in transformed(_books(rng, wide - 0.06, 0.36), (-wide / 2 + 0.03, -0.02, 0.065 + 0.4 * k), 0)
    ]
    return [*boards, *sides, back, *rows]


def _leaves(
    rng: np.random.Generator,
    at: tuple[float, float, float],
    reach: float,
    half: tuple[float, float, float],
    count: int,
) -> list[Shape]:
    """Make the leaves of a plant: `count` balls around its middle."""
    middles = [np.array(at) + rng.uniform(-reach, reach, 3) for _ in range(count)]
    return [Shape(ELLIPSOID, vector(middle), half, "foliage") for middle in middles]


def _furniture(rng: np.random.Generator) -> tuple[list[Shape], list[Circle]]:
    """Make the furniture, and its circles on the floor."""
    shapes: list[Shape] = [
        Shape(
            QUAD, (0.0, 0.2, 0.006), (1.5, 1.0, 0.0), "rug", mapping=PLANAR, scale=(1 / 3.0, 1 / 2.0),
            offset=(0.5, 0.5), casts=False,
        )
    ]  # fmt: skip
    circles: list[Circle] = []
    for x in (-2.9, -1.75, -0.6):
        shapes += transformed(_shelf(rng, 1.1), (x, 2.82, 0), 0)
        circles.append((x, 2.82, 0.55))
    sofa = (-3.1, float(rng.uniform(-0.3, 0.0)), 0.0)
    shapes += transformed(object_shapes("sofa"), sofa, 0.0)
    circles += [(sofa[0], sofa[1] + dy, 0.6) for dy in (-0.5, 0.5)]
    table = (float(rng.uniform(2.0, 2.15)), float(rng.uniform(0.1, 0.3)), 0.0)
    top = [
        *object_shapes("table"),
        *_leaves(rng, (0.1, 0.25, 1.1), 0.12, (0.1, 0.1, 0.12), 5),
        *object_shapes("bowl"),
        *transformed(_books(rng, 0.22, 0.3), (-0.3, 0.4, 0.76), 15.0),
    ]
    shapes += transformed(top, table, 0.0)
    circles.append((table[0], table[1], 0.85))
    for x, y, yaw in ((-0.62, -0.25, -90.0), (-0.6, 0.35, -80.0), (0.0, -1.0, 180.0), (0.05, 1.0, 10.0)):
        at = (table[0] + x, table[1] + y, 0.0)
        shapes += transformed(object_shapes("chair"), at, yaw + float(rng.uniform(-15, 15)))
        circles.append((at[0], at[1], 0.3))
    cupboard = [
        *object_shapes("cupboard"),
        *_leaves(rng, (0.35, 0, 1.2), 0.16, (0.13, 0.13, 0.17), 6),
        *object_shapes("radio"),
    ]
    shapes += transformed(cupboard, (1.9, 2.72, 0), 0)
    circles.append((1.9, 2.72, 0.7))
    lamp = (-2.9, 1.75, 0.0)
    shapes += transformed(object_shapes("floor lamp"), lamp, 0.0)
    circles.append((lamp[0], lamp[1], 0.25))
    shapes += transformed(object_shapes("books on a crate"), (-1.55, 1.75, 0), float(rng.uniform(10, 40)))
    circles.append((-1.55, 1.75, 0.35))
    return shapes, circles
