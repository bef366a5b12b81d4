"""Placeholders in commands and paths: ``{scene}``, ``{index:05d}``; names only, no expressions."""

from __future__ import annotations

import glob
import string
from collections.abc import Iterable, Mapping
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown

_FORMATTER = string.Formatter()


def placeholders(template: str, where: str) -> set[str]:
    """Names in braces.

    Raises:
        AwError: a brace without its partner, or more than a name in braces.
    """
    try:
        parts = list(_FORMATTER.parse(template))
    except ValueError as error:
        raise AwError(f"{where}: {template!r}: {error}; write {{{{ for a brace that is meant") from None
    names = {name for _, name, _, _ in parts if name is not None}
    for name in names:
        if not name.isidentifier():
            raise AwError(f"{where}: {{{name}}} in {template!r} is no placeholder: write a name")
    return names


def check(template: str, known: Iterable[str], where: str) -> set[str]:
    """The placeholders of a template.

    Raises:
        AwError: one is not known; names the nearest.
    """
    names, choices = placeholders(template, where), set(known)
    for name in sorted(names - choices):
        raise unknown(f"placeholder in {where}", name, choices, "{{ is a brace that is meant")
    return names


def fill(template: str, values: Mapping[str, Any]) -> str:
    """The template with values in place; a value stays within the one argument it stands in."""
    try:
        return _FORMATTER.vformat(template, (), values)
    except (ValueError, TypeError, KeyError) as error:
        raise AwError(f"{template!r} cannot be filled in: {error}") from None


def fill_pattern(template: str, values: Mapping[str, Any]) -> str:
    """The same for a glob pattern: wildcards of the template work, those in values are plain text."""
    escaped = {k: glob.escape(v) if isinstance(v, str) else v for k, v in values.items()}
    return fill(template, escaped)
