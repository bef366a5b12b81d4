"""Named captures as frozen dataclasses: what stands where, how often, and what makes it hard."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from ambiguous_wild.core.errors import AwError, unknown

Kind = Literal["visitor", "twin", "parcel", "ball", "pole", "barrier", "banner"]
Ambiguity = Literal["colour", "semantic", "none"]
Colour = tuple[float, float, float]

# Nothing in the courtyard is of these, in linear light.
CRIMSON: Colour = (0.72, 0.015, 0.04)
AZURE: Colour = (0.02, 0.22, 0.75)


@dataclass(frozen=True)
class Distractor:
    """Something that stands elsewhere in every photo."""

    name: str
    kind: Kind
    texture: str  # a sheet of the world: stone, foliage, timber, brick, gravel, vivid, cloth
    ambiguity: Ambiguity  # why it is hard: the background's colour, the statue's shape, or not at all
    head: str = ""  # a visitor's head and hands, where they are not of the same sheet
    presence: float = 0.85  # share of the train photos in which it is put
    distance_m: tuple[float, float] = (1.9, 4.5)  # from the camera
    size: float = 1.0  # times its natural size: figures 1.75 m, ball 0.8 m, pole 2 m
    lift_m: float = 0.0  # how far above the ground it may fly
    tint: Colour = (1.0, 1.0, 1.0)  # the texture is multiplied by it, in linear light


@dataclass(frozen=True)
class CaptureSpec:
    """A capture to make. The same spec and seed give the same bytes."""

    name: str
    summary: str
    distractors: tuple[Distractor, ...] = ()
    occlusion: tuple[float, float] = (0.10, 0.25)  # share of a train photo's pixels, between which it is kept
    train_views: int = 30
    test_views: int = 8
    width: int = 960  # px; a factor of 4 gives 240 x 135
    height: int = 540  # px
    samples: int = 4  # rays a pixel, a square number
    detail_px_per_m: float = 110.0  # resolution of the textures
    focal_35mm: float = 26.0  # mm, the equivalent that phones state (CIPA: same diagonal angle)
    arc_deg: float = 104.0  # how far around the statue the walk goes
    radius_m: tuple[float, float] = (4.2, 5.3)  # distance from the statue during the walk
    eye_m: tuple[float, float] = (1.3, 1.8)  # height of the phone


VISITOR = Distractor("visitor in brick", "visitor", "brick", "colour", head="skin")
TWIN = Distractor("second statue", "twin", "stone", "semantic")
PARCEL = Distractor("bright parcel", "parcel", "vivid", "none", distance_m=(1.8, 3.6))
LEAVES = Distractor("visitor in leaves", "visitor", "foliage", "colour")
GRAVEL = Distractor("parcel in gravel", "parcel", "gravel", "colour", distance_m=(1.8, 3.6))
RED = Distractor("visitor in red", "visitor", "cloth", "none", head="skin", tint=CRIMSON)
BLUE = Distractor("blue ball", "ball", "cloth", "none", distance_m=(1.8, 3.6), tint=AZURE)


def _thin(name: str, kind: Kind, texture: str, **more: Any) -> Distractor:
    return Distractor(name, kind, texture, "colour", distance_m=(1.4, 3.2), presence=0.9, **more)


_THIN = (
    _thin("wooden pole", "pole", "timber"),
    _thin("pole of brick", "pole", "brick"),
    _thin("rope barrier", "barrier", "stone"),
    _thin("banner in brick", "banner", "brick"),
    _thin("pebble", "ball", "gravel", size=0.22, lift_m=1.9),
    _thin("clod of leaves", "ball", "foliage", size=0.26, lift_m=1.9),
    replace(_thin("red ball", "ball", "cloth", size=0.2, lift_m=1.9, tint=CRIMSON), ambiguity="none"),
)


def _near(distractor: Distractor) -> Distractor:
    return replace(distractor, presence=0.95, distance_m=(1.4, 3.6))


def _far(distractor: Distractor) -> Distractor:
    return replace(distractor, presence=0.6, distance_m=(2.8, 5.0))


PRESETS = {
    spec.name: spec
    for spec in (
        CaptureSpec(
            "courtyard",
            "a visitor dressed like the wall, a second statue, a bright parcel",
            (VISITOR, TWIN, PARCEL),
        ),
        CaptureSpec(
            "courtyard-colour",
            "three distractors that wear the background's own texture",
            (VISITOR, LEAVES, GRAVEL),
        ),
        CaptureSpec(
            "courtyard-twin",
            "two statues like the one that stands still",
            (TWIN, replace(TWIN, name="third statue")),
        ),
        CaptureSpec(
            "courtyard-plain",
            "a visitor, a ball and a parcel in colours that nothing else has: the easy case",
            (RED, BLUE, PARCEL),
            occlusion=(0.14, 0.26),
        ),
        CaptureSpec(
            "courtyard-thin",
            "poles, a rope, a banner and small balls, most in the background's colours",
            _THIN,
            occlusion=(0.03, 0.09),
        ),
        CaptureSpec(
            "courtyard-sparse",
            "the courtyard's distractors, fewer and farther: about 5 % of a photo",
            (_far(VISITOR), _far(TWIN), _far(PARCEL)),
            occlusion=(0.02, 0.08),
        ),
        CaptureSpec(
            "courtyard-crowd",
            "a crowd of eight of every kind: about 45 % of a photo",
            tuple(
                _near(d)
                for d in (VISITOR, LEAVES, RED, replace(VISITOR, name="visitor in wood", texture="timber"))
            )
            + tuple(_near(d) for d in (TWIN, GRAVEL, PARCEL, BLUE)),
            occlusion=(0.37, 0.53),
        ),
        CaptureSpec("courtyard-clean", "nobody there: the upper bound", occlusion=(0.0, 0.0)),
        CaptureSpec(
            "tiny",
            "the courtyard in small, for tests",
            (VISITOR, TWIN, PARCEL),
            train_views=12,
            test_views=3,
            width=320,
            height=180,
            detail_px_per_m=48.0,
            arc_deg=70.0,
        ),
    )
}


def preset(name: str) -> CaptureSpec:
    """The named capture.

    Raises:
        AwError: there is none of that name; the nearest one is named.
    """
    if name not in PRESETS:
        raise unknown("capture", name, PRESETS, "'aw simulate --list' lists them")
    return PRESETS[name]


def resized(spec: CaptureSpec, views: int | None = None, width: int | None = None) -> CaptureSpec:
    """The spec with another number of train photos or another picture width (16:9, textures to match).

    Raises:
        AwError: fewer than 3 photos, or a width outside 64 to 4096 px.
    """
    if views is not None:
        if not 3 <= views <= 2000:
            raise AwError(f"--views {views}: a capture has 3 to 2000 train photos")
        test = max(2, round(views * spec.test_views / spec.train_views))
        spec = replace(spec, train_views=views, test_views=test)
    if width is not None:
        if not 64 <= width <= 4096:
            raise AwError(f"--width {width}: a photo is 64 to 4096 px wide")
        detail = min(spec.detail_px_per_m * max(width / spec.width, 0.3), 220.0)
        height = max(2, 2 * round(width * spec.height / spec.width / 2))
        spec = replace(spec, width=width, height=height, detail_px_per_m=detail)
    return spec
