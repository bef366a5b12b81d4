"""What a caller can be told while runs are made. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ambiguous_wild.harness.running.cell import Cell, CellReport
    from ambiguous_wild.splat.trainer import Trainer


class Callbacks:
    """Called while runs are made; does nothing. A subclass overrides what it needs."""

    def say(self, text: str) -> None:
        """One line: effects that a plan chose, a warning, what is compiled, the cluster."""

    def planned(self, cells: Sequence[Cell], one_by_one: bool) -> None:
        """Before the first run. `one_by_one`: in this process; only then is `tick` called."""

    def started(self, cell: Cell, folder: Path) -> None:
        """A run begins, or begins again after its process died. A Ray cluster does not tell."""

    def tick(self, trainer: Trainer) -> None:
        """After every iteration, with the clock of the run stopped."""

    def ended(self, cell: Cell, report: CellReport) -> None:
        """A run was trained, kept, skipped or failed."""


class Lines(Callbacks):
    """Writes a line where a run begins and one where it ends."""

    def __init__(self, write: Callable[[str], None] = print) -> None:
        self.write = write
        self.total = self.done = 0

    def say(self, text: str) -> None:
        self.write(text)

    def planned(self, cells: Sequence[Cell], one_by_one: bool) -> None:
        self.total, self.done = len(cells), 0

    def started(self, cell: Cell, folder: Path) -> None:
        self.write(f"begins: {run_name(cell)}")

    def ended(self, cell: Cell, report: CellReport) -> None:
        self.done += 1
        self.write(f"[{self.done}/{self.total}] {run_name(cell)}: {outcome_line(report)} -> {report.folder}")


def run_name(cell: Cell) -> str:
    """ "3dgs on courtyard, seed 0"."""
    return f"{cell.method.name} on {cell.scene.name}, seed {cell.train.seed}"


def outcome_line(report: CellReport) -> str:
    """What became of a run, in one line."""
    if report.outcome == "kept":
        return "finished before, kept"
    if report.outcome == "skipped":
        return "exists, left as it is (--overwrite never)"
    if report.outcome == "failed":
        return "failed: " + " ".join(report.error.split())
    if report.result is None:
        return "trained"
    from ambiguous_wild.harness.running.timing import timing_of

    cost: Mapping[str, Any] = report.result["cost"]
    values = [float(v) for row in report.result["per_image"] if (v := row.get("psnr")) is not None]
    parts = [f"PSNR {sum(values) / len(values):.2f} dB over {len(values)} test views"] if values else []
    # Of an external program not everything is known.
    known = {
        "train_s": "{:.0f} s training",
        "ms_per_iteration": "{:.1f} ms/iteration",
        "gaussians": "{:,} Gaussians",
    }
    parts += [text.format(cost[name]) for name, text in known.items() if cost.get(name) is not None]
    effects: Mapping[str, Mapping[str, Any]] = report.result["facts"].get("effect_facts", {})
    bare = [name for name, facts in effects.items() if facts.get("points") == 0]
    parts += [f"no point of {' and '.join(bare)} (no room under --max-gaussians?)"] if bare else []
    timing = timing_of(cost)
    parts += [f"time not ranked: {timing.reason}"] if timing.verdict == "contended" else []
    return ", ".join(parts)
