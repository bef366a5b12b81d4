"""The hand that holds the phone: one angular velocity a photo, shared by blur and rolling shutter."""

from __future__ import annotations

import numpy as np

from ambiguous_wild.simulate.effects.moment import Moment


def hand_velocity(moment: Moment, speed_deg_s: float) -> np.ndarray:
    """Angular velocity in camera axes, [3] rad/s: mostly pitch and yaw, a third of it roll.

    Its length lies between 0.3 and 1 times `speed_deg_s`; the same photo has the same direction whatever
    the speed, so that blur and rolling shutter belong to one movement.
    """
    rng = moment.rng("hand")
    direction = rng.normal(size=3) * (1.0, 1.0, 0.35)
    return np.deg2rad(speed_deg_s) * rng.uniform(0.3, 1.0) * direction / np.linalg.norm(direction)
