"""The spec of a capture, as frozen dataclasses that a YAML file fills. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from ambiguous_wild.simulate.image_effects.settings import Effects

Kind = Literal[
    "visitor",
    "twin",
    "parcel",
    "ball",
    "pole",
    "barrier",
    "banner",
    "placard",
    "bust",
    "knot",
    "hound",
    "spire",
    "car",
]
ThingKind = Literal["box", "ball", "column", "board", "figure", "bust", "knot", "hound", "spire", "car"]
Place = Literal["courtyard", "room", "yard"]
Ambiguity = Literal["colour", "semantic", "none"]
Colour = tuple[float, float, float]  # linear light
FULL_FRAME_DIAGONAL_MM = 43.2666  # of 36 x 24 mm, what `focal_35mm` is an equivalent on
STATUES = ("bust", "knot", "hound", "spire")  # signed-distance shapes, in the world and as distractors


@dataclass(frozen=True)
class Designed:
    """Label of a capture: the result that a measurement of it should give."""

    ambiguity: Literal["colour", "semantic", "both", "neither", "unstated"] = "unstated"
    effects: tuple[
        Literal["masks", "local", "global", "entropy", "appearance", "antialiasing", "sh", "pose"], ...
    ] = ()  # effects of the trainer that the capture needs


@dataclass(frozen=True)
class Distractor:
    """Something that has another place in every photo, or walks through the capture."""

    name: str
    kind: Kind
    texture: str  # stone, foliage, brick, ...; for a placard any texture of the world
    ambiguity: Ambiguity  # why it is hard: the background's colour, the statue's shape, or not at all
    head: str = ""  # texture of a visitor's head and hands; empty: the same
    # share of the train photos that show it; with path "elsewhere" and `occlusion` above 0, share of the
    # layouts drawn, from which `occlusion` chooses
    presence: float = 0.85
    distance_m: tuple[float, float] = (1.9, 4.5)  # from the camera; for a walker only the minimum counts
    size: float = (
        1.0  # factor on the natural size: figures 1.75 m, ball 0.8 m, pole 2 m, statues 1.6 m, car 4.1 m
    )
    lift_m: float = 0.0  # greatest height above the ground
    tint: Colour = (1.0, 1.0, 1.0)  # factor on the texture, in linear light
    path: Literal["elsewhere", "walk"] = (
        "elsewhere"  # elsewhere: a new place in every photo; walk: along `waypoints`
    )
    waypoints: tuple[tuple[float, float], ...] = ()  # m: x and y of the corners of its walk
    laps: float = 1.0  # times it walks there and back during the capture


@dataclass(frozen=True)
class Thing:
    """A static object that the spec adds to the place."""

    kind: ThingKind
    texture: str
    at_m: tuple[float, float, float]  # middle of its foot: x to the right, y away from the walk, z up
    # width, depth, height; statues take the height, a car the width as its length
    size_m: tuple[float, float, float] = (1.0, 1.0, 1.0)
    yaw_deg: float = 0.0
    tint: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class WorldSpec:
    """A place: its ground and walls, and these objects."""

    place: Place = "courtyard"
    furniture: bool = (
        True  # courtyard: planters, crates, bench, ball; room: all that stands; yard: cars, trees
    )
    statue: bool = True  # on its plinth
    things: tuple[Thing, ...] = ()


@dataclass(frozen=True)
class CaptureSpec:
    """A capture. The same spec and seed give the same bytes."""

    name: str
    summary: str
    distractors: tuple[Distractor, ...] = ()
    occlusion: tuple[float, float] = (0.10, 0.25)  # least and greatest share of a train photo's pixels
    train_views: int = 30
    test_views: int = 8
    width: int = 960  # px; a factor of 4 gives 240 x 135
    height: int = 540  # px
    samples: int = 4  # rays a pixel, a square number
    detail_px_per_m: float = 110.0  # resolution of the textures
    focal_35mm: float = 26.0  # mm, the equivalent that phones state (CIPA: same diagonal angle)
    walk: Literal["around", "outward"] = "around"  # look at the hub, or stand around it and look away
    arc_deg: float = 104.0  # arc around the hub that the cameras cover
    radius_m: tuple[float, float] = (4.2, 5.3)  # distance from the hub during the walk
    eye_m: tuple[float, float] = (1.3, 1.8)  # height of the phone
    zoom: tuple[float, float] = (1.0, 1.0)  # range of factors on `focal_35mm`
    world: WorldSpec = field(default_factory=WorldSpec)
    effects: Effects = field(default_factory=Effects)
    designed: Designed = field(default_factory=Designed)
