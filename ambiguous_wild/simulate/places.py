"""Places by name."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.courtyard import courtyard
from ambiguous_wild.simulate.room import room
from ambiguous_wild.simulate.spec import WorldSpec
from ambiguous_wild.simulate.world import World
from ambiguous_wild.simulate.yard import yard

_PLACES = {"courtyard": courtyard, "room": room, "yard": yard}


def build_world(
    rng: np.random.Generator, detail_px_per_m: float, samples: int = 4, what: WorldSpec | None = None
) -> World:
    """Build the place of the spec; positions and textures vary with the generator.

    Objects that are left out use their random numbers all the same: the others do not change.

    Args:
        rng: source of randomness.
        detail_px_per_m: resolution of the textures, px per m.
        samples: rays a pixel, a square number.
        what: the place and its objects; None: the courtyard.
    """
    what = WorldSpec() if what is None else what
    return _PLACES[what.place](rng, detail_px_per_m, samples, what)
