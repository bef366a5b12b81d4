"""Exposure drift: a gain in linear light."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.effects.moment import Moment
from ambiguous_wild.simulate.effects.settings import ExposureDrift


def draw(settings: ExposureDrift, moment: Moment) -> float:
    """By how many stops this photo is brighter than it should be."""
    return settings.stops * moment.drift("exposure_drift")


def exposure_drift(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    stops: float,
) -> np.ndarray:
    """The image at another exposure: times 2^stops; what is too bright is clipped when it is stored."""
    return image * np.float32(2.0**stops)
