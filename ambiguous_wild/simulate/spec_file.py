"""Specs as YAML: strict reading, lossless writing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import yaml

from ambiguous_wild.core.config import from_plain, to_plain
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.simulate.image_effects.settings import KINDS, Effects
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.spec_check import check_spec


class _Dumper(yaml.SafeDumper):
    """YAML's safe dumper, with lists of scalars on one line and without aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_sequence(self, tag: str, sequence: Any, flow_style: Any = None) -> Any:
        node = super().represent_sequence(tag, sequence, flow_style)
        node.flow_style = not any(isinstance(child, yaml.MappingNode) for child in node.value)
        return node


def is_spec_file(name: str) -> bool:
    """Whether the word names a file rather than a preset."""
    return name.lower().endswith((".yaml", ".yml")) or "/" in name


def read_spec(path: Path | str) -> CaptureSpec:
    """The capture that a YAML file describes.

    Raises:
        AwError: no such file, no YAML, or a wrong value; names the place.
    """
    where = Path(path)
    text = plain_yaml.read_text(where)
    try:
        return parse_spec(text)
    except AwError as error:
        raise AwError(f"{where}: {error}") from None


def parse_spec(text: str) -> CaptureSpec:
    """The capture that YAML text describes.

    Raises:
        AwError: no YAML, an unknown key, a wrong type or a value out of range.
    """
    data = plain_yaml.parse(text)
    if not isinstance(data, dict):
        raise AwError("a spec is a list of 'key: value' lines; 'aw simulate NAME --print-spec' shows one")
    for key in ("name", "summary"):
        data.setdefault(key, {"name": "capture", "summary": ""}[key])
    effects = _effects(data.pop("effects", {}))
    _lists(data)
    return check_spec(_built(data, effects))


def _built(data: dict[Any, Any], effects: Effects) -> CaptureSpec:
    spec = from_plain(CaptureSpec, {str(k): v for k, v in data.items()}, "spec")
    return replace(spec, effects=effects)


def _lists(data: dict[Any, Any]) -> None:
    """Refuse single values where lists are needed: `from_plain` would wrap them."""
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


def _effects(named: Any) -> Effects:
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
    """The spec as YAML with every value; `parse_spec` returns an equal spec."""
    return yaml.dump(plain_spec(spec), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def plain_spec(spec: CaptureSpec) -> dict[str, Any]:
    """The spec as dicts, lists and scalars; effects that are None are left out."""
    data: dict[str, Any] = to_plain(spec)
    data["effects"] = {name: value for name, value in data["effects"].items() if value is not None}
    return data
