"""A simulated place: static shapes, textures and light, and the parts that all places share.

Objects that places and specs use: those of `objects.yaml`, boxes, balls, columns, boards, statues, cars.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.io import plain_yaml
from ambiguous_wild.simulate import built_textures as built
from ambiguous_wild.simulate import textures as tx
from ambiguous_wild.simulate.kernels import (
    BOX,
    BY_FACE,
    CAPSULE,
    CYLINDER,
    DOME,
    ELLIPSOID,
    PLANAR,
    QUAD,
    VOLUME,
)
from ambiguous_wild.simulate.shapes import (
    SHEET_M,
    Axes,
    Shape,
    Vector,
    capsule_between,
    figure,
    shape_table,
    transformed,
    vector,
)
from ambiguous_wild.simulate.spec import POSTERS, STATUES, GroundPlan, Thing, WorldSpec
from ambiguous_wild.simulate.tracer import Atlas, Light, ShapeTable, build_atlas

OVERHEAD_M = 2.0  # foot of a thing that hangs above the distractors
MIRRORS = {
    "mirror": 0.85,
    "glass": 0.0,
}  # share of the light that is mirrored; of a pane it follows the angle
FRAME_M = 0.05  # width of the frame of a mirror or a pane
SHEETS = {
    "stone": tx.stone, "foliage": tx.foliage, "timber": tx.timber, "clay": tx.clay, "skin": tx.skin,
    "brick": tx.brick, "gravel": tx.gravel, "vivid": tx.vivid, "cloth": tx.cloth, "plaster": built.plaster,
    "asphalt": built.asphalt, "enamel": built.enamel,
}  # fmt: skip
# These have random streams of their own, so that adding a sheet changes no bit of other captures.
_LATER_SHEETS = ("cloth", "plaster", "asphalt", "enamel")
# Local axes of the walls: along the wall, up, inwards.
WALL_AXES: Mapping[str, Axes] = {
    "wall_back": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "wall_left": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "wall_right": ((0, -1, 0), (0, 0, 1), (-1, 0, 0)),
    "wall_front": ((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
}


def statue(name: str, texture: str, height_m: float) -> Shape:
    """Make a signed-distance statue at the origin."""
    half = height_m / 1.8  # the foot is at -0.9 of the half size
    return Shape(VOLUME, (0, 0, 0.9 * half), (half, half, half), texture, mapping=BY_FACE, volume=name)


def board(
    texture: str, width_m: float, height_m: float, thick_m: float, plan: GroundPlan, lift_m: float = 0.0
) -> Shape:
    """Make an upright board that faces -y. A poster covers it once; of other textures it shows a part.

    With the texture of a wall it shows the part at its height, so it looks like the wall behind it.
    """
    half = (width_m / 2, thick_m / 2, height_m / 2)
    middle = (0.0, 0.0, lift_m + height_m / 2)
    if texture.startswith("poster_"):
        return Shape(BOX, middle, half, texture, scale=(1.0 / width_m, 1.0 / height_m))
    across, up = plan.surfaces.get(texture, (SHEET_M, SHEET_M))
    level = middle[2] / up if texture.startswith("wall_") else 0.5
    return Shape(BOX, middle, half, texture, scale=(1.0 / across, 1.0 / up), offset=(0.5, level))


def placard(texture: str, plan: GroundPlan) -> list[Shape]:
    """Make a board of 1.1 x 0.85 m on two sticks, 0.75 m above the ground."""
    sticks = [capsule_between((x, 0.03, 0.02), (x, 0.03, 1.5), 0.018, "timber") for x in (-0.45, 0.45)]
    return [board(texture, 1.1, 0.85, 0.03, plan, 0.75), *sticks]


def car(texture: str, length_m: float = 4.1, paint: Vector = (1.0, 1.0, 1.0)) -> list[Shape]:
    """Make a small car at the origin that faces +x: body in a tint of the texture, glass, wheels, lamps."""
    return transformed(object_shapes("car", texture, paint), (0, 0, 0), 0.0, length_m / 4.1)


@cache
def _objects() -> dict[str, list[dict[str, Any]]]:
    return plain_yaml.read_mapping(Path(__file__).with_name("objects.yaml"))


def object_shapes(name: str, texture: str = "", own_tint: Vector = (1.0, 1.0, 1.0)) -> list[Shape]:
    """Make an object of `objects.yaml` at the origin; parts without a texture of their own get these."""
    shapes = []
    for part in _objects()[name]:
        shown = texture if part["texture"] == "own" else part["texture"]
        more: dict[str, Any] = {key: tuple(part[key]) for key in ("offset", "tint", "gloss") if key in part}
        if part["texture"] == "own":
            more["tint"] = own_tint
        if "from" in part:
            kind = CAPSULE if part["shape"] == "rod" else CYLINDER
            shapes.append(capsule_between(part["from"], part["to"], part["radius"], shown, kind, **more))
        else:
            kind = BOX if part["shape"] == "box" else ELLIPSOID
            shapes.append(Shape(kind, tuple(part["at"]), tuple(part["half"]), shown, **more))
    return shapes


def mirror_of(thing: Thing) -> Shape:
    """Make the mirror or the pane of a thing, which faces -y before it is turned."""
    width, depth, height = thing.size_m
    front = -depth / 2 - 0.002 if thing.kind == "mirror" else 0.0
    axes: Axes = ((1, 0, 0), (0, 0, 1), (0, -1, 0))
    share = MIRRORS[thing.kind]
    half = (width / 2 - FRAME_M, height / 2 - FRAME_M, 0.0)
    shape = Shape(QUAD, (0.0, front, height / 2), half, thing.texture, axes, tint=(share, share, share))
    return transformed([shape], thing.at_m, thing.yaw_deg)[0]


def _frame(thing: Thing) -> list[Shape]:
    """Make the frame of a mirror or a pane, and the back of a mirror."""
    width, depth, height = thing.size_m
    wide, high, thick = width / 2, height / 2, FRAME_M / 2
    bars = [((x, 0, high), (thick, high)) for x in (thick - wide, wide - thick)]
    bars += [((0, 0, z), (wide, thick)) for z in (thick, height - thick)]
    # The frame stands out by a centimetre in front of the mirror.
    parts = [
        Shape(BOX, vector(at), (half[0], depth / 2 + 0.01, half[1]), thing.texture, offset=(0.3 * k, 0.5))
        for k, (at, half) in enumerate(bars)
    ]
    if thing.kind == "mirror":
        parts.append(Shape(BOX, (0, 0, high), (wide - thick, depth / 2, high - thick), thing.texture))
    return parts


def thing_shapes(thing: Thing, plan: GroundPlan) -> list[Shape]:
    """Make the shapes of a thing of the spec, in the world."""
    width, depth, height = thing.size_m
    half = (width / 2, depth / 2, height / 2)
    middle = (0.0, 0.0, height / 2)
    if thing.kind in STATUES:
        parts = [statue(thing.kind, thing.texture, height)]
    elif thing.kind == "figure":
        parts = transformed(figure(thing.texture, thing.texture, 0.07, 0.8), (0, 0, 0), 0.0, height / 1.75)
    elif thing.kind == "board":
        parts = [board(thing.texture, width, height, depth, plan)]
    elif thing.kind == "car":
        parts = car(thing.texture, width, thing.tint)
    elif thing.kind in MIRRORS:
        parts = _frame(thing)
    elif thing.kind == "column":
        parts = [capsule_between((0, 0, 0), (0, 0, height), width / 2, thing.texture, CYLINDER)]
    else:
        parts = [Shape(ELLIPSOID if thing.kind == "ball" else BOX, middle, half, thing.texture)]
    tint = (1.0, 1.0, 1.0) if thing.kind == "car" else thing.tint
    # Each object shows another part of its texture, so that two of the same stone differ.
    shift = (0.37 * thing.at_m[0], 0.29 * thing.at_m[1])
    parts = [
        replace(
            s,
            tint=(s.tint[0] * tint[0], s.tint[1] * tint[1], s.tint[2] * tint[2])
            if s.texture == thing.texture
            else s.tint,
            offset=s.offset if thing.kind == "board" else (s.offset[0] + shift[0], s.offset[1] + shift[1]),
        )
        for s in parts
    ]
    return transformed(parts, thing.at_m, thing.yaw_deg)


def thing_footprint(thing: Thing) -> tuple[float, float, float]:
    """Return x, y and radius in m of the circle on the ground in which no distractor may stand."""
    width, depth, height = thing.size_m
    if thing.at_m[2] >= OVERHEAD_M:
        return (thing.at_m[0], thing.at_m[1], 0.0)
    if thing.kind in STATUES or thing.kind == "figure":
        return (thing.at_m[0], thing.at_m[1], 0.3 * height)
    return (thing.at_m[0], thing.at_m[1], 0.5 * max(width, depth))


@dataclass(frozen=True)
class World:
    """Static shapes, textures and light, and the circles in which no distractor may stand."""

    shapes: tuple[Shape, ...]
    atlas: Atlas
    light: Light
    keep_out: np.ndarray  # [N, 3] float64: x, y, radius in m
    hub: tuple[float, float, float]  # m: point on the ground that the cameras walk around
    plan: GroundPlan
    mirrors: tuple[Shape, ...] = ()  # mirrors and panes

    def table(self) -> ShapeTable:
        """Return the static shapes as a table for the ray caster."""
        return shape_table(self.shapes, self.atlas)


def world_of(
    plan: GroundPlan,
    what: WorldSpec,
    shapes: Sequence[Shape],  # of the place itself, without ground and sky
    circles: Sequence[tuple[float, float, float]],  # x, y, radius in m in which no distractor may stand
    textures: Mapping[str, np.ndarray],  # that of the ground is darkened at the foot of walls and objects
    detail_px_per_m: float,
    light: Light,
    hub: tuple[float, float, float],
) -> World:
    """Make the world of a place and of the things that the spec adds to it."""
    things = [
        replace(s, thing="" if thing.kind in MIRRORS else f"thing {number}")
        for number, thing in enumerate(what.things)
        for s in thing_shapes(thing, plan)
    ]
    circles = [*circles, *map(thing_footprint, what.things)]
    _shade_feet(textures["ground"], circles, detail_px_per_m, plan)
    keep_out = np.array(circles, float).reshape(-1, 3)
    shapes = (*_ground_and_sky(plan), *shapes, *things)
    mirrors = tuple(mirror_of(thing) for thing in what.things if thing.kind in MIRRORS)
    return World(shapes, build_atlas(textures), light, keep_out, hub, plan, mirrors)


def baked_sheets(rng: np.random.Generator, detail_px_per_m: float) -> Callable[[], dict[str, np.ndarray]]:
    """Draw the random streams of the later sheets now, and return a function that bakes all sheets."""
    later = dict(zip(_LATER_SHEETS, rng.spawn(len(_LATER_SHEETS))))

    def bake() -> dict[str, np.ndarray]:
        sheets = {
            name: bake(later.get(name, rng), SHEET_M, SHEET_M, 1.8 * detail_px_per_m)
            for name, bake in SHEETS.items()
        }
        return sheets | {f"poster_{name}": tx.poster(name) for name in POSTERS}

    return bake


def surface(
    center: tuple[float, float, float],
    half: tuple[float, float],
    texture: str,
    axes: Axes,
    casts: bool,
) -> Shape:
    """Make a quad that the texture covers once."""
    scale = (0.5 / half[0], 0.5 / half[1])
    return Shape(QUAD, center, (*half, 0.0), texture, axes, PLANAR, scale, (0.5, 0.5), casts=casts)


def _ground_and_sky(plan: GroundPlan) -> list[Shape]:
    """Make the ground and a dome around it."""
    return [
        surface((0, 0, 0), (plan.ground_m[0] / 2, plan.ground_m[1] / 2), "ground", Shape.axes, False),
        Shape(ELLIPSOID, (0, 0, -0.5), (26.0, 26.0, 26.0), "sky", mapping=DOME, casts=False),
    ]


def box(center: Sequence[float], half: Sequence[float], yaw_deg: float, texture: str, **more: Any) -> Shape:
    """Make a box turned about z."""
    shape = Shape(BOX, (0, 0, 0), vector(half), texture, **more)
    return transformed([shape], center, yaw_deg)[0]


def wall(
    plan: GroundPlan, name: str, openings: Sequence[tuple[float, float, float, float]] = ()
) -> list[Shape]:
    """Make a wall of quads around its openings.

    Args:
        plan: ground plan of the place.
        name: name of the wall, and of its texture.
        openings: each (left, right, bottom, top) in m, along the wall from its middle, and from the ground.
    """
    across, up = plan.surfaces[name]
    along, _, inwards = (np.array(a, float) for a in WALL_AXES[name])
    x, y = plan.middle
    near, far = plan.y_m if name in ("wall_back", "wall_front") else plan.x_m
    middle = np.array([x, y, 0.0]) - inwards * (far - near) / 2
    pieces: list[tuple[float, float, float, float]] = []
    start = -across / 2
    for left, right, bottom, top in sorted(openings):
        pieces += [(start, left, 0.0, up), (left, right, 0.0, bottom), (left, right, top, up)]
        start = right
    pieces.append((start, across / 2, 0.0, up))
    shapes = []
    for left, right, bottom, top in pieces:
        if right - left < 1e-6 or top - bottom < 1e-6:
            continue
        at = middle + along * (left + right) / 2 + np.array([0.0, 0.0, (bottom + top) / 2])
        offset = (0.5 + (left + right) / 2 / across, (bottom + top) / 2 / up)
        half = ((right - left) / 2, (top - bottom) / 2, 0.0)
        scale = (1.0 / across, 1.0 / up)
        shapes.append(Shape(QUAD, vector(at), half, name, WALL_AXES[name], PLANAR, scale, offset))
    return shapes


def on_wall(
    plan: GroundPlan, name: str, along_m: float, height_m: float, out_m: float = 0.02
) -> tuple[float, float, float]:
    """Return a point in front of a wall: along it from its middle, above the ground, and away from it, m."""
    along, _, inwards = (np.array(a, float) for a in WALL_AXES[name])
    span = plan.y_m if name in ("wall_back", "wall_front") else plan.x_m
    foot = np.array([*plan.middle, 0.0]) - inwards * ((span[1] - span[0]) / 2 - out_m)
    return vector(foot + along * along_m + np.array([0.0, 0.0, height_m]))


def poster(name: str, at: tuple[float, float, float], axes: Axes, half_m: float = 0.55) -> Shape:
    """Make a sheet of paper with one of scikit-image's photographs and a border."""
    h, w = tx.photograph(name).shape[:2]
    return replace(
        surface(at, (half_m, half_m * h / w), f"poster_{name}", axes, False), thing=f"poster {name}"
    )


