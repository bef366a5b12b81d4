"""JPEG: a first, strong compression."""

from __future__ import annotations

import io

import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom
from ambiguous_wild.simulate.image_effects.settings import Jpeg


def draw(settings: Jpeg, random: PhotoRandom) -> int:
    """The photo's quality."""
    low, high = settings.quality
    return int(random.rng("jpeg").integers(low, high + 1))


def jpeg(
    pixels: np.ndarray,  # [H, W, 3] uint8, sRGB
    quality: int,  # 1 to 95
) -> np.ndarray:  # [H, W, 3] uint8, sRGB
    """The pixels after JPEG with chroma at half the resolution."""
    from PIL import Image

    stored = io.BytesIO()
    Image.fromarray(pixels).save(stored, "JPEG", quality=quality, subsampling=2)
    stored.seek(0)
    return np.array(Image.open(stored).convert("RGB"))
