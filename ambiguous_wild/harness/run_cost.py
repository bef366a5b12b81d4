"""The cost of a training: its time, its peaks of memory, and what helps where a GPU has too little."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from typing import cast

import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import Cell
from ambiguous_wild.harness.meter import Meter
from ambiguous_wild.harness.result_file import Cost, TimeRecord
from ambiguous_wild.splat.trainer import Trainer

_PROC = Path("/proc/self")
_NO_MEMORY = ("CUDA out of memory", "CUDA error: out of memory")
_SUMS = ("train_s", "cpu_s", "reference_s", "setup_s", "iterations")
_WORST_FIRST = ("contended", "unknown", "alone")
_PEAKS = ("peak_rss_mb", "peak_cuda_mb")


def reset_peak(device: str = "cpu") -> None:
    """Start new peaks of memory: of the process where the system can (Linux), and of a GPU."""
    if device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats(device)
    try:
        (_PROC / "clear_refs").write_text("5")
    except OSError:
        return


def peak_memory(device: str = "cpu") -> Cost:
    """Return peak_rss_mb, and on a GPU peak_cuda_mb, the most that its tensors held since `reset_peak`."""
    rss = peak_rss_mb()
    peaks: Cost = {"peak_rss_mb": rss} if math.isfinite(rss) else {}
    if device.startswith("cuda"):
        peaks["peak_cuda_mb"] = torch.cuda.max_memory_allocated(device) / 1e6
    return peaks


def peak_rss_mb() -> float:
    """Return the largest resident memory in MB since `reset_peak`.

    On macOS it counts from the start of the process; on Windows it is NaN.
    """
    try:
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return math.nan
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6  # bytes there, KiB elsewhere


def is_out_of_gpu_memory(error: BaseException) -> bool:
    """Return whether a GPU had no memory left; gsplat's kernels raise a plain RuntimeError then."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _NO_MEMORY)


def out_of_gpu_memory(error: BaseException, gaussians: int | None, factor: int | None) -> AwError:
    """Return the error as one line that says what helps.

    Args:
        error: what torch raised.
        gaussians: number of Gaussians of the model then; None = there was no model yet.
        factor: N of the folder images_N that it trained on; None = not known.
    """
    match = re.search(r"Tried to allocate [\d.]+ \w+", str(error))
    request = f", {match[0][0].lower()}{match[0][1:]}" if match else ""
    size = f" with {gaussians:,} Gaussians" if gaussians else ""
    remedies = [f"--max-gaussians {max(gaussians // 2, 4)}"] if gaussians else []
    remedies.append(f"--factor {2 * (factor or 1)} (smaller photos, where the scene has them)")
    return AwError(
        f"out of GPU memory{size}{request}; what helps: {', '.join(remedies)}, a GPU with more memory, or no "
        "other program on this one"
    )


def cost_of(cell: Cell, trainer: Trainer) -> Cost:
    """Return the cost of the training that a trainer has done so far."""
    import numba

    n = max(trainer.iteration, 1)
    cost: Cost = {
        "train_s": trainer.clock.now(),
        "cpu_s": trainer.clock.cpu_s,
        "setup_s": trainer.setup_s,
        "iterations": trainer.iteration,
        "ms_per_iteration": trainer.ms_per_iteration,
        "ms_parts": {name: 1e3 * seconds / n for name, seconds in trainer.clock.parts_s.items()},
        "gaussians": len(trainer.gaussians),
    }
    if isinstance(trainer.meter, Meter):
        cost |= trainer.meter.cost(trainer.clock.now())
    cost |= peak_memory(cell.device)
    cost["device"] = cell.device
    cost["threads"] = int(numba.get_num_threads())
    return cost


def two_pass_cost(first: Cost, second: Cost) -> Cost:
    """Return the cost of two trainings that make one result: sums, means over iterations, higher peaks."""
    one, other = (cast("dict[str, float]", dict(cost)) for cost in (first, second))
    total = {name: one[name] + other[name] for name in _SUMS if name in one and name in other}
    total |= {name: max(cost[name] for cost in (one, other) if name in cost)
              for name in _PEAKS if name in one or name in other}  # fmt: skip
    share = one["iterations"] / max(total["iterations"], 1)

    def mixed(a: float, b: float) -> float:
        return share * a + (1.0 - share) * b

    total["ms_per_iteration"] = mixed(one["ms_per_iteration"], other["ms_per_iteration"])
    parts = {
        name: mixed(first["ms_parts"].get(name, 0.0), second["ms_parts"].get(name, 0.0))
        for name in {**first["ms_parts"], **second["ms_parts"]}
    }
    extra: dict[str, object] = {"ms_parts": parts, "passes": 2, "first_pass_s": first["train_s"]}
    if "timing" in first and "timing" in second:
        extra["timing"] = _both_timings(first["timing"], second["timing"], first["train_s"])
    return cast(Cost, {**second, **total, **extra})


def _both_timings(first: TimeRecord, second: TimeRecord, first_s: float) -> TimeRecord:
    """Join the records of two trainings in a row: the worse verdict, and all calibrations."""
    worse = min((first, second), key=lambda record: _WORST_FIRST.index(record["verdict"]))
    both: TimeRecord = {**second, "verdict": worse["verdict"], "reason": worse["reason"]}
    both["samples"] = [*first["samples"], *([first_s + s, kernel] for s, kernel in second["samples"])]
    both["runs"] = max(first["runs"], second["runs"])
    if "others" in first and "others" in second:
        both["others"] = max(first["others"], second["others"])
    return both
