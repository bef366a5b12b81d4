"""The spec of a capture, as frozen dataclasses that a YAML file fills, and the places by name.

World axes: x right, y away from the walk, z up; metres; the ground is z = 0.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

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
ThingKind = Literal[
    "box", "ball", "column", "board", "figure", "bust", "knot", "hound", "spire", "car", "mirror", "glass"
]
Place = Literal["courtyard", "room", "yard"]
FixedThing = Literal["bonnet", "stamp"]  # a car's bonnet, a burnt-in time stamp
Ambiguity = Literal["colour", "semantic", "none"]
Colour = tuple[float, float, float]  # linear light
FULL_FRAME_DIAGONAL_MM = 43.2666  # of 36 x 24 mm, what `focal_35mm` is an equivalent on
VIDEO_WALKS = ("orbit", "along")  # photos are every tenth frame of a video at 30 frames a second
STATUES = ("bust", "knot", "hound", "spire")  # signed-distance shapes, in the world and as distractors
POSTERS = ("coffee", "rocket", "chelsea", "hubble", "coins", "camera", "retina")
# Textures of objects and distractors; `brick` and `gravel` also cover the courtyard's walls and ground,
# `plaster` the room's walls, `asphalt` the yard's ground. Each is drawn by the function of its name.
TEXTURES = (
    "stone", "foliage", "timber", "clay", "skin", "brick", "gravel", "vivid", "cloth", "plaster", "asphalt",
    "enamel",
)  # fmt: skip
SURFACE_NAMES = ("ground", "wall_back", "wall_left", "wall_right", "wall_front")


@dataclass(frozen=True)
class GroundPlan:
    """A rectangle with walls."""

    ground_m: tuple[float, float]  # of the ground's texture, centred on the origin
    x_m: tuple[float, float]  # range of the inside
    y_m: tuple[float, float]  # range of the inside
    wall_m: float  # height
    walls: tuple[str, ...] = SURFACE_NAMES[1:]
    ceiling: bool = False

    @property
    def surfaces(self) -> Mapping[str, tuple[float, float]]:
        """Width and height of the ground and of each wall; a texture covers each once."""
        across, along = self.x_m[1] - self.x_m[0], self.y_m[1] - self.y_m[0]
        width = {"wall_back": across, "wall_front": across, "wall_left": along, "wall_right": along}
        return {"ground": self.ground_m} | {name: (width[name], self.wall_m) for name in self.walls}

    @property
    def middle(self) -> tuple[float, float]:
        """Centre of the inside, m."""
        return (self.x_m[0] + self.x_m[1]) / 2, (self.y_m[0] + self.y_m[1]) / 2

    @property
    def highest_m(self) -> float:
        """Greatest height of a camera, m."""
        return self.wall_m - 0.3 if self.ceiling else 3.3

    def gap(self, x: float, y: float) -> float:
        """Return the distance to the nearest wall, m, negative outside; an open side counts as wall."""
        return min(x - self.x_m[0], self.x_m[1] - x, y - self.y_m[0], self.y_m[1] - y)


PLANS: Mapping[str, GroundPlan] = {
    "courtyard": GroundPlan((16.0, 14.0), (-5.6, 5.6), (-6.0, 4.2), 3.4, SURFACE_NAMES[1:4]),  # open in front
    "room": GroundPlan((7.2, 6.0), (-3.6, 3.6), (-3.0, 3.0), 2.7, ceiling=True),
    "yard": GroundPlan((18.0, 16.0), (-9.0, 9.0), (-8.0, 8.0), 5.0),
}


@dataclass(frozen=True)
class ExpectedAmbiguity:
    """Label of a capture: the result that measuring it should give."""

    ambiguity: Literal["colour", "semantic", "both", "neither", "unstated"] = "unstated"
    effects: tuple[
        Literal["masks", "local", "global", "entropy", "appearance", "antialiasing", "sh", "pose"], ...
    ] = ()  # effects of the trainer that the capture needs


@dataclass(frozen=True)
class Distractor:
    """An object that has another place in every photo, walks through the capture, or is followed."""

    name: str
    kind: Kind
    texture: str  # stone, foliage, brick, ...; for a placard any texture of the world
    ambiguity: Ambiguity  # why it is hard: the background's colour, the statue's shape, or not at all
    head: str = ""  # texture of a visitor's head and hands; empty: the same
    # Share of the train photos that show it; with path "elsewhere" and `occlusion` above 0, share of the
    # layouts drawn, from which `occlusion` chooses.
    presence: float = 0.85
    distance_m: tuple[float, float] = (1.9, 4.5)  # from the camera; with path "walk" only the minimum counts
    # factor on the natural size: figures 1.75 m, ball 0.8 m, pole 2 m, statues 1.6 m, car 4.1 m
    size: float = 1.0
    lift_m: float = 0.0  # greatest height above the ground
    bend_deg: float = 0.0  # greatest bend of a visitor's trunk, another one in every photo
    blur_m: float = 0.0  # length of its way, to the side that it faces, while the shutter is open
    tint: Colour = (1.0, 1.0, 1.0)  # factor on the texture, in linear light
    # elsewhere: a new place in every photo; walk: along `waypoints`; ahead: in front of the camera, which
    # follows it
    path: Literal["elsewhere", "walk", "ahead"] = "elsewhere"
    # m: x and y of the corners of its walk; at a single one it stands, and a visitor turns every time
    waypoints: tuple[tuple[float, float], ...] = ()
    laps: float = 1.0  # times it walks there and back during the capture


@dataclass(frozen=True)
class Thing:
    """A static object that the spec adds to the place."""

    kind: ThingKind
    texture: str
    at_m: tuple[float, float, float]  # middle of its foot: x to the right, y away from the walk, z up
    # Width, depth, height; of a statue only the height is used, of a car only the width, as its length. A
    # mirror and a pane of glass have a frame of the texture.
    size_m: tuple[float, float, float] = (1.0, 1.0, 1.0)
    yaw_deg: float = 0.0
    tint: Colour = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class WorldSpec:
    """A place, with its ground and walls, and the objects in it."""

    place: Place = "courtyard"
    # courtyard: planters, crates, bench, ball; room: all that stands; yard: cars, trees
    furniture: bool = True
    statue: bool = True  # on its plinth
    things: tuple[Thing, ...] = ()


@dataclass(frozen=True)
class ExposureDrift:
    """Automatic exposure: brightness drifts during the capture."""

    stops: float = 0.7  # largest deviation, in powers of two


@dataclass(frozen=True)
class WhiteBalance:
    """Automatic white balance: photos turn warm and cold."""

    warmth: float = 0.5  # stops between red and blue at most
    tint: float = 0.12  # stops of green against both at most


@dataclass(frozen=True)
class IsoNoise:
    """Shot and read noise of a small sensor."""

    iso: tuple[float, float] = (800.0, 1600.0)  # drawn anew for every photo


@dataclass(frozen=True)
class Vignetting:
    """Darker corners."""

    falloff: float = 0.45  # share of the light that the corners lack


@dataclass(frozen=True)
class LensDistortion:
    """Radial distortion as in COLMAP: x_d = x (1 + k1 r^2 + k2 r^4), of every photo, test photos too."""

    k1: float = -0.12
    k2: float = 0.0


@dataclass(frozen=True)
class MotionBlur:
    """The hand turns while the shutter is open."""

    exposure_s: float = 1 / 60
    speed_deg_s: float = 12.0  # of the hand, at most


@dataclass(frozen=True)
class RollingShutter:
    """The hand turns while the rows are read, from top to bottom."""

    readout_s: float = 1 / 40
    speed_deg_s: float = 12.0  # of the hand, at most


@dataclass(frozen=True)
class Defocus:
    """Some photos are out of focus as a whole."""

    share: float = 0.4  # of the train photos
    radius: tuple[float, float] = (0.0015, 0.004)  # of the disc, in widths of the photo


@dataclass(frozen=True)
class Jpeg:
    """Photos are compressed once more, as by a messenger, with colour at half the resolution."""

    quality: tuple[int, int] = (30, 55)  # 1 to 95, drawn anew for every photo


@dataclass(frozen=True)
class TimeOfDay:
    """Photos at different hours: colour and strength of sun and sky, direction of the sun."""

    strength: float = 1.0  # of the change of colour and brightness
    sweep_deg: float = 25.0  # greatest turn of the sun to either side


@dataclass(frozen=True)
class MovingShadow:
    """A shadow from outside the photo, at another place in every photo."""

    presence: float = 0.85  # share of the train photos with a shadow
    size_m: float = 0.7  # radius of the shadow caster


@dataclass(frozen=True)
class Specular:
    """Polished surfaces: reflections of sun and sky that move with the camera."""

    textures: tuple[str, ...] = ("stone",)  # polished textures
    strength: float = 0.6  # brightness of the highlight relative to the sun
    sharpness: float = 60.0  # exponent: the higher the smaller


@dataclass(frozen=True)
class Effects:
    """The effects of a capture; None = not computed."""

    time_of_day: TimeOfDay | None = None
    moving_shadow: MovingShadow | None = None
    specular: Specular | None = None
    lens_distortion: LensDistortion | None = None
    rolling_shutter: RollingShutter | None = None
    motion_blur: MotionBlur | None = None
    defocus: Defocus | None = None
    vignetting: Vignetting | None = None
    exposure_drift: ExposureDrift | None = None
    white_balance: WhiteBalance | None = None
    iso_noise: IsoNoise | None = None
    jpeg: Jpeg | None = None

    @property
    def changes_colours(self) -> bool:
        """Whether colours differ between photos, as a whole."""
        return any((self.time_of_day, self.exposure_drift, self.white_balance))


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
    # around: look at the hub; outward: stand around it and look away; orbit and along: frames of a video, at
    # constant speed, that look at the hub or along the arc
    walk: Literal["around", "outward", "orbit", "along"] = "around"
    arc_deg: float = 104.0  # arc around the hub that the cameras cover
    radius_m: tuple[float, float] = (4.2, 5.3)  # distance from the hub during the walk
    eye_m: tuple[float, float] = (1.3, 1.8)  # height of the phone
    zoom: tuple[float, float] = (1.0, 1.0)  # range of factors on `focal_35mm`
    world: WorldSpec = field(default_factory=WorldSpec)
    effects: Effects = field(default_factory=Effects)
    fixed: FixedThing | None = None  # fixed to the camera, in every train photo, on top of `occlusion`
    # Distractors cast shadows on the scene; else what is outside of them equals the clean photo.
    cast_shadows: bool = False
    designed: ExpectedAmbiguity = field(default_factory=ExpectedAmbiguity)

    @property
    def has_shadows(self) -> bool:
        """Whether photos may change outside of distractors: by shadows, or by reflections in panes."""
        panes = any(thing.kind == "glass" for thing in self.world.things)
        return self.cast_shadows or panes or self.effects.moving_shadow is not None
