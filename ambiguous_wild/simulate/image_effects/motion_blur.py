"""Motion blur: rotation of the camera at instants of the exposure."""

from __future__ import annotations

import numpy as np


def motion_blur(
    velocity: np.ndarray,  # [3] rad/s, camera axes
    exposure_s: float,
    steps: int,
) -> np.ndarray:  # [steps, 3] rotation vectors
    """Rotation of the camera at `steps` instants, evenly over the exposure; 0 in its middle.

    Translation is left out: it needs depth and leaves holes. At 5 m, 1 m/s blurs like 11 deg/s.
    """
    instants = (np.arange(steps) + 0.5) / steps - 0.5
    return exposure_s * instants[:, None] * velocity
