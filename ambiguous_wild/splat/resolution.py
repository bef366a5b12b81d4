"""Coarse to fine: how small the training images may be at each point of a short run.

Source: DashGaussian (arXiv 2503.18402): the resolution follows how much of the photos' spectrum has been
learnt. The rule reads the photos' own frequencies and no residual, so distractors do not mislead it.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

SMALLEST_SIDE = 96  # px; below it SSIM's 11-tap window and a 16 px tile see too little


@dataclass(frozen=True)
class Level:
    """From `begin` (share of the run) on, images are trained at their size over `divisor`."""

    begin: float
    divisor: int


FULL = (Level(0.0, 1),)


def coarse_to_fine(photos: list[np.ndarray], until: float = 0.4) -> tuple[Level, ...]:
    """Divisors 4, 2, 1 with the begin of each by the photos' mean spectrum.

    Args:
        photos: [H, W, 3] float, a sample of the training photos.
        until: share of the run at which full resolution is reached at the latest.

    Returns:
        Levels by rising begin; the first begins at 0.
    """
    side = min(min(photo.shape[:2]) for photo in photos)
    divisors = [d for d in (4, 2, 1) if side // d >= SMALLEST_SIDE] or [1]
    if divisors == [1]:
        return FULL
    energies = {d: float(np.mean([_spectrum_share(photo, d) for photo in photos])) for d in divisors}
    start = energies[divisors[0]]
    total = energies[1]
    if not 0.0 < start < total:
        return FULL  # flat photos carry no frequencies to wait for
    levels = [Level(0.0, divisors[0])]
    for previous, divisor in itertools.pairwise(divisors):
        # Dash: begin = until * ln(E / E_min) / ln(E_total / E_min), of the level that is left behind.
        share = np.log(energies[divisor] / start) / np.log(total / start)
        before = np.log(energies[previous] / start) / np.log(total / start)
        levels.append(Level(float(until * (before + share) / 2), divisor))
    return tuple(levels)


def divisor_at(levels: tuple[Level, ...], progress: float) -> int:
    """The divisor in force at that share of the run."""
    current = levels[0].divisor
    for level in levels:
        if progress >= level.begin:
            current = level.divisor
    return current


def ceiling_at(start: int, most: int, divisor: int, progress: float, until: float) -> int:
    """How many Gaussians the current resolution can use (Dash's count schedule).

    N0 + (Nmax - N0) / r^(2 - progress / until); at full resolution it is Nmax.
    """
    if divisor == 1 or start >= most:
        return most
    power = 2.0 - min(progress / until, 1.0)
    return int(start + (most - start) / divisor**power)


def _spectrum_share(photo: np.ndarray, divisor: int) -> float:
    """Sum of the magnitudes of the frequencies an image `divisor` times smaller can hold."""
    grey = photo.mean(axis=2)
    spectrum = np.abs(np.fft.fftshift(np.fft.fft2(grey - grey.mean())))
    height, width = spectrum.shape
    h, w = max(height // (2 * divisor), 1), max(width // (2 * divisor), 1)
    return float(spectrum[height // 2 - h : height // 2 + h, width // 2 - w : width // 2 + w].sum())
