"""Whether the times of runs can be compared, and in which seconds. Reads records.

    timing = timing_of(result["cost"])       # verdict and reason of one run
    text = seconds_range([c["train_s"] for c in costs])     # shown instead, unranked

A run is *alone* where nothing else used its processors, and *contended* otherwise. `reference_s` is the
training time in seconds of a stated machine: how often the calibration kernel (`splat/calibration.py`) would
have run in that time, times the kernel's seconds on that machine. It corrects for load and for the machine's
speed; a contended run keeps it, but is not ranked.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

Verdict = Literal["alone", "contended", "unknown"]
VERDICTS: tuple[Verdict, ...] = ("alone", "contended", "unknown")
UNTIMED = "its time was not calibrated (an earlier version, several GPUs, or an external program)"


@dataclass(frozen=True)
class Timing:
    """What is known about the time of one run."""

    verdict: Verdict
    reason: str  # why it is contended or unknown; empty for a run that was alone
    kernel: str  # calibration that `reference_s` rests on, e.g. "cpu-1"; empty without one
    reference_s: float  # training in seconds of the reference machine; NaN without calibration


def timing_of(cost: Mapping[str, Any]) -> Timing:
    """The timing in the "cost" of a result; "unknown" where it holds none."""
    record = cost.get("timing")
    if not isinstance(record, Mapping) or record.get("verdict") not in VERDICTS:
        return Timing("unknown", UNTIMED, "", math.nan)
    seconds = cost.get("reference_s")
    return Timing(
        record["verdict"],
        str(record.get("reason", "")),
        str(record.get("kernel", "")),
        math.nan if seconds is None else float(seconds),
    )


def seconds_range(values: Sequence[float], digits: int = 0) -> str:
    """Times that are not ranked: "129 to 230", or one number where they print alike; empty without any."""
    known = [v for v in values if math.isfinite(v)]
    if not known:
        return ""
    low, high = (f"{v:.{digits}f}" for v in (min(known), max(known)))
    return low if low == high else f"{low} to {high}"


def in_reference_seconds(
    samples: Sequence[Sequence[float]],  # (seconds of training so far, seconds of the kernel), in order
    reference_s: float,  # of the kernel on the reference machine
    at: Sequence[float],  # seconds of training
) -> np.ndarray:
    """Seconds of training as seconds of the reference machine.

    Between two samples the machine's speed is their mean (kernels a second); before the first and after the
    last it is theirs.

    Returns:
        [n] float64, increasing with `at`; NaN without samples.
    """
    times = np.asarray(at, np.float64)
    if not len(samples):
        return np.full(times.shape, math.nan)
    begin, kernel = np.asarray(samples, np.float64).reshape(-1, 2).T
    speed = reference_s / kernel  # reference seconds a second
    steps = np.diff(begin) * 0.5 * (speed[1:] + speed[:-1])
    there = np.concatenate([[begin[0] * speed[0]], begin[0] * speed[0] + np.cumsum(steps)])
    inside = np.interp(times, begin, there)
    early, late = np.minimum(times - begin[0], 0.0) * speed[0], np.maximum(times - begin[-1], 0.0) * speed[-1]
    return inside + early + late


# ms of a step of 3dgs on the reference machine (splat/calibration.py): a constant, a part for every 1000 px
# and one for every 1000 Gaussians. Of captures of 240x134 to 480x268 with 32 000 to 102 000 Gaussians; a
# capture's own share is between these:
STEP_MS, PIXELS_MS, GAUSSIANS_MS = 2.2, 0.09, 0.22
LEAST, MOST = 0.67, 1.5


def expected_s(iterations: int, pixels: int, gaussians: int) -> float:
    """Seconds of so many iterations of 3dgs on the reference machine, to within `LEAST` and `MOST`."""
    return 1e-3 * iterations * (STEP_MS + 1e-3 * (PIXELS_MS * pixels + GAUSSIANS_MS * gaussians))


def slowness(device: str = "cpu") -> float:
    """How many times longer than on the reference machine this one takes now; kernels must be compiled."""
    import torch

    from ambiguous_wild.splat.calibration import KERNELS, calibration

    kernel = calibration(torch.device(device))
    return statistics.median(kernel.seconds() for _ in range(3)) / KERNELS[device].reference_s
