"""Variants of a step on a GPU that are waiting for a measurement; the defaults are what was reviewed.

    AW_GPU="tiles=last-visit" aw bench ...

`benchmarks/gpu.py --stages cost` measures each against the default.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown

VARIABLE = "AW_GPU"


@dataclass(frozen=True)
class Options:
    """How a step is computed; no value changes what it computes, up to rounding."""

    tiles: str = "exact"  # exact: the host waits for the number of intersections; last-visit: see tiles.py
    harmonics: str = "gsplat"  # gsplat: its kernel, of one tensor of coefficients; split: split_harmonics.py

    def __str__(self) -> str:
        return ",".join(f"{f.name}={getattr(self, f.name)}" for f in fields(self))


CHOICES = {"tiles": ("exact", "last-visit"), "harmonics": ("gsplat", "split")}


def parse(text: str) -> Options:
    """Of "name=value,name=value".

    Raises:
        AwError: an unknown name or value.
    """
    chosen: dict[str, str] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, equals, value = (p.strip() for p in part.partition("="))
        if not equals:
            raise AwError(f"{VARIABLE}={text!r}: {part!r} is not NAME=VALUE; known: {', '.join(CHOICES)}")
        if name not in CHOICES:
            raise unknown(f"option of {VARIABLE}", name, CHOICES)
        if value not in CHOICES[name]:
            raise unknown(f"value of {name} in {VARIABLE}", value, CHOICES[name])
        chosen[name] = value
    return Options(**chosen)


_current: Options | None = None


def current() -> Options:
    """In force now; read from the environment once."""
    global _current
    if _current is None:
        _current = parse(os.environ.get(VARIABLE, ""))
    return _current


@contextmanager
def using(**changes: str) -> Iterator[Options]:
    """Other options inside."""
    global _current
    before = current()
    _current = replace(before, **changes)
    try:
        yield _current
    finally:
        _current = before
