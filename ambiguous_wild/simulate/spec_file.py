"""Read and write specs as YAML: reading checks every number and name, writing loses nothing."""

from __future__ import annotations

import math
import typing
from collections.abc import Collection, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ambiguous_wild.core.config import from_plain, to_plain
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.core.names import check_name
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.simulate.spec import (
    FULL_FRAME_DIAGONAL_MM,
    PLANS,
    POSTERS,
    TEXTURES,
    CaptureSpec,
    Distractor,
    Effects,
    GroundPlan,
    LensDistortion,
    Thing,
)

PICTURES = tuple(f"poster_{name}" for name in POSTERS)
MAX_DISTRACTORS = 254  # a pixel's distractor is stored in a byte; 255 is what is fixed to the camera
MAX_THINGS = 200  # a pixel's static object is stored in a byte; places have up to 20 of their own
_LEAST_PANE_M = 0.15  # with a frame of 5 cm
KINDS: dict[str, type] = {
    name: next(kind for kind in typing.get_args(hint) if kind is not type(None))
    for name, hint in typing.get_type_hints(Effects).items()
}  # settings by name of the effect
_SPEC: Limits = {
    "train_views": (3, 2000),
    "test_views": (1, 2000),
    "width": (64, 4096),
    "height": (36, 4096),
    "detail_px_per_m": (2, 300),
    "focal_35mm": (10, 200),
    "occlusion": (0, 0.9),
    "zoom": (0.5, 4),
}
_WALKS: dict[str, Limits] = {
    "around": {"arc_deg": (5, 150), "radius_m": (1.5, 7)},
    "outward": {"arc_deg": (5, 360), "radius_m": (0.2, 7)},
    "orbit": {"arc_deg": (5, 150), "radius_m": (1.5, 7)},
    "along": {"arc_deg": (5, 360), "radius_m": (0.5, 7)},
}
_DISTRACTOR: Limits = {
    "size": (0.02, 10),
    "presence": (0, 1),
    "lift_m": (0, 3),
    "bend_deg": (0, 100),
    "blur_m": (0, 1),
    "laps": (0, 100),
    "distance_m": (0.3, 12),
    "tint": (0, 4),
}
_THING: Limits = {"size_m": (0.01, 12), "yaw_deg": (-360, 360), "tint": (0, 4)}
_EFFECTS: dict[str, Limits] = {
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


class _Dumper(yaml.SafeDumper):
    """YAML's safe dumper, with lists of scalars on one line and without aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_sequence(self, tag: str, sequence: Any, flow_style: Any = None) -> Any:
        node = super().represent_sequence(tag, sequence, flow_style)
        node.flow_style = not any(isinstance(child, yaml.MappingNode) for child in node.value)
        return node


def is_spec_file(name: str) -> bool:
    """Tell whether a word names a file rather than a preset."""
    return name.lower().endswith((".yaml", ".yml")) or "/" in name


def read_spec(path: Path | str) -> CaptureSpec:
    """Read the spec of a capture from a YAML file.

    Raises:
        AwError: no such file, no YAML, or a wrong value; the message names its place.
    """
    where = Path(path)
    text = plain_yaml.read_text(where)
    try:
        return parse_spec(text)
    except AwError as error:
        raise AwError(f"{where}: {error}") from None


def parse_spec(text: str) -> CaptureSpec:
    """Read the spec of a capture from YAML text.

    Raises:
        AwError: no YAML, an unknown key, a wrong type or a value out of range.
    """
    data = plain_yaml.parse(text)
    if not isinstance(data, dict):
        raise AwError("a spec is a list of 'key: value' lines; 'aw simulate NAME --print-spec' shows one")
    return spec_of({"name": "capture", "summary": "", **data})


def spec_of(data: dict[Any, Any]) -> CaptureSpec:
    """Convert plain data to a spec; raises like `parse_spec`."""
    _lists(data)
    rest = {str(key): value for key, value in data.items() if key != "effects"}
    spec = from_plain(CaptureSpec, rest, "spec")
    return check_spec(replace(spec, effects=_read_effects(data.get("effects", {}))))


def _lists(data: dict[Any, Any]) -> None:
    """Refuse single values where lists are needed, because `from_plain` would wrap them."""
    world = data.get("world", {})
    if not isinstance(world, Mapping):
        raise AwError(f"world: keys below it, got {world!r}")
    for where, owner, key in (("", data, "distractors"), ("world.", world, "things")):
        items = owner.get(key, [])
        if not isinstance(items, list) or not all(isinstance(item, Mapping) for item in items):
            raise AwError(f"{where}{key}: a list with one '- kind: ...' for each")
    designed = data.get("designed", {})
    if not isinstance(designed, Mapping):
        raise AwError(f"designed: the keys ambiguity and effects, got {designed!r}")
    wanted = designed.get("effects", [])
    if not isinstance(wanted, list) or len({str(name) for name in wanted}) < len(wanted):
        raise AwError(f"designed.effects: a list that names each effect once, got {wanted!r}")


def _read_effects(named: Any) -> Effects:
    if not isinstance(named, Mapping):
        raise AwError(f"effects: one 'effect: {{}}' a line, got {named!r}")
    values: dict[str, Any] = {}
    for name, settings in named.items():
        if name not in KINDS:
            raise unknown("effect", str(name), KINDS, "docs/simulation.md lists them")
        if not isinstance(settings, Mapping):
            keys = ", ".join(f.name for f in fields(KINDS[name]))
            raise AwError(f"effects.{name}: {{}} for its defaults, or some of {keys}; got {settings!r}")
        values[name] = from_plain(KINDS[name], settings, f"effects.{name}")
    return Effects(**values)


def dump_spec(spec: CaptureSpec) -> str:
    """Write the spec as YAML with every value; `parse_spec` returns an equal spec."""
    return yaml.dump(plain_spec(spec), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def plain_spec(spec: CaptureSpec) -> dict[str, Any]:
    """Convert the spec to dicts, lists and scalars; effects that are None are left out."""
    data: dict[str, Any] = to_plain(spec)
    data["effects"] = {name: value for name, value in data["effects"].items() if value is not None}
    return data


# Least and greatest value of each number; in pairs the smaller number comes first.
Limits = dict[str, tuple[float, float]]


def check_spec(spec: CaptureSpec) -> CaptureSpec:
    """Return the spec, or refuse it.

    Raises:
        AwError: the first wrong value, with its place and what is allowed.
    """
    plan = PLANS[spec.world.place]
    check_name("name", spec.name)
    _within("", spec, {**_SPEC, **_WALKS[spec.walk], "eye_m": (0.2, plan.highest_m)})
    if not 1 <= spec.samples <= 64 or math.isqrt(spec.samples) ** 2 != spec.samples:
        raise AwError(f"samples: a square number from 1 to 64, got {spec.samples}")
    if len(spec.distractors) > MAX_DISTRACTORS:
        raise AwError(f"distractors: at most {MAX_DISTRACTORS}, got {len(spec.distractors)}")
    for k, distractor in enumerate(spec.distractors):
        if not distractor.name.strip():
            raise AwError(f"distractors[{k}].name: empty; capture.json lists the placed distractors by name")
        if distractor.name in (d.name for d in spec.distractors[:k]):
            raise AwError(f"distractors[{k}].name: {distractor.name!a} occurs twice; give each its own")
        _distractor(f"distractors[{k}].", distractor, plan)
        if distractor.blur_m and math.isqrt(spec.samples) % 2:
            raise AwError(
                f"distractors[{k}].blur_m: four neighbouring rays see four instants, so samples must be 4, "
                f"16, 36 or 64, got {spec.samples}"
            )
    if len(spec.world.things) > MAX_THINGS:
        raise AwError(f"world.things: at most {MAX_THINGS}, got {len(spec.world.things)}")
    for k, thing in enumerate(spec.world.things):
        _thing(f"world.things[{k}].", thing, plan)
    for name, limits in _EFFECTS.items():
        if (settings := getattr(spec.effects, name)) is not None:
            _within(f"effects.{name}.", settings, limits)
    if spec.effects.specular is not None:
        if not spec.effects.specular.textures:
            raise AwError("effects.specular.textures: name at least one, or leave the effect out")
        for name in spec.effects.specular.textures:
            _texture("effects.specular.textures", name, (*TEXTURES, *plan.surfaces))
    if spec.effects.lens_distortion is not None:
        _lens(spec, spec.effects.lens_distortion)
    return spec


def _lens(spec: CaptureSpec, lens: LensDistortion) -> None:
    """Refuse a distortion that is not invertible within the photo."""
    corner = 0.5 * FULL_FRAME_DIAGONAL_MM / (spec.focal_35mm * spec.zoom[0])
    r = np.linspace(0.0, 4.0 * corner, 4001)
    bent = r * (1 + lens.k1 * r**2 + lens.k2 * r**4)
    until = int(np.argmax(np.diff(bent) <= 0)) if (np.diff(bent) <= 0).any() else len(r) - 1
    if bent[until] < 1.02 * corner:  # a moving hand looks a little beyond the corner
        raise AwError(
            f"effects.lens_distortion: k1 {lens.k1:g}, k2 {lens.k2:g} fold the picture inside its corners at "
            f"focal_35mm {spec.focal_35mm:g}, zoom {spec.zoom[0]:g}; raise the focal length or lower k1, k2"
        )


def _distractor(where: str, d: Distractor, plan: GroundPlan) -> None:
    known = (*TEXTURES, *PICTURES, *plan.surfaces) if d.kind == "placard" else TEXTURES
    _texture(f"{where}texture", d.texture, known)
    if d.head:
        if d.kind != "visitor":
            raise AwError(f"{where}head: only a visitor has one, not a {d.kind}")
        _texture(f"{where}head", d.head, TEXTURES)
    _within(where, d, _DISTRACTOR)
    if d.path == "walk" and not d.waypoints:
        raise AwError(
            f"{where}waypoints: a walk needs corners, [[x, y], [x, y]] in metres; one to stand there"
        )
    if d.bend_deg and d.kind != "visitor":
        raise AwError(f"{where}bend_deg: only a visitor bends, not a {d.kind}")
    if d.path != "walk" and d.waypoints:
        raise AwError(f"{where}waypoints: only read with 'path: walk'; add that or leave them out")
    if d.path != "walk" and d.laps != Distractor.laps:
        raise AwError(f"{where}laps: only read with 'path: walk'; add that or leave it out")
    for x, y in d.waypoints:
        _between(f"{where}waypoints x", x, plan.x_m[0] + 0.6, plan.x_m[1] - 0.6)
        _between(f"{where}waypoints y", y, plan.y_m[0], plan.y_m[1] - 0.2)


def _thing(where: str, thing: Thing, plan: GroundPlan) -> None:
    known = (*TEXTURES, *PICTURES, *plan.surfaces) if thing.kind == "board" else TEXTURES
    _texture(f"{where}texture", thing.texture, known)
    _within(where, thing, _THING)
    if thing.kind in ("mirror", "glass") and min(thing.size_m[0], thing.size_m[2]) < _LEAST_PANE_M:
        raise AwError(
            f"{where}size_m: a {thing.kind} with its frame is at least {_LEAST_PANE_M:g} m wide and high"
        )
    for axis, value, limits in zip("xyz", thing.at_m, (plan.x_m, plan.y_m, (0.0, 4.0))):
        _between(f"{where}at_m {axis}", value, *limits)


def _within(where: str, record: Any, limits: Limits) -> None:
    """Check a record's numbers, each number of a tuple too, and the order of pairs."""
    for key, (low, high) in limits.items():
        value = getattr(record, key)
        for number in value if isinstance(value, tuple) else (value,):
            _between(f"{where}{key}", number, low, high)
        if isinstance(value, tuple) and len(value) == 2 and value[0] > value[1]:
            raise AwError(f"{where}{key}: the smaller number first, got [{value[0]:g}, {value[1]:g}]")


def _between(where: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        try:
            text = f"{value:g}"
        except OverflowError:  # a whole number that is too large for a float
            text = "a huge number"
        raise AwError(f"{where}: between {low:g} and {high:g}, got {text}")


def _texture(where: str, name: str, textures: Collection[str]) -> None:
    if name not in textures:
        raise unknown(f"texture in {where}", name, textures)
