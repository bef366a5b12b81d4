"""Rolling shutter: rotation of the camera while each row is read."""

from __future__ import annotations

import numpy as np


def rolling_shutter(
    velocity: np.ndarray,  # [3] rad/s, camera axes
    readout_s: float,
    rows: int,
) -> np.ndarray:  # [rows, 3] rotation vectors
    """Rotation of the camera while each row is read; the middle row has the stated pose."""
    when = (np.arange(rows) + 0.5) / rows - 0.5
    return readout_s * when[:, None] * velocity
