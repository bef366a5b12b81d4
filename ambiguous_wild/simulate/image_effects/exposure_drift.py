"""Exposure drift: a gain in linear light."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom
from ambiguous_wild.simulate.image_effects.settings import ExposureDrift


def draw(settings: ExposureDrift, random: PhotoRandom) -> float:
    """Exposure error of this photo, stops; positive = brighter."""
    return settings.stops * random.drift("exposure_drift")


def exposure_drift(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    stops: float,
) -> np.ndarray:
    """The image times 2^stops; it is clipped when it is stored."""
    return image * np.float32(2.0**stops)
