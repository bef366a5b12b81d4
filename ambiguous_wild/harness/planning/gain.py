"""What two paired probes say of an effect. Imports no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

LEAST_PHOTOS = 4  # fewer give no standard error worth the name
LEAST_DB = 0.05  # below, an effect is not worth its time
# Probes grow no Gaussians and understate what masks give: static captures -0.02 to +0.01 dB, captures with
# distractors from 0.05 dB (docs/effects.md)
LEAST_DB_MASKS = 0.02


@dataclass(frozen=True)
class Arm:
    """One probe: its PSNR on the held-back pixels of every photo that was measured."""

    psnr: Mapping[str, float]  # dB, mean over visits, by the photo's name


@dataclass(frozen=True)
class Gain:
    """What an effect gives on the held-back pixels of the same photos."""

    db: float  # mean over photos
    error_db: float  # standard error of that mean

    def pays(self, least_db: float = LEAST_DB) -> bool:
        """Whether it is more than its standard error, and enough to be worth its time."""
        return self.db >= least_db and self.db > self.error_db


def compare(arm: Arm, base: Arm) -> Gain | None:
    """`arm` against `base`, photo by photo; None where they share too few photos."""
    names = [name for name in base.psnr if name in arm.psnr]
    if len(names) < LEAST_PHOTOS:
        return None
    difference = np.array([arm.psnr[name] - base.psnr[name] for name in names])
    error = float(difference.std(ddof=1) / np.sqrt(len(difference)))
    return Gain(float(difference.mean()), error)
