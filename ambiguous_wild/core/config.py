"""Frozen dataclasses as configs: strict keys, plain data, and a hash as identity; types of plain data."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias, TypeVar

from ambiguous_wild.core.errors import AwError, unknown

# A value that a JSON file can hold, and such values by name: results of a run, facts about it.
Json: TypeAlias = "bool | int | float | str | Sequence[Json] | Mapping[str, Json] | None"
Facts: TypeAlias = dict[str, Json]
# What a checkpoint holds of one object: nested dicts of tensors and plain values, see splat/checkpoint.py.
State: TypeAlias = dict[str, Any]

T = TypeVar("T")
_POWER_OF_TEN = re.compile(r"[-+]?[0-9]+[eE][-+]?[0-9]+")


def to_plain(config: Any) -> Any:
    """Return the config as dicts, lists and scalars, ready for YAML or JSON."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, Mapping):
        return {str(k): to_plain(v) for k, v in config.items()}
    if isinstance(config, (list, tuple)):
        return [to_plain(v) for v in config]
    return config


def flatten(tree: Mapping[str, T], prefix: str = "") -> dict[str, T]:
    """Turn nested mappings into one with dotted keys."""
    flat: dict[str, T] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            flat |= flatten(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def config_hash(config: Any) -> str:
    """sha256 over the canonical JSON of the config: 64 hex digits."""
    text = json.dumps(to_plain(config), sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def from_plain(cls: type[T], data: Mapping[str, Any], where: str = "config") -> T:
    """Build the dataclass from plain data; an unknown key or a wrong type is an error that names it.

    Raises:
        AwError: unknown key (with the nearest known one), wrong type, or a required key is absent.
    """
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    values: dict[str, Any] = {}
    for key, value in data.items():
        if key not in names:
            raise unknown(f"key in {where}", str(key), names)
        values[key] = _coerce(hints[key], value, f"{where}.{key}")
    for f in dataclasses.fields(cls):  # type: ignore[arg-type]
        needed = f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING
        if needed and f.name not in values:
            raise AwError(f"{where} lacks {f.name!r}")
    return cls(**values)


def with_options(config: T, options: Mapping[str, str], where: str = "option", hint: str = "") -> T:
    """Return the config with ``key=value`` strings of the command line applied; dots reach nested configs.

    `hint` ends the message of an unknown key: how to list those that there are.

    Raises:
        AwError: unknown key, a value that does not parse as the key's type, or a negative value for a key
            whose default is positive.
    """
    names = [f.name for f in dataclasses.fields(config)]  # type: ignore[arg-type]
    hints = typing.get_type_hints(type(config))
    values: dict[str, Any] = {}
    nested: dict[str, dict[str, str]] = {}
    for key, text in options.items():
        head, _, rest = key.partition(".")
        if head not in names:
            raise unknown(where, key, names, hint)
        if rest:
            nested.setdefault(head, {})[rest] = text
            continue
        # Texts are not parsed: names of back ends hold commas, and 1e3 may be a name.
        value = text.strip() if hints[head] is str and text.strip() else _parse(text)
        values[head] = _coerce(hints[head], value, f"{where} {key}")
    for head, inside in nested.items():
        inner = getattr(config, head)
        if not dataclasses.is_dataclass(inner):
            key = f"{head}.{next(iter(inside))}"
            raise AwError(f"{where} {key!r}: {head!r} has no keys of its own")
        values[head] = with_options(inner, inside, f"{where} {head}", hint)
    # Apply all options at once: limits between two of them hold for the result only.
    changed = dataclasses.replace(config, **values)  # type: ignore[type-var]
    for name, value in values.items():
        if _positive(getattr(config, name)) and _number(value) and not value >= 0:
            raise AwError(f"{where} {name} is at least 0, got {value:g}")
    return changed


def check_limits(config: Any, where: str, **limits: tuple[float, float]) -> None:
    """Refuse numbers out of range. Each number of a tuple is checked; None passes.

    Args:
        config: the dataclass instance.
        where: prefix of its keys in the message, e.g. ``"refinesplat.mask"``.
        limits: per field the lowest and the highest allowed value; the highest may be infinite.

    Raises:
        AwError: the first number out of range, with the range.
    """
    for name, (low, high) in limits.items():
        value = getattr(config, name)
        for number in value if isinstance(value, tuple) else () if value is None else (value,):
            if not low <= number <= high:
                span = f"at least {low:g}" if math.isinf(high) else f"from {low:g} to {high:g}"
                raise AwError(f"{where}.{name} is {span}, got {number:g}")


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _positive(value: Any) -> bool:
    # rates, weights, counts and times that are positive by default must not become negative
    return _number(value) and value > 0


def _parse(text: str) -> Any:
    lowered = text.strip().lower()
    if lowered in ("none", "null", ""):
        return None
    if lowered in ("true", "false"):
        return lowered == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    if "," in text:
        return [_parse(part) for part in text.split(",")]
    return text


def _coerce(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        for option in options:
            if option is type(None):
                continue
            try:
                return _coerce(option, value, where)
            except AwError:
                continue
        raise _wrong(hint, value, where)
    if origin is typing.Literal:
        if value in typing.get_args(hint):
            return value
        raise unknown(where, str(value), [str(v) for v in typing.get_args(hint)])
    if dataclasses.is_dataclass(hint) and isinstance(value, Mapping):
        return from_plain(typing.cast(type, hint), value, where)
    if origin is tuple:
        args = typing.get_args(hint)
        items = value if isinstance(value, (list, tuple)) else [value]
        if len(args) == 2 and args[1] is Ellipsis:
            if items is not value:
                return (_coerce(args[0], value, where),)
            return tuple(_coerce(args[0], v, f"{where}[{k}]") for k, v in enumerate(items))
        if len(args) != len(items):
            raise AwError(f"{where}: expected {len(args)} values, got {value!r}")
        return tuple(_coerce(a, v, where) for a, v in zip(args, items))
    if origin in (dict, Mapping) or hint in (dict, Any):
        return value
    if hint is float and isinstance(value, str) and _POWER_OF_TEN.fullmatch(value):
        value = float(value)  # YAML 1.1 reads 1e-3 as text: it wants a dot
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:  # a whole number of more than 308 digits
            number = math.inf
        if not math.isfinite(number):
            raise AwError(f"{where}: expected a finite number, got {number}")
        return number
    if hint is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if isinstance(hint, type) and isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
        return value
    if hint is str and isinstance(value, (int, float)):
        return str(value)
    raise _wrong(hint, value, where)


def _wrong(hint: Any, value: Any, where: str) -> AwError:
    name = getattr(hint, "__name__", str(hint))
    return AwError(f"{where}: expected {name}, got {value!r}")
