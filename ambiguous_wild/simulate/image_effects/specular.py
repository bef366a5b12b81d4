"""Specular reflection: marks the polished surfaces; the ray caster shades them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from ambiguous_wild.simulate.shapes import Shape


def specular(
    shapes: Iterable[Shape], textures: tuple[str, ...], strength: float, sharpness: float
) -> list[Shape]:
    """The shapes, those with the named textures polished.

    Source: Blinn 1977 for the sun's highlight, Schlick 1994 for the reflection of the sky.
    """
    return [replace(s, gloss=(strength, sharpness)) if s.texture in textures else s for s in shapes]
