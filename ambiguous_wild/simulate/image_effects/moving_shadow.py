"""Moving shadow: cast by shapes outside the photo."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom
from ambiguous_wild.simulate.image_effects.settings import MovingShadow
from ambiguous_wild.simulate.kernels import ELLIPSOID
from ambiguous_wild.simulate.shapes import UNSEEN, Shape, vector

_AWAY_M = 9.0  # distance towards the sun: outside every photo
_TARGET_M = ((-2.4, 2.4), (-1.2, 3.4))  # x and y around which the shadow falls
_LOBES = 4


def draw(settings: MovingShadow, random: PhotoRandom) -> tuple[tuple[float, float, float], ...]:
    """Lobes of the shadow on the ground as (x, y, radius), m; none in photos without a shadow."""
    rng = random.rng("moving_shadow")
    if rng.random() >= settings.presence:
        return ()
    middle = np.array([rng.uniform(*span) for span in _TARGET_M])
    lobes = []
    for _ in range(_LOBES):
        x, y = middle + rng.normal(0, 0.9 * settings.size_m, 2)
        lobes.append((float(x), float(y), float(settings.size_m * rng.uniform(0.6, 1.1))))
    return tuple(lobes)


def moving_shadow(
    lobes: tuple[tuple[float, float, float], ...],
    sun: np.ndarray,  # [3] unit, towards the sun
) -> list[Shape]:
    """Invisible ellipsoids towards the sun whose shadows fall on the lobes.

    The sun is 0.024 rad wide: at this distance the shadow's edge is 0.2 m wide.
    """
    shapes = []
    for x, y, radius in lobes:
        center = np.array([x, y, 0.0]) + _AWAY_M * np.asarray(sun)
        half = (radius, radius, 0.5 * radius)
        shapes.append(Shape(ELLIPSOID, vector(center), half, "stone", owner=UNSEEN))
    return shapes
