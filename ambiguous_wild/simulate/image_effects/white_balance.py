"""White balance: one gain a channel, in linear light."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom
from ambiguous_wild.simulate.image_effects.settings import WhiteBalance

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear sRGB, ITU-R BT.709


def draw(settings: WhiteBalance, random: PhotoRandom) -> tuple[float, float, float]:
    """The photo's gains (red, green, blue); white keeps its luminance."""
    warmth = settings.warmth * random.drift("white_balance", cycles=2.3)
    tint = settings.tint * random.drift("white_balance tint", cycles=1.1)
    gains = 2.0 ** np.array([warmth / 2, tint, -warmth / 2])
    r, g, b = (float(v) for v in gains / (gains @ _LUMINANCE))
    return r, g, b


def white_balance(
    image: np.ndarray,  # [H, W, 3] float32, linear light
    gains: tuple[float, float, float],
) -> np.ndarray:
    """The image with each channel times its gain."""
    return image * np.array(gains, np.float32)
