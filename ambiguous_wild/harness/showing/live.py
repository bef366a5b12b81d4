"""What `aw view --live` does, as a call: a run of `aw bench` that is watched."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.harness.bench import BenchReport, bench
from ambiguous_wild.harness.running.callbacks import Callbacks, outcome_line, run_name
from ambiguous_wild.viewing.live import LiveView

if TYPE_CHECKING:
    from ambiguous_wild.harness.running.cell import Cell, CellReport
    from ambiguous_wild.splat.trainer import Trainer


class Watched(Callbacks):
    """Shows every step of a run to a live view."""

    def __init__(self, view: LiveView, say: Callable[[str], None] = lambda text: None) -> None:
        self.view, self._say = view, say

    def say(self, text: str) -> None:
        self._say(text)

    def planned(self, cells: Sequence[Cell], one_by_one: bool) -> None:
        assert one_by_one, "only then is tick called"

    def started(self, cell: Cell, folder: Path) -> None:
        self._say(f"{run_name(cell)} -> {folder}")

    def tick(self, trainer: Trainer) -> None:
        self.view.tick(trainer)

    def ended(self, cell: Cell, report: CellReport) -> None:
        told = f"{run_name(cell)}: {outcome_line(report)}"
        self.view.end(told)
        self._say(told)


def watch(
    scene: Path,
    method: str,
    output: Path,
    *,
    iterations: int | None = None,
    max_gaussians: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    device: str = "auto",
    host: str = "127.0.0.1",
    port: int = 8080,
    paused: bool = False,
    say: Callable[[str], None] = lambda text: None,
    view: LiveView | None = None,
) -> BenchReport:
    """Train a method on a scene and show it in a browser.

    Args:
        scene: its folder.
        method: as `aw bench --method`.
        output: folder of the run, as `aw bench -o`; a run that stopped goes on.
        iterations, max_gaussians, seed, threads, device: as in `bench`.
        host, port: where the page is served.
        paused: pause after the first step.
        say: told the address and the outcome.
        view: a view to use instead of a new one; it stays open.

    Raises:
        AwError: viser is missing, the port is taken, or the run failed.
    """
    from ambiguous_wild.core import AwError

    shown = LiveView(host, port, paused=paused) if view is None else view
    try:
        say(f"watch it at http://{host}:{shown.port}")
        report = bench(
            method,
            scene,
            output=output,
            seeds=(seed,),
            iterations=iterations,
            train={} if max_gaussians is None else {"max_gaussians": max_gaussians},
            threads=threads,
            device=device,  # type: ignore[arg-type]
            jobs=1,
            callbacks=Watched(shown, say),
        )
    finally:
        if view is None:
            shown.stop()
    if report.failed:
        raise AwError(report.failed[0].error)
    return report
