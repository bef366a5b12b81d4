"""Length and resolution of a run, and what it does at a value that is not finite. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ambiguous_wild.core import AwError

NOMINAL_ITERATIONS = 30_000  # schedules are written for this length and scale with that of the run
PER_PHOTO, SHORTEST = 200, 7000  # default length: iterations per train photo, and at least
OnNonFinite = Literal["stop", "rollback"]


def default_iterations(photos: int) -> int:
    """Return the default length of a run on a scene with this number of train photos.

    Long runs overfit few photos (docs/training.md).
    """
    return min(max(PER_PHOTO * photos, SHORTEST), NOMINAL_ITERATIONS)


@dataclass(frozen=True)
class TrainConfig:
    """Length, resolution and checkpointing of a run; the method (`MethodHooks`) sets the rest."""

    iterations: int = NOMINAL_ITERATIONS
    budget_s: float | None = None  # seconds of training instead of a number of iterations
    seed: int = 0
    resolution: Literal["auto", "full", "coarse-to-fine"] = "auto"  # auto: coarse-to-fine under a budget
    max_gaussians: int | None = None  # None: the limit of the method
    torch_threads: int = 1  # fixed for all machines: how a sum is split decides its last bits
    checkpoint_every_s: float = 60.0
    probes: int = 8  # how often the test PSNR is measured, with the clock stopped
    # stop, or go back to the last checkpoint and leave the photo out, see watchdog.py
    on_nonfinite: OnNonFinite = "stop"

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 100_000_000:  # months on a GPU
            raise AwError(f"--iterations {self.iterations} is not from 1 to 100 000 000")

    def share_done(self, iteration: int, elapsed_s: float) -> float:
        """Return the share of the run done after these steps and seconds of training, in [0, 1]."""
        if self.budget_s is not None:
            return min(elapsed_s / self.budget_s, 1.0)
        return min(iteration / self.iterations, 1.0)
