"""Settings of where runs are made, and the calls that report their progress. Imports nothing heavy."""

from __future__ import annotations

import importlib.util
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ambiguous_wild.core.errors import AwError, counted, install_command

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport
    from ambiguous_wild.splat.trainer import Trainer

_RAY_ONLY = {  # field -> option
    "address": "--address",
    "cpus_per_cell": "--set engine.cpus_per_cell",
    "gpus_per_cell": "--set engine.gpus_per_cell",
    "memory_per_cell": "--set engine.memory_per_cell",
}


@dataclass(frozen=True)
class Engine:
    """Where cells run, and how many at a time."""

    engine: Literal["local", "ray"] = "local"
    jobs: int | None = None  # cells at a time on this machine; None = 1, on cuda one a GPU
    address: str | None = None  # of a Ray cluster; None = $RAY_ADDRESS, else a Ray of our own
    cpus_per_cell: float | None = None  # Ray; None = the threads, else 1
    gpus_per_cell: float | None = None  # Ray; None = 1 on cuda
    memory_per_cell: float | None = None  # Ray; GB
    retries: int = 3  # of a cell whose process or node was lost
    transfer: Literal["shared", "store"] = "shared"  # Ray; "store": scenes and runs travel
    transfer_limit: float = 4000.0  # Ray; MB of the largest scene or run that travels

    def check(self) -> None:
        """Raise AwError for settings that exclude each other, before anything heavy is loaded."""
        stray = [option for name, option in _RAY_ONLY.items() if getattr(self, name) is not None]
        if self.engine == "local" and (stray or self.transfer != "shared"):
            raise AwError(
                f"{', '.join(stray) or '--set engine.transfer'} is for a cluster: add --engine ray, or leave "
                "it out"
            )
        if self.engine == "ray":
            if importlib.util.find_spec("ray") is None:
                raise AwError(f"--engine ray needs Ray: {install_command('ray')}")
            if self.jobs is not None and self.remote:
                raise AwError(
                    "--jobs is for this machine: a cluster (--address or $RAY_ADDRESS) runs as many cells as "
                    "fit"
                )

    @property
    def remote(self) -> bool:
        """Whether it is a running cluster, not a Ray that this process starts."""
        return self.engine == "ray" and bool(self.address or os.environ.get("RAY_ADDRESS"))


class Callbacks:
    """Called while runs are made; does nothing. A subclass overrides what it needs."""

    def say(self, text: str) -> None:
        """A line for the user is due: effects of a plan, a warning, a compilation, the cluster."""

    def planned(self, cells: Sequence[Cell], one_by_one: bool) -> None:
        """The runs are planned. `one_by_one`: they run in this process; only then is `tick` called."""

    def started(self, cell: Cell, folder: Path) -> None:
        """A run begins, or begins again after its process died. With Ray this is never called."""

    def tick(self, trainer: Trainer) -> None:
        """An iteration has ended; the clock of the run is stopped."""

    def ended(self, cell: Cell, report: CellReport) -> None:
        """A run was trained, kept, skipped or failed."""


class Lines(Callbacks):
    """Write a line when a run begins and when it ends."""

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
    """Return, for example, "3dgs on courtyard, seed 0"."""
    return f"{cell.method.name} on {cell.scene.name}, seed {cell.train.seed}"


def outcome_line(report: CellReport) -> str:
    """Return the outcome of a run as one line."""
    if report.outcome == "kept":
        return "finished before, kept"
    if report.outcome == "skipped":
        return "exists, left as it is (--overwrite never)"
    if report.outcome == "failed":
        return "failed: " + " ".join(report.error.split())
    if report.result is None:
        return "trained"
    from ambiguous_wild.harness.result_file import NOT_BEGUN, mean_of
    from ambiguous_wild.harness.timing import timing_of

    cost = report.result["cost"]
    psnr, views = mean_of(report.result, "psnr"), counted(len(report.result["per_image"]), "test view")
    parts = [f"PSNR {psnr:.2f} dB over {views}"] if math.isfinite(psnr) else []
    # an external program may not report all of these
    if (train_s := cost.get("train_s")) is not None:
        parts.append(f"{train_s:.0f} s training")
    if (ms := cost.get("ms_per_iteration")) is not None:
        parts.append(f"{ms:.1f} ms/iteration")
    if (gaussians := cost.get("gaussians")) is not None:
        parts.append(f"{gaussians:,} Gaussians")
    effects = report.result["facts"].get("effect_facts", {})
    empty = [name for name, facts in effects.items() if facts.get("points") == 0]
    if empty:
        parts.append(f"{' and '.join(empty)} added no point")
    no_masks = str(report.result["facts"].get("no_masks", ""))
    parts += [f"{no_masks}, a run too short"] if no_masks.startswith(NOT_BEGUN) else []
    timing = timing_of(cost)
    parts += [f"time not ranked: {timing.reason}"] if timing.verdict == "contended" else []
    return ", ".join(parts)
