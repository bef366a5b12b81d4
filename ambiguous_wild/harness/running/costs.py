"""What a training took, as it stands in the result."""

from __future__ import annotations

from typing import cast

from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.memory import peak_memory
from ambiguous_wild.harness.running.meter import Meter
from ambiguous_wild.harness.running.records import Cost, TimeRecord
from ambiguous_wild.splat.trainer import Trainer

_SUMS = ("train_s", "cpu_s", "reference_s", "setup_s", "iterations")
_WORST_FIRST = ("contended", "unknown", "alone")
_PEAKS = ("peak_rss_mb", "peak_cuda_mb")


def cost_of(cell: Cell, trainer: Trainer) -> Cost:
    """Of the training that a trainer has done."""
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


def both_passes(first: Cost, second: Cost) -> Cost:
    """Of two trainings that make one result: sums, means over all iterations, and the higher peaks."""
    one, other = (cast("dict[str, float]", dict(cost)) for cost in (first, second))
    known = {name: one[name] + other[name] for name in _SUMS if name in one and name in other}
    known |= {name: max(cost[name] for cost in (one, other) if name in cost)
              for name in _PEAKS if name in one or name in other}  # fmt: skip
    share = one["iterations"] / max(known["iterations"], 1)

    def mixed(a: float, b: float) -> float:
        return share * a + (1.0 - share) * b

    known["ms_per_iteration"] = mixed(one["ms_per_iteration"], other["ms_per_iteration"])
    parts = {
        name: mixed(first["ms_parts"].get(name, 0.0), second["ms_parts"].get(name, 0.0))
        for name in {**first["ms_parts"], **second["ms_parts"]}
    }
    extra: dict[str, object] = {"ms_parts": parts, "passes": 2, "first_pass_s": first["train_s"]}
    if "timing" in first and "timing" in second:
        extra["timing"] = _both_timings(first["timing"], second["timing"], first["train_s"])
    return cast(Cost, {**second, **known, **extra})


def _both_timings(first: TimeRecord, second: TimeRecord, first_s: float) -> TimeRecord:
    """The record of both trainings, one after the other: the worse verdict, and all calibrations."""
    worse = min((first, second), key=lambda record: _WORST_FIRST.index(record["verdict"]))
    both: TimeRecord = {**second, "verdict": worse["verdict"], "reason": worse["reason"]}
    both["samples"] = [*first["samples"], *([first_s + s, kernel] for s, kernel in second["samples"])]
    both["runs"] = max(first["runs"], second["runs"])
    if "others" in first and "others" in second:
        both["others"] = max(first["others"], second["others"])
    return both
