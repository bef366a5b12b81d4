"""Distractors that several presets share, and the labels of presets."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

from ambiguous_wild.simulate.spec import Colour, Designed, Distractor, Kind

# Colours that the courtyard does not have, in linear light.
CRIMSON: Colour = (0.72, 0.015, 0.04)
AZURE: Colour = (0.02, 0.22, 0.75)
YELLOW: Colour = (0.95, 0.62, 0.01)
MAGENTA: Colour = (0.8, 0.02, 0.5)

VISITOR = Distractor("visitor in brick", "visitor", "brick", "colour", head="skin")
TWIN = Distractor("second statue", "twin", "stone", "semantic")
PARCEL = Distractor("bright parcel", "parcel", "vivid", "none", distance_m=(1.8, 3.6))
LEAVES = Distractor("visitor in leaves", "visitor", "foliage", "colour")
GRAVEL = Distractor("parcel in gravel", "parcel", "gravel", "colour", distance_m=(1.8, 3.6))
RED = Distractor("visitor in red", "visitor", "cloth", "none", head="skin", tint=CRIMSON)
BLUE = Distractor("blue ball", "ball", "cloth", "none", distance_m=(1.8, 3.6), tint=AZURE)


def thin(name: str, kind: Kind, texture: str, **more: Any) -> Distractor:
    """A thin distractor in the background's colours, near the camera."""
    return Distractor(name, kind, texture, "colour", distance_m=(1.4, 3.2), presence=0.9, **more)


def near(distractor: Distractor) -> Distractor:
    """The distractor closer to the camera, in nearly every photo."""
    return replace(distractor, presence=0.95, distance_m=(1.4, 3.6))


def far(distractor: Distractor) -> Distractor:
    """The distractor farther away and less often present."""
    return replace(distractor, presence=0.6, distance_m=(2.8, 5.0))


def designed(
    ambiguity: Literal["colour", "semantic", "both", "neither"], *more: Any, distractors: bool = True
) -> Designed:
    """The label of a preset.

    Distractors need masks and evidence within the photo (local). Ambiguous ones also need evidence over all
    photos (global) and density control that uses it (entropy).

    Args:
        ambiguity: of the distractors.
        more: further effects of the trainer.
        distractors: whether there are distractors or passing shadows at all.
    """
    masks = ("masks", "local") if distractors else ()
    hard = ("global", "entropy") if ambiguity != "neither" else ()
    return Designed(ambiguity, (*masks, *hard, *more))
