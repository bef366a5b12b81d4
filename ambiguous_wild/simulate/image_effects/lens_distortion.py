"""Lens distortion: direction of a pixel's ray."""

from __future__ import annotations

import numpy as np


def lens_distortion(
    points: np.ndarray,  # [..., 2] float64: (u - cx) / fx, (v - cy) / fy of the distorted photo
    k1: float,
    k2: float,
) -> np.ndarray:  # [..., 2] float64, the same of the pinhole camera
    """Undo x_d = x (1 + k1 r^2 + k2 r^4) by Newton's method on the radius.

    Source: COLMAP's RADIAL camera; with k2 = 0 its SIMPLE_RADIAL.
    """
    distorted = np.linalg.norm(points, axis=-1)
    radius = distorted.copy()
    for _ in range(12):
        square = radius * radius  # numpy's fourth power takes ten times as long as two squares
        value = radius * (1 + square * (k1 + k2 * square)) - distorted
        slope = 1 + square * (3 * k1 + 5 * k2 * square)
        radius -= value / np.maximum(slope, 0.05)
    scale = np.divide(radius, distorted, out=np.ones_like(radius), where=distorted > 1e-12)
    return points * scale[..., None]
