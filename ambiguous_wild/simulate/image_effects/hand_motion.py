"""Motion of the hand: one angular velocity a photo, for motion blur and rolling shutter."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.image_effects.photo_random import PhotoRandom


def hand_velocity(random: PhotoRandom, speed_deg_s: float) -> np.ndarray:
    """Angular velocity in camera axes, [3] rad/s: mostly pitch and yaw, a third of it roll.

    Its length is 0.3 to 1 times `speed_deg_s`. The direction does not depend on the speed, so blur and
    rolling shutter show the same motion.
    """
    rng = random.rng("hand")
    direction = rng.normal(size=3) * (1.0, 1.0, 0.35)
    return np.deg2rad(speed_deg_s) * rng.uniform(0.3, 1.0) * direction / np.linalg.norm(direction)
