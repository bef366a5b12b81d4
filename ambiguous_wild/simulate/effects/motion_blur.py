"""Motion blur: how the camera is turned at instants of the exposure."""

from __future__ import annotations

import numpy as np


def motion_blur(
    velocity: np.ndarray,  # [3] rad/s, camera axes
    exposure_s: float,
    steps: int,
) -> np.ndarray:  # [steps, 3] rotation vectors
    """The camera's turn at `steps` instants, evenly over the exposure, none in its middle.

    The hand's translation is left out: at 5 m a walk of 1 m/s blurs as 11 degrees a second would; rotation
    alone needs no depth and leaves no hole.
    """
    instants = (np.arange(steps) + 0.5) / steps - 0.5
    return exposure_s * instants[:, None] * velocity
