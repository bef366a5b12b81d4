"""What a run does when: how far it is, which view comes next, at what size and at which learning rates.

How small the training photos may be at each point of a short run is DashGaussian's rule (arXiv 2503.18402):
the resolution follows how much of the photos' spectrum has been learnt. It reads the photos' own
frequencies and no residual, so distractors do not mislead it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.parts import Schedule
from ambiguous_wild.splat.step import NOMINAL_ITERATIONS, TrainData
from ambiguous_wild.splat.watchdog import OnNonFinite

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


COARSE_UNTIL = 0.4  # share of the run; measured on simulated captures, see docs/training.md


@dataclass(frozen=True)
class TrainConfig:
    """How long, on what, how often saved. What is learnt how is the method's (`Parts`)."""

    iterations: int = NOMINAL_ITERATIONS
    budget_s: float | None = None  # seconds of training instead of a number of iterations
    seed: int = 0
    resolution: Literal["auto", "full", "coarse-to-fine"] = "auto"  # auto: coarse-to-fine under a budget
    max_gaussians: int | None = None  # None: the method's own ceiling
    torch_threads: int = 1  # fixed, not the machine's: the split of a sum decides its last bits
    checkpoint_every_s: float = 60.0
    probes: int = 8  # times the test PSNR is probed; the clock stands still meanwhile
    on_nonfinite: OnNonFinite = (
        "stop"  # or go back to the last checkpoint and leave the photo out, see watchdog.py
    )

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 100_000_000:  # months on a GPU
            raise AwError(f"--iterations {self.iterations} is not from 1 to 100 000 000")


def room(
    config: TrainConfig, schedule: Schedule, sizes: Sequence[tuple[int, int]], most: int, start: int = 0
) -> int:
    """Gaussians that a run may have, on photos of these sizes (height, width); `most` is the method's own."""
    if config.max_gaussians is not None:
        return config.max_gaussians
    if config.budget_s is None and config.iterations >= schedule.short_below:
        return most
    pixels = float(np.median([height * width for height, width in sizes]))
    return min(most, max(start, int(schedule.per_pixel_short * pixels)))


class Pace:
    """Every schedule of one run, from its settings and how far it is: nothing of it is saved."""

    def __init__(
        self, config: TrainConfig, schedule: Schedule, data: TrainData, *, start: int, most: int
    ) -> None:
        """
        Args:
            config: length and seed.
            schedule: of the method.
            data: photos, and the extent that learning rates of means are scaled by.
            start: Gaussians before the first step.
            most: Gaussians at which the method's growth stops.
        """
        self.config, self.schedule = config, schedule
        self.extent = data.scene.extent
        self.views = len(data.photos)
        self._order: tuple[int, np.ndarray] | None = None  # of the epoch last asked about
        self.start = start
        self.short = config.budget_s is not None or config.iterations < schedule.short_below
        self.most = self._most(data, most)
        self.levels = self._levels(data)

    def progress(self, iteration: int, elapsed_s: float) -> float:
        """Share of the run that lies behind after so many steps and seconds of training, in [0, 1]."""
        if self.config.budget_s is not None:
            return min(elapsed_s / self.config.budget_s, 1.0)
        return min(iteration / self.config.iterations, 1.0)

    def marks(self, count: int, iteration: int, elapsed_s: float) -> int:
        """How many of `count` evenly spaced marks, the last at the end, lie behind; exact for iterations."""
        if self.config.budget_s is not None:
            return int(self.progress(iteration, elapsed_s) * count)
        return min(iteration, self.config.iterations) * count // self.config.iterations

    def divisor(self, progress: float) -> int:
        """Photos are trained at their size over this."""
        return divisor_at(self.levels, progress)

    @property
    def divisors(self) -> tuple[int, ...]:
        """All that the run trains at."""
        return tuple(sorted({level.divisor for level in self.levels}))

    def ceiling(self, divisor: int, progress: float) -> int:
        """Growth stops at this many Gaussians now."""
        return ceiling_at(self.start, self.most, divisor, progress, COARSE_UNTIL)

    def learning_rates(self, progress: float) -> dict[str, float]:
        """Of every tensor, at this share of the run."""
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
        """Passes over all views that were complete before this iteration."""
        return (iteration - 1) // self.views

    def view(self, iteration: int) -> int:
        """Every view once an epoch, in an order of the epoch's own that the seed decides."""
        epoch = self.epoch(iteration)
        if self._order is None or self._order[0] != epoch:  # asked for several times a step
            rng = np.random.default_rng([self.config.seed, 0x51, epoch])
            self._order = epoch, rng.permutation(self.views)
        return int(self._order[1][(iteration - 1) % self.views])

    def _most(self, data: TrainData, most: int) -> int:
        """Growth ends here: a short run can neither afford nor settle more than the photos can tell apart.

        Simulated courtyard at 240x135, 3000 iterations: 14 000, 20 000, 32 000 and 64 000 Gaussians gave
        RefineSplat 30.3, 31.1, 31.3 and 30.7 dB at 9.5, 11.3, 13.6 and 19.6 ms an iteration.
        """
        sizes = [(photo.shape[0], photo.shape[1]) for photo in data.photos]
        return room(self.config, self.schedule, sizes, most, self.start)

    def _levels(self, data: TrainData) -> tuple[Level, ...]:
        wanted: str = self.config.resolution
        if wanted == "auto":
            wanted = "coarse-to-fine" if self.config.budget_s is not None else self.schedule.resolution
        if wanted == "full":
            return FULL
        sample = data.photos[:: max(len(data.photos) // 8, 1)]
        return coarse_to_fine([photo.cpu().numpy() for photo in sample], COARSE_UNTIL)
