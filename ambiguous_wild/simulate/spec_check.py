"""Check every number and name of a spec before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import fields

import numpy as np

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.simulate.ground_plan import PLANS, GroundPlan
from ambiguous_wild.simulate.image_effects.settings import Effects, LensDistortion
from ambiguous_wild.simulate.spec import FULL_FRAME_DIAGONAL_MM, CaptureSpec, Distractor, Thing

# Textures that `world.py` bakes (a test compares the two lists).
SHEET_NAMES = (
    "stone",
    "foliage",
    "timber",
    "clay",
    "skin",
    "brick",
    "gravel",
    "vivid",
    "cloth",
    "plaster",
    "asphalt",
    "enamel",
)
PICTURES = tuple(
    f"poster_{name}" for name in ("coffee", "rocket", "chelsea", "hubble", "coins", "camera", "retina")
)

MOST = 255  # distractors: the ray caster stores a pixel's distractor in a byte


def check_spec(spec: CaptureSpec) -> CaptureSpec:
    """Return the spec, or refuse it.

    Raises:
        AwError: the first wrong value: where it is, what it is, what is allowed.
    """
    plan = PLANS[spec.world.place]
    if not spec.name or not all(c.isalnum() or c in "-_" for c in spec.name):
        raise AwError(f"name: letters, digits, - and _ only, got {spec.name!r}")
    _between("train_views", spec.train_views, 3, 2000)
    _between("test_views", spec.test_views, 1, 2000)
    _between("width", spec.width, 64, 4096)
    _between("height", spec.height, 36, 4096)
    if not 1 <= spec.samples <= 64 or math.isqrt(spec.samples) ** 2 != spec.samples:
        raise AwError(f"samples: a square number from 1 to 64, got {spec.samples}")
    _between("detail_px_per_m", spec.detail_px_per_m, 2, 300)
    _between("focal_35mm", spec.focal_35mm, 10, 200)
    around = spec.walk == "around"
    _between("arc_deg", spec.arc_deg, 5, 150 if around else 360)
    _range("occlusion", spec.occlusion, 0, 0.9)
    _range("radius_m", spec.radius_m, 1.5 if around else 0.2, 7)
    _range("eye_m", spec.eye_m, 0.2, plan.highest_m)
    _range("zoom", spec.zoom, 0.5, 4)
    if len(spec.distractors) > MOST:
        raise AwError(f"distractors: at most {MOST}, got {len(spec.distractors)}")
    for k, distractor in enumerate(spec.distractors):
        if not distractor.name.strip():
            raise AwError(f"distractors[{k}].name: empty; capture.json lists the placed distractors by name")
        if distractor.name in (d.name for d in spec.distractors[:k]):
            raise AwError(f"distractors[{k}].name: {distractor.name!a} is there twice; give each its own")
        if distractor.head and distractor.kind != "visitor":
            raise AwError(f"distractors[{k}].head: only a visitor has one, not a {distractor.kind}")
        _distractor(f"distractors[{k}]", distractor, plan)
    for k, thing in enumerate(spec.world.things):
        _thing(f"world.things[{k}]", thing, plan)
    _effects(spec.effects, plan)
    if spec.effects.lens_distortion is not None:
        _lens(spec, spec.effects.lens_distortion)
    return spec


def _lens(spec: CaptureSpec, lens: LensDistortion) -> None:
    """Refuse a distortion that is not invertible within the photo."""
    corner = 0.5 * FULL_FRAME_DIAGONAL_MM / (spec.focal_35mm * spec.zoom[0])
    r = np.linspace(0.0, 4.0 * corner, 4001)
    bent = r * (1 + lens.k1 * r**2 + lens.k2 * r**4)
    until = int(np.argmax(np.diff(bent) <= 0)) if (np.diff(bent) <= 0).any() else len(r) - 1
    if bent[until] < 1.02 * corner:  # a moving hand looks a little further
        raise AwError(
            f"effects.lens_distortion: k1 {lens.k1:g}, k2 {lens.k2:g} fold the picture inside its corners at "
            f"focal_35mm {spec.focal_35mm:g}, zoom {spec.zoom[0]:g}; raise the focal length or lower k1, k2"
        )


def _distractor(where: str, d: Distractor, plan: GroundPlan) -> None:
    known = (*SHEET_NAMES, *PICTURES, *plan.surfaces) if d.kind == "placard" else SHEET_NAMES
    _texture(f"{where}.texture", d.texture, known)
    if d.head:
        _texture(f"{where}.head", d.head, SHEET_NAMES)
    _between(f"{where}.size", d.size, 0.02, 10)
    _between(f"{where}.presence", d.presence, 0, 1)
    _between(f"{where}.lift_m", d.lift_m, 0, 3)
    _between(f"{where}.laps", d.laps, 0, 100)
    _range(f"{where}.distance_m", d.distance_m, 0.3, 12)
    _colour(f"{where}.tint", d.tint)
    if d.path == "walk" and len(d.waypoints) < 2:
        raise AwError(f"{where}.waypoints: a walk needs two corners or more, [[x, y], [x, y]] in metres")
    if d.path == "elsewhere" and d.waypoints:
        raise AwError(f"{where}.waypoints: only read with 'path: walk'; add that or leave them out")
    if d.path == "elsewhere" and d.laps != Distractor.laps:
        raise AwError(f"{where}.laps: only read with 'path: walk'; add that or leave it out")
    for x, y in d.waypoints:
        _between(f"{where}.waypoints x", x, plan.x_m[0] + 0.6, plan.x_m[1] - 0.6)
        _between(f"{where}.waypoints y", y, plan.y_m[0], plan.y_m[1] - 0.2)


def _thing(where: str, thing: Thing, plan: GroundPlan) -> None:
    known = (*SHEET_NAMES, *PICTURES, *plan.surfaces) if thing.kind == "board" else SHEET_NAMES
    _texture(f"{where}.texture", thing.texture, known)
    for value in thing.size_m:
        _between(f"{where}.size_m", value, 0.01, 12)
    for axis, value, limits in zip("xyz", thing.at_m, (plan.x_m, plan.y_m, (0.0, 4.0))):
        _between(f"{where}.at_m {axis}", value, *limits)
    _between(f"{where}.yaw_deg", thing.yaw_deg, -360, 360)
    _colour(f"{where}.tint", thing.tint)


def _effects(effects: Effects, plan: GroundPlan) -> None:
    limits: dict[str, dict[str, tuple[float, float]]] = {
        "exposure_drift": {"stops": (0, 3)},
        "white_balance": {"warmth": (0, 2), "tint": (0, 1)},
        "iso_noise": {"iso": (50, 25600)},
        "vignetting": {"falloff": (0, 0.9)},
        "lens_distortion": {"k1": (-0.3, 0.3), "k2": (-0.1, 0.1)},
        "motion_blur": {"exposure_s": (1e-5, 0.5), "speed_deg_s": (0, 60)},
        "rolling_shutter": {"readout_s": (0, 0.2), "speed_deg_s": (0, 60)},
        "defocus": {"share": (0, 1), "radius": (0, 0.02)},
        "jpeg": {"quality": (1, 95)},
        "time_of_day": {"strength": (0, 2), "sweep_deg": (0, 90)},
        "moving_shadow": {"presence": (0, 1), "size_m": (0.05, 3)},
        "specular": {"strength": (0, 3), "sharpness": (1, 1000)},
    }
    for field in fields(Effects):
        settings = getattr(effects, field.name)
        if settings is None:
            continue
        for key, (low, high) in limits[field.name].items():
            value, where = getattr(settings, key), f"effects.{field.name}.{key}"
            if isinstance(value, tuple):
                _range(where, value, low, high)
            else:
                _between(where, value, low, high)
    if effects.specular is not None:
        if not effects.specular.textures:
            raise AwError("effects.specular.textures: name at least one, or leave the effect out")
        for name in effects.specular.textures:
            _texture("effects.specular.textures", name, (*SHEET_NAMES, *plan.surfaces))


def _between(where: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise AwError(f"{where}: between {low:g} and {high:g}, got {_short(value)}")


def _short(value: float) -> str:
    """The number as text, also where it is too large for a float."""
    try:
        return f"{value:g}"
    except OverflowError:
        return "a huge number"


def _range(where: str, pair: Sequence[float], low: float, high: float) -> None:
    for value in pair:
        _between(where, value, low, high)
    if pair[0] > pair[1]:
        raise AwError(f"{where}: the smaller number first, got [{pair[0]:g}, {pair[1]:g}]")


def _colour(where: str, colour: Iterable[float]) -> None:
    for value in colour:
        _between(where, value, 0, 4)


def _texture(where: str, name: str, known: Sequence[str]) -> None:
    if name not in known:
        raise unknown(f"texture in {where}", name, known)