def _shade_feet(
    ground: np.ndarray, circles: Iterable[Sequence[float]], px_per_m: float, plan: GroundPlan
) -> None:
    """Darken the ground at the foot of walls and objects, in place and without tracing rays."""
    h, w = ground.shape[:2]
    x = (np.arange(w) + 0.5) / px_per_m - plan.ground_m[0] / 2
    y = (np.arange(h) + 0.5) / px_per_m - plan.ground_m[1] / 2
    for cx, cy, radius in circles:
        away = np.hypot(x[None] - cx, y[:, None] - cy) - 0.7 * radius
        ground *= (1 - 0.5 * np.exp(-np.maximum(away, 0) / 0.18))[..., None]
    gap = np.minimum(plan.x_m[1] - np.abs(x)[None], plan.y_m[1] - y[:, None])
    if "wall_front" in plan.walls:
        gap = np.minimum(gap, (y - plan.y_m[0])[:, None])
    ground *= (1 - 0.45 * np.exp(-np.maximum(gap, 0) / 0.25))[..., None]


def sunlight(
    rng: np.random.Generator,
    samples: int,
    azimuth_deg: tuple[float, float] = (-150.0, -120.0),
    elevation_deg: tuple[float, float] = (44.0, 54.0),
    sky: float = 1.0,
) -> Light:
    """Make an afternoon sun 0.024 rad wide, by default from behind left, and a blue sky of strength `sky`."""
    azimuth, elevation = np.deg2rad(rng.uniform(*azimuth_deg)), np.deg2rad(rng.uniform(*elevation_deg))
    side, spread, sun = math.isqrt(samples), 0.024, []
    for n in range(side * side):
        turn, tilt = spread * ((n % side + 0.5) / side - 0.5), spread * ((n // side + 0.5) / side - 0.5)
        a, e = azimuth + turn, elevation + tilt
        sun.append((np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)))
    return Light(
        np.array(sun),
        np.array([1.75, 1.6, 1.35]),
        sky * np.array([0.62, 0.70, 0.82]),
        sky * np.array([0.34, 0.31, 0.27]),
    )
