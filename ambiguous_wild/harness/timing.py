"""Decide from a run's records whether its time can be compared with others, and in which seconds.

    timing = timing_of(result["cost"])       # verdict and reason of one run
    text = seconds_range([c["train_s"] for c in costs])     # shown where times are not ranked

A run is *alone* where nothing else used its processors, and *contended* otherwise. `reference_s` is the
training time in seconds of a stated machine: how often the calibration kernel (`splat/calibration.py`) would
have run in that time, times the kernel's seconds on that machine. It corrects for load and for the machine's
speed; a contended run keeps it, but is not ranked.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from ambiguous_wild.harness.result_file import Cost

Verdict = Literal["alone", "contended", "unknown"]
VERDICTS: tuple[Verdict, ...] = ("alone", "contended", "unknown")
UNTIMED = "its time was not calibrated (an earlier version, several GPUs, or an external program)"
# ms of a step of 3dgs on the reference machine (splat/calibration.py): a constant, a part for every 1000 px
# and one for every 1000 Gaussians. Fitted to captures of 240x134 to 480x268 px with 32 000 to 102 000
# Gaussians, whose times were MIN_RATIO to MAX_RATIO times what the formula gives.
STEP_MS, PIXELS_MS, GAUSSIANS_MS = 2.2, 0.09, 0.22
MIN_RATIO, MAX_RATIO = 0.67, 1.5


@dataclass(frozen=True)
class Timing:
    """Whether the time of one run can be compared, and the time itself."""

    verdict: Verdict
    reason: str  # why it is contended or unknown; empty for a run that was alone
    kernel: str  # calibration that `reference_s` rests on, e.g. "cpu-1"; empty without one
    reference_s: float  # training in seconds of the reference machine; NaN without calibration


def timing_of(cost: Cost) -> Timing:
    """Return the timing in the "cost" of a result; its verdict is "unknown" where there is no record."""
    record = cost.get("timing")
    if record is None or record["verdict"] not in VERDICTS:
        return Timing("unknown", UNTIMED, "", math.nan)
    seconds = cost.get("reference_s")
    return Timing(
        record["verdict"],
        record["reason"],
        record.get("kernel", ""),
        math.nan if seconds is None else seconds,
    )


def seconds_range(values: Sequence[float], digits: int = 0) -> str:
    """Return numbers as a range, "129 to 230", or one number where they print alike; empty without any."""
    finite = [v for v in values if math.isfinite(v)]
    if not finite:
        return ""
    low, high = (f"{v:.{digits}f}" for v in (min(finite), max(finite)))
    return low if low == high else f"{low} to {high}"


def in_reference_seconds(
    samples: Sequence[Sequence[float]],  # (seconds of training so far, seconds of the kernel), in order
    reference_s: float,  # of the kernel on the reference machine
    at: Sequence[float],  # seconds of training
) -> np.ndarray:
    """Convert seconds of training to seconds of the reference machine.

    Between two samples the machine's speed is their mean (kernels a second); before the first sample it is
    that of the first, after the last that of the last.

    Returns:
        [n] float64, increasing with `at`; NaN without samples.
    """
    times = np.asarray(at, np.float64)
    if not len(samples):
        return np.full(times.shape, math.nan)
    begin, kernel = np.asarray(samples, np.float64).reshape(-1, 2).T
    speed = reference_s / kernel  # reference seconds a second
    steps = np.diff(begin) * 0.5 * (speed[1:] + speed[:-1])
    at_samples = np.concatenate([[begin[0] * speed[0]], begin[0] * speed[0] + np.cumsum(steps)])
    inside = np.interp(times, begin, at_samples)
    early, late = np.minimum(times - begin[0], 0.0) * speed[0], np.maximum(times - begin[-1], 0.0) * speed[-1]
    return inside + early + late


def expected_s(iterations: int, pixels: int, gaussians: int) -> float:
    """Return the expected seconds of 3dgs on the reference machine, right within `MIN_RATIO` to `MAX_RATIO`.

    `pixels` are those of a photo, `gaussians` the number at the end.
    """
    return 1e-3 * iterations * (STEP_MS + 1e-3 * (PIXELS_MS * pixels + GAUSSIANS_MS * gaussians))


def slowness(device: str = "cpu") -> float:
    """Return how many times slower this machine is now than the reference machine.

    The kernels must be compiled.
    """
    import torch

    from ambiguous_wild.splat.calibration import KERNELS, calibration

    kernel = calibration(torch.device(device))
    return statistics.median(kernel.seconds() for _ in range(3)) / KERNELS[device].reference_s
