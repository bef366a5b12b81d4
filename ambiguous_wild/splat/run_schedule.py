"""Schedules of a run: its progress, the next view, resolution and learning rates of each step.

How small the training photos may be at each point of a short run is DashGaussian's rule (arXiv 2503.18402):
the resolution follows the share of the photos' spectrum that has been learnt. It reads the frequencies of the
photos and no residual, so distractors do not mislead it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ambiguous_wild.splat.train_config import TrainConfig

if TYPE_CHECKING:
    from ambiguous_wild.splat.method_hooks import Schedule
    from ambiguous_wild.splat.step import TrainData

# share of the run at which full resolution is reached at the latest; measured on simulated captures, see
# docs/training.md
COARSE_UNTIL = 0.4
SMALLEST_SIDE = 96  # px; smaller photos are too small for SSIM's 11-tap window and a 16 px tile


@dataclass(frozen=True)
class ResolutionLevel:
    """From `begin` (share of the run) on, photos are trained at 1/`factor` of their width and height."""

    begin: float
    factor: int


FULL_RESOLUTION = (ResolutionLevel(0.0, 1),)


def coarse_to_fine(photos: list[np.ndarray]) -> tuple[ResolutionLevel, ...]:
    """Choose when the downsampling factors 4, 2 and 1 begin, from the photos' mean spectrum.

    Args:
        photos: a sample of the training photos, [H, W, 3] float.

    Returns:
        Levels by rising begin; the first begins at 0.
    """
    side = min(min(photo.shape[:2]) for photo in photos)
    factors = [d for d in (4, 2, 1) if side // d >= SMALLEST_SIDE] or [1]
    if factors == [1]:
        return FULL_RESOLUTION
    energies = {d: float(np.mean([_spectrum_share(photo, d) for photo in photos])) for d in factors}
    start = energies[factors[0]]
    total = energies[1]
    if not 0.0 < start < total:
        return FULL_RESOLUTION  # flat photos carry no frequencies to wait for
    levels = [ResolutionLevel(0.0, factors[0])]
    for previous, factor in itertools.pairwise(factors):
        # COARSE_UNTIL ln(E / E_min) / ln(E_total / E_min) as in Dash, but the mean of the level that ends and
        # of the one that begins
        share = np.log(energies[factor] / start) / np.log(total / start)
        before = np.log(energies[previous] / start) / np.log(total / start)
        levels.append(ResolutionLevel(float(COARSE_UNTIL * (before + share) / 2), factor))
    return tuple(levels)


def downsampling_at(levels: tuple[ResolutionLevel, ...], progress: float) -> int:
    """Return the downsampling factor at this share of the run."""
    current = levels[0].factor
    for level in levels:
        if progress >= level.begin:
            current = level.factor
    return current


def growth_cap_at(start: int, most: int, factor: int, progress: float) -> int:
    """Return how many Gaussians the current resolution can use (Dash's count schedule).

    This is N0 + (Nmax - N0) / r^(2 - progress / COARSE_UNTIL); at full resolution Nmax.
    """
    if factor == 1 or start >= most:
        return most
    power = 2.0 - min(progress / COARSE_UNTIL, 1.0)
    return int(start + (most - start) / factor**power)


def _spectrum_share(photo: np.ndarray, factor: int) -> float:
    """Sum the magnitudes of the frequencies that an image `factor` times smaller can hold."""
    grey = photo.mean(axis=2)
    spectrum = np.abs(np.fft.fftshift(np.fft.fft2(grey - grey.mean())))
    height, width = spectrum.shape
    h, w = max(height // (2 * factor), 1), max(width // (2 * factor), 1)
    return float(spectrum[height // 2 - h : height // 2 + h, width // 2 - w : width // 2 + w].sum())


def max_gaussians(
    config: TrainConfig, schedule: Schedule, sizes: Sequence[tuple[int, int]], most: int, start: int = 0
) -> int:
    """Gaussians that a run may have, on photos of these sizes (height, width); `most` is the method's own."""
    if config.max_gaussians is not None:
        return config.max_gaussians
    if config.budget_s is None and config.iterations >= schedule.short_below:
        return most
    pixels = float(np.median([height * width for height, width in sizes]))
    return min(most, max(start, int(pixels)))


class RunSchedule:
    """Every schedule of one run, computed from its settings and progress: it has no state to save."""

    def __init__(
        self, config: TrainConfig, schedule: Schedule, data: TrainData, *, start: int, most: int
    ) -> None:
        """
        Args:
            config: length and seed.
            schedule: the method's schedule.
            data: photos, and the extent that scales the learning rate of means.
            start: number of Gaussians before the first step.
            most: number of Gaussians at which the method's growth stops.
        """
        self.config, self.schedule = config, schedule
        self.extent = data.scene.extent
        self.views = len(data.photos)
        # epoch and order of views of the last call of `view`
        self._order: tuple[int, np.ndarray] | None = None
        self.start = start
        self.short = config.budget_s is not None or config.iterations < schedule.short_below
        self.max_gaussians = self._max_gaussians(data, most)
        self.levels = self._levels(data)

    def marks(self, count: int, iteration: int, elapsed_s: float) -> int:
        """Return how many of `count` evenly spaced marks are passed, the last at the end of the run."""
        if self.config.budget_s is not None:
            return int(self.config.share_done(iteration, elapsed_s) * count)
        return min(iteration, self.config.iterations) * count // self.config.iterations

    def downsampling(self, progress: float) -> int:
        """Return the downsampling factor at this share of the run."""
        return downsampling_at(self.levels, progress)

    @property
    def factors(self) -> tuple[int, ...]:
        """Every downsampling factor that the run uses."""
        return tuple(sorted({level.factor for level in self.levels}))

    def growth_cap(self, factor: int, progress: float) -> int:
        """Return the number of Gaussians at which growth stops now."""
        return growth_cap_at(self.start, self.max_gaussians, factor, progress)

    def learning_rates(self, progress: float) -> dict[str, float]:
        """Return the learning rate of every tensor at this share of the run."""
        s = self.schedule
        last = s.lr_means_final_short if self.short else s.lr_means_final
        return {
            "means": self.extent * s.lr_means * (last / s.lr_means) ** progress,
            "quats": s.lr_quats,
            "log_scales": s.lr_scales,
            "opacity_logits": s.lr_opacity,
            "sh0": s.lr_sh0,
            "sh_rest": s.lr_sh_rest,
        }

    def epoch(self, iteration: int) -> int:
        """Return how many passes over all views were complete before this iteration."""
        return (iteration - 1) // self.views

    def view(self, iteration: int) -> int:
        """Return the view of an iteration; each epoch visits every view once, in an order from the seed."""
        epoch = self.epoch(iteration)
        if self._order is None or self._order[0] != epoch:  # kept, as a step calls this several times
            rng = np.random.default_rng([self.config.seed, 0x51, epoch])
            self._order = epoch, rng.permutation(self.views)
        return int(self._order[1][(iteration - 1) % self.views])

    def _max_gaussians(self, data: TrainData, most: int) -> int:
        """Return the number of Gaussians at which growth ends; in short runs it follows the photos' pixels.

        Simulated courtyard at 240x135, 3000 iterations: 14 000, 20 000, 32 000 and 64 000 Gaussians gave
        RefineSplat 30.3, 31.1, 31.3 and 30.7 dB at 9.5, 11.3, 13.6 and 19.6 ms an iteration.
        """
        sizes = [(camera.height, camera.width) for camera in data.cameras]
        return max_gaussians(self.config, self.schedule, sizes, most, self.start)

    def _levels(self, data: TrainData) -> tuple[ResolutionLevel, ...]:
        resolution: str = self.config.resolution
        if resolution == "auto":
            resolution = "coarse-to-fine" if self.config.budget_s is not None else self.schedule.resolution
        if resolution == "full":
            return FULL_RESOLUTION
        sample = data.photos[:: max(len(data.photos) // 8, 1)]
        return coarse_to_fine([photo.cpu().numpy() for photo in sample])
