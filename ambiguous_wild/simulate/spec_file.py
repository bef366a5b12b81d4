"""Specs as YAML: read strictly, written so that what is read back is the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import yaml

from ambiguous_wild.core.config import from_plain, to_plain
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.simulate.check import check_spec
from ambiguous_wild.simulate.effects.settings import KINDS, Effects
from ambiguous_wild.simulate.spec import CaptureSpec

LARGEST = 1_000_000  # bytes


class _Loader(yaml.SafeLoader):
    """YAML's safe loader, which takes a key twice and an alias that grows without end; this one does not."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise AwError(f"line {self.peek_event().start_mark.line + 1}: aliases (*name) are not read")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise AwError(f"line {key.start_mark.line + 1}: the key {key.value!r} is there twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """YAML's safe dumper; lists of numbers and words on one line, and no aliases."""

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
        AwError: no such file, no YAML, or a spec that cannot be made: one line, with where it is.
    """
    where = Path(path)
    try:
        if where.stat().st_size > LARGEST:
            raise AwError(f"{where} is larger than {LARGEST // 10**6} MB: that is no spec")
        text = where.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not UTF-8 text"
        raise AwError(f"cannot read the spec {where}: {reason}") from error
    try:
        return parse_spec(text)
    except AwError as error:
        raise AwError(f"{where}: {error}") from None


def parse_spec(text: str) -> CaptureSpec:
    """The capture that YAML text describes.

    Raises:
        AwError: no YAML, an unknown key, a wrong type or a value out of range.
    """
    try:
        data = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or "it does not parse").split())
        raise AwError(f"not YAML{line}: {problem}") from None
    except (ValueError, TypeError, RecursionError) as error:  # 2025-99-99, an unhashable key, 1000 brackets
        raise AwError(f"not YAML that a spec is made of: {error}") from None
    if not isinstance(data, dict):
        raise AwError("a spec is a list of 'key: value' lines; 'aw simulate NAME --print-spec' shows one")
    for key in ("name", "summary"):
        data.setdefault(key, {"name": "capture", "summary": ""}[key])
    effects = _effects(data.pop("effects", {}))
    _lists(data)
    return check_spec(_built(data, effects))


def _built(data: dict[Any, Any], effects: Effects) -> CaptureSpec:
    try:
        spec = from_plain(CaptureSpec, {str(k): v for k, v in data.items()}, "spec")
    except TypeError as error:  # a distractor without its kind
        missing = str(error).partition("missing ")[2].partition(": ")[2] or str(error)
        owner = "distractor" if "Distractor" in str(error) else "thing"
        raise AwError(f"a {owner} of the spec lacks {missing}") from None
    return replace(spec, effects=effects)


def _lists(data: dict[Any, Any]) -> None:
    """Refuse what `from_plain` would take for a list of one."""
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
    """The spec as YAML, every value of it; `parse_spec` gives the same spec back."""
    return yaml.dump(plain_spec(spec), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110)


def plain_spec(spec: CaptureSpec) -> dict[str, Any]:
    """The spec as dicts, lists and scalars; of the effects, those that are named."""
    data: dict[str, Any] = to_plain(spec)
    data["effects"] = {name: value for name, value in data["effects"].items() if value is not None}
    return data
