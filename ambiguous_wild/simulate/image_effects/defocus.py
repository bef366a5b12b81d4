"""Defocus of the whole photo."""

from __future__ import annotations

import cv2
import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom
from ambiguous_wild.simulate.image_effects.settings import Defocus

_FINE = 9  # subpixels a side, for the disc's rim


def draw(settings: Defocus, random: PhotoRandom) -> float:
    """Radius of the blur disc in widths of the photo; 0 = sharp."""
    rng = random.rng("defocus")
    out_of_focus, radius = rng.random() < settings.share, rng.uniform(*settings.radius)
    return float(radius) if out_of_focus else 0.0


def disc(radius_px: float) -> np.ndarray:
    """The point spread, [K, K] float32, sum 1: a disc with an anti-aliased rim."""
    reach = int(np.ceil(radius_px + 0.5 - 1e-9))
    fine = (np.arange((2 * reach + 1) * _FINE) + 0.5) / _FINE - reach - 0.5
    inside = np.hypot(fine[None], fine[:, None]) <= radius_px
    inside |= np.hypot(fine[None], fine[:, None]) <= 0.5  # never less than a pixel
    kernel = inside.reshape(2 * reach + 1, _FINE, 2 * reach + 1, _FINE).mean((1, 3))
    return np.asarray(kernel / kernel.sum(), np.float32)


def defocus(
    image: np.ndarray,  # [H, W] or [H, W, 3] float32, linear light
    kernel: np.ndarray,  # [K, K] float32
) -> np.ndarray:
    """The image convolved with the kernel.

    A lens of 4 mm that is focused is sharp from 2 m to infinity; one that is not has one disc for all depths.
    """
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE))
