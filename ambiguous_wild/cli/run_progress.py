"""Print the progress of runs, and a summary when all have ended."""

from __future__ import annotations

import contextlib
import json
import logging
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.harness.callbacks import Lines, outcome_line, run_name
from ambiguous_wild.io.terminal import keep_clock_running, say

if TYPE_CHECKING:
    from ambiguous_wild.harness.benchmark import BenchReport
    from ambiguous_wild.harness.cell import Cell, CellReport
    from ambiguous_wild.splat.trainer import Trainer


VERBOSE = "verbose"  # name of the handler of --verbose, which prints what bars do not


class ProgressBar(Lines):
    """A bar for each run, if runs are made one by one; it also names work between the steps.

    Warnings stay above the bar; where standard error is no terminal the names of work are lines as well. Several
    runs at a time have lines alone, because their bars would mix.
    """

    def __init__(self) -> None:
        super().__init__(say)
        self.one_by_one = False
        self.bar: Any = None
        self.phases = logging.Handler(logging.INFO)
        self.phases.emit = self._phase  # type: ignore[method-assign]
        context = click.get_current_context(silent=True)
        if context is not None:  # none after Ctrl-C or an error
            context.call_on_close(self._close)

    def planned(self, cells: Sequence[Cell], one_by_one: bool) -> None:
        super().planned(cells, one_by_one)
        self.one_by_one = one_by_one

    def started(self, cell: Cell, folder: Path) -> None:
        if not self.one_by_one:
            super().started(cell, folder)
            return
        from tqdm import tqdm

        group = f", {cell.group}" if cell.group else ""
        say(f"[{self.done + 1}/{self.total}] {run_name(cell)}{group} -> {folder}")
        self._close()
        budget = cell.train.budget_s
        training = "" if budget is None else f", then {tqdm.format_interval(budget)} of training"
        self._open(total=None, bar_format=f"{{desc}}[{{elapsed}}{training}]")
        logging.getLogger("ambiguous_wild").addHandler(self.phases)

    def _open(self, **settings: Any) -> None:
        """Show a bar in place of the present one, with its name."""
        from tqdm import tqdm

        if self.bar is not None:
            settings["desc"] = self.bar.desc
            self.bar.close()
        self.bar = tqdm(
            mininterval=1.0, disable=not sys.stderr.isatty(), leave=False, file=sys.stderr, **settings
        )
        keep_clock_running(self.bar)

    def _phase(self, record: logging.LogRecord) -> None:
        if self.bar is None:
            return
        self.bar.set_description(text := record.getMessage())
        printed = any(h.name == VERBOSE for h in logging.getLogger("ambiguous_wild").handlers)
        if not printed and (self.bar.disable or record.levelno > logging.INFO):
            say(f"    {text}")

    def _close(self) -> None:
        logging.getLogger("ambiguous_wild").removeHandler(self.phases)
        if self.bar is not None:
            self.bar.close()
            self.bar = None

    def tick(self, trainer: Trainer) -> None:
        budget = trainer.config.budget_s
        done = 100.0 * trainer.progress(trainer.iteration) if budget else trainer.iteration
        setting_up = self.bar.total is None  # until here, with a clock of its own
        if setting_up or budget or trainer.iteration % 25 == 0 or trainer.done:
            state = f"{trainer.ms_per_iteration:.0f} ms/it, {len(trainer.gaussians):,} Gaussians"
            if budget:  # its end is known, and need not be guessed from the steps so far
                left = self.bar.format_interval(max(budget - trainer.clock.now(), 0.0))
                state = f"{left} left, {state}"
            self.bar.set_postfix_str(state, refresh=False)
        if setting_up:
            form = "{desc}{percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f}"
            form += "% [{elapsed}{postfix}]" if budget else "it [{elapsed}<{remaining}{postfix}]"
            total = 100.0 if budget else trainer.config.iterations
            self._open(total=total, initial=0.0 if budget else done - 1, bar_format=form, postfix=state)
        self.bar.update(done - self.bar.n)

    def ended(self, cell: Cell, report: CellReport) -> None:
        if not self.one_by_one:
            super().ended(cell, report)
            return
        self._close()
        self.done += 1
        if report.outcome != "failed" or self.total > 1:  # a single failure is the command's one error line
            say(f"    {outcome_line(report)}")


@contextlib.contextmanager
def ticking(**settings: Any) -> Iterator[Callable[[int, int | None], None]]:
    """Yield a function that moves a bar in the terminal to (done, total); the bar appears with its first call."""
    from tqdm import tqdm

    bar: Any = None

    def tick(done: int, total: int | None) -> None:
        nonlocal bar
        if bar is None:
            bar = tqdm(**{"disable": None, "file": sys.stderr, **settings})
            keep_clock_running(bar)
        bar.total = total
        bar.update(done - bar.n)

    try:
        yield tick
    finally:
        if bar is not None:
            bar.close()


def finish(report: BenchReport, as_json: bool, *, tabulated: bool = False) -> None:
    """Print how the runs ended and how to compare them.

    Args:
        report: of the runs.
        as_json: print it as JSON.
        tabulated: the command has printed the tables of a suite.

    Raises:
        AwError: a run failed.
    """
    if as_json:
        rows = [
            {"folder": str(run.folder), "outcome": run.outcome, "error": run.error or None}
            for run in report.runs
        ]
        click.echo(json.dumps(rows, indent=2))
    failed, count, folders = report.failed, len(report.runs), report.folders
    if len(failed) == count == 1:
        raise AwError(failed[0].error)
    output = shlex.quote(str(report.output))
    if tabulated:
        compare = "the same command prints these tables again"
    else:
        compare = f"compare them with: aw {'cost' if len(folders) > 1 else 'table'} {output}"
    if len(folders) > 1:
        compare += f", or one folder with: aw table {shlex.quote(str(folders[0]))}"
    else:
        scenes = sorted({run.folder.parent.parent.name for run in report.runs})
        one = shlex.quote(str(folders[0] / scenes[0])) if len(scenes) > 1 else output
        compare += f", look at them{' scene by scene' * (len(scenes) > 1)} with: aw view {one}"
    summary = ", ".join(f"{n} {outcome}" for outcome, n in report.outcomes.items())
    say(f"{counted(count, 'run')}: {summary}; {compare}")
    if failed:
        raise AwError(f"{len(failed)} of {count} runs failed: " + failed[0].error)
