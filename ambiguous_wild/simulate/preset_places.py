"""Presets of the room and the yard."""

from __future__ import annotations

from dataclasses import replace

from ambiguous_wild.simulate.preset_distractors import BLUE, PARCEL, RED, designed
from ambiguous_wild.simulate.room import SOFA
from ambiguous_wild.simulate.spec import CaptureSpec, Distractor, WorldSpec

_ROOM = CaptureSpec(
    "room",
    "a furnished room: a visitor in the walls' paint, a second bust, a bright parcel",
    (
        Distractor("visitor in plaster", "visitor", "plaster", "colour", head="skin", distance_m=(1.5, 3.4)),
        Distractor("second bust", "bust", "stone", "semantic", distance_m=(1.3, 3.2), size=0.6),
        replace(PARCEL, distance_m=(1.3, 3.0), size=0.7),
    ),
    radius_m=(1.9, 2.5),
    arc_deg=120.0,
    eye_m=(1.25, 1.7),
    detail_px_per_m=160.0,
    world=WorldSpec(place="room"),
    designed=designed("both"),
)
_YARD = CaptureSpec(
    "yard",
    "a yard seen from its middle: a car and a visitor that look like what stands there, a bright parcel",
    (
        Distractor("second car", "car", "enamel", "semantic", distance_m=(3.6, 6.0), tint=(0.42, 0.03, 0.03)),
        Distractor("visitor in asphalt", "visitor", "asphalt", "colour", head="skin", distance_m=(1.6, 4.0)),
        replace(PARCEL, distance_m=(1.6, 3.6)),
    ),
    radius_m=(0.9, 1.5),
    arc_deg=360.0,
    walk="outward",
    occlusion=(0.08, 0.25),
    detail_px_per_m=80.0,
    world=WorldSpec(place="yard"),
    designed=designed("both"),
)


def _plain(
    spec: CaptureSpec, name: str, summary: str, nearest: float, farthest: float, size: float
) -> CaptureSpec:
    things = tuple(replace(d, distance_m=(nearest, farthest), size=size) for d in (RED, BLUE, PARCEL))
    things = (replace(things[0], size=1.0), *things[1:])
    return replace(spec, name=name, summary=summary, distractors=things, designed=designed("neither"))


def _clean(spec: CaptureSpec, name: str, summary: str) -> CaptureSpec:
    label = designed("neither", distractors=False)
    return replace(spec, name=name, summary=summary, distractors=(), occlusion=(0.0, 0.0), designed=label)


PLACES = (
    _ROOM,
    replace(
        _ROOM,
        name="room-colour",
        summary="the room; a visitor in the walls' paint, one in the sofa's cloth, a wooden parcel",
        distractors=(
            _ROOM.distractors[0],
            replace(_ROOM.distractors[0], name="visitor in cloth", texture="cloth", head="", tint=SOFA),
            replace(_ROOM.distractors[2], name="wooden parcel", texture="timber", ambiguity="colour"),
        ),
        designed=designed("colour"),
    ),
    _plain(
        _ROOM, "room-plain", "the room; a visitor, a ball and a parcel in colours of their own", 1.1, 2.8, 0.7
    ),
    _clean(_ROOM, "room-clean", "the room without distractors: plain walls, windows, gloss"),
    _YARD,
    replace(
        _YARD,
        name="yard-cars",
        summary="the yard; two cars like the parked ones",
        distractors=(
            _YARD.distractors[0],
            replace(_YARD.distractors[0], name="third car", tint=(0.55, 0.56, 0.58)),
        ),
        occlusion=(0.0, 0.22),
        designed=designed("both"),
    ),
    _plain(
        _YARD, "yard-plain", "the yard; a visitor, a ball and a parcel in colours of their own", 1.5, 4.0, 1.0
    ),
    _clean(_YARD, "yard-clean", "the yard without distractors: few overlaps, much sky"),
)
