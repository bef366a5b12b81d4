"""Objects of places and specs: those of `objects.yaml`, boxes, balls, columns, boards, statues, cars."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from ambiguous_wild.io import plain_yaml
from ambiguous_wild.simulate.kernels import BOX, BY_FACE, CAPSULE, CYLINDER, ELLIPSOID, VOLUME
from ambiguous_wild.simulate.shapes import SHEET_M, Shape, between, figure, placed
from ambiguous_wild.simulate.spec import STATUES, GroundPlan, Thing


def statue(name: str, texture: str, height_m: float) -> Shape:
    """A signed-distance statue at the origin."""
    half = height_m / 1.8  # its foot is at -0.9 of the half size
    return Shape(VOLUME, (0, 0, 0.9 * half), (half, half, half), texture, mapping=BY_FACE, volume=name)


def board(
    texture: str, width_m: float, height_m: float, thick_m: float, plan: GroundPlan, lift_m: float = 0.0
) -> Shape:
    """An upright board that faces -y. A poster covers it once; of another texture it shows a part.

    Of a wall it shows the part at its own height, so it looks like the wall behind it.
    """
    half = (width_m / 2, thick_m / 2, height_m / 2)
    middle = (0.0, 0.0, lift_m + height_m / 2)
    if texture.startswith("poster_"):
        return Shape(BOX, middle, half, texture, scale=(1.0 / width_m, 1.0 / height_m))
    across, up = plan.surfaces.get(texture, (SHEET_M, SHEET_M))
    level = middle[2] / up if texture.startswith("wall_") else 0.5
    return Shape(BOX, middle, half, texture, scale=(1.0 / across, 1.0 / up), offset=(0.5, level))


def placard(texture: str, plan: GroundPlan) -> list[Shape]:
    """A board of 1.1 x 0.85 m on two sticks, 0.75 m above the ground."""
    sticks = [between((x, 0.03, 0.02), (x, 0.03, 1.5), 0.018, "timber") for x in (-0.45, 0.45)]
    return [board(texture, 1.1, 0.85, 0.03, plan, 0.75), *sticks]


def car(texture: str, length_m: float = 4.1) -> list[Shape]:
    """A small car at the origin that faces +x: body, glass, wheels, lamps."""
    return placed(parts_of("car", texture), (0, 0, 0), 0.0, length_m / 4.1)


@cache
def _objects() -> dict[str, list[dict[str, Any]]]:
    return plain_yaml.read_mapping(Path(__file__).with_name("objects.yaml"))


def parts_of(name: str, texture: str = "") -> list[Shape]:
    """An object of `objects.yaml` at the origin; `texture` is its own."""
    shapes = []
    for part in _objects()[name]:
        shown = texture if part["texture"] == "own" else part["texture"]
        more: dict[str, Any] = {key: tuple(part[key]) for key in ("offset", "tint", "gloss") if key in part}
        if "from" in part:
            kind = CAPSULE if part["shape"] == "rod" else CYLINDER
            shapes.append(between(part["from"], part["to"], part["radius"], shown, kind, **more))
        else:
            kind = BOX if part["shape"] == "box" else ELLIPSOID
            shapes.append(Shape(kind, tuple(part["at"]), tuple(part["half"]), shown, **more))
    return shapes


def shapes_of_thing(thing: Thing, plan: GroundPlan) -> list[Shape]:
    """The thing's shapes in the world."""
    width, depth, height = thing.size_m
    half = (width / 2, depth / 2, height / 2)
    middle = (0.0, 0.0, height / 2)
    if thing.kind in STATUES:
        parts = [statue(thing.kind, thing.texture, height)]
    elif thing.kind == "figure":
        parts = placed(figure(thing.texture, thing.texture, 0.07, 0.8), (0, 0, 0), 0.0, height / 1.75)
    elif thing.kind == "board":
        parts = [board(thing.texture, width, height, depth, plan)]
    elif thing.kind == "car":
        parts = car(thing.texture, width)
    elif thing.kind == "column":
        parts = [between((0, 0, 0), (0, 0, height), width / 2, thing.texture, CYLINDER)]
    else:
        parts = [Shape(ELLIPSOID if thing.kind == "ball" else BOX, middle, half, thing.texture)]
    tint = thing.tint
    # Each object shows another part of its texture: two of the same stone differ.
    shift = (0.37 * thing.at_m[0], 0.29 * thing.at_m[1])
    parts = [
        replace(
            s,
            tint=(s.tint[0] * tint[0], s.tint[1] * tint[1], s.tint[2] * tint[2])
            if s.texture == thing.texture
            else s.tint,  # glass and tyres of a car
            offset=s.offset if thing.kind == "board" else (s.offset[0] + shift[0], s.offset[1] + shift[1]),
        )
        for s in parts
    ]
    return placed(parts, thing.at_m, thing.yaw_deg)


def circle_of(thing: Thing) -> tuple[float, float, float]:
    """x, y and radius on the ground, m, where no distractor may stand."""
    width, depth, height = thing.size_m
    if thing.kind in STATUES or thing.kind == "figure":
        return (thing.at_m[0], thing.at_m[1], 0.3 * height)
    return (thing.at_m[0], thing.at_m[1], 0.5 * max(width, depth))
