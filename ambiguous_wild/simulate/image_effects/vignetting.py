"""Vignetting: the cos^4 law with adjustable strength."""

from __future__ import annotations

import numpy as np


def vignetting(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    falloff: float,  # share of the light that the corners lack, in [0, 1)
) -> np.ndarray:
    """The image times (1 + c r^2)^-2, r = 1 in the corners; cos^4 of the angle has this form."""
    height, width = image.shape[:2]
    x = (np.arange(width, dtype=np.float64) + 0.5) / width * 2 - 1
    y = (np.arange(height, dtype=np.float64) + 0.5) / height * 2 - 1
    r2 = ((x[None] * width) ** 2 + (y[:, None] * height) ** 2) / (width**2 + height**2)
    c = (1.0 - falloff) ** -0.5 - 1.0
    return image * ((1.0 + c * r2) ** -2).astype(np.float32)[..., None]
