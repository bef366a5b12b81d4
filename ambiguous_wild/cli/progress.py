"""What is said while runs are made, one after another, and when all are there."""

from __future__ import annotations

import json
import shlex
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.core.errors import AwError

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell, CellReport
    from ambiguous_wild.splat.trainer import Trainer


class Progress:
    """A bar a cell; on stderr, so that stdout stays clean for results."""

    def __init__(self, cells: int) -> None:
        self.cells, self.index = cells, 0
        self.bar: Any = None

    def start(self, cell: Cell, folder: Path) -> None:
        self.index += 1
        self.title = (
            f"[{self.index}/{self.cells}] {cell.method.name} on {cell.scene.name}, seed {cell.train.seed}"
            + (f", {cell.group}" if cell.group else "")
        )
        click.echo(f"{self.title} -> {folder}", err=True)

    def tick(self, trainer: Trainer) -> None:
        from tqdm import tqdm

        if self.bar is None:
            budget = trainer.config.budget_s
            self.bar = tqdm(
                total=100.0 if budget is not None else trainer.config.iterations,
                unit="%" if budget is not None else "it",
                bar_format="{l_bar}{bar}| {n:.0f}/{total:.0f}{unit} [{elapsed}<{remaining}]{postfix}",
                mininterval=1.0,
                disable=None if sys.stderr.isatty() else True,
                file=sys.stderr,
            )
        done = 100.0 * trainer.progress(trainer.iteration) if trainer.config.budget_s else trainer.iteration
        if trainer.iteration % 25 == 0 or trainer.done:
            self.bar.set_postfix_str(
                f"{trainer.ms_per_iteration:.0f} ms/it, {len(trainer.gaussians):,} Gaussians", refresh=False
            )
        self.bar.update(done - self.bar.n)

    def end(self, cell: Cell, report: CellReport) -> None:
        if self.bar is not None:
            self.bar.close()
            self.bar = None
        if report.outcome != "failed" or self.cells > 1:  # a single failure is the command's one error line
            click.echo(f"    {outcome_line(report)}", err=True)


def outcome_line(report: CellReport) -> str:
    if report.outcome == "kept":
        return "finished before, kept"
    if report.outcome == "skipped":
        return "exists, left as it is (--overwrite never)"
    if report.outcome == "failed":
        return "failed: " + " ".join(report.error.split())
    cost, images = report.result["cost"], report.result["per_image"]
    values = [float(row["psnr"]) for row in images]
    parts = [f"PSNR {sum(values) / len(values):.2f} dB over {len(values)} test views"] if values else []
    # Of an external program not everything is known.
    known = {
        "train_s": "{:.0f} s training",
        "ms_per_iteration": "{:.1f} ms/iteration",
        "gaussians": "{:,} Gaussians",
    }
    parts += [text.format(cost[name]) for name, text in known.items() if cost.get(name) is not None]
    return ", ".join(parts)


def finish(reports: list[CellReport], output: Path, as_json: bool, folders: list[str]) -> None:
    counts = Counter(report.outcome for report in reports)
    summary = ", ".join(f"{n} {name}" for name, n in counts.items())
    if as_json:
        rows = [{"folder": str(r.folder), "outcome": r.outcome, "error": r.error or None} for r in reports]
        click.echo(json.dumps(rows, indent=2))
    failed = [report for report in reports if report.outcome == "failed"]
    if len(failed) == len(reports) == 1:
        raise AwError(failed[0].error)
    compare = f"compare them with: aw {'cost' if len(folders) > 1 else 'table'} {shlex.quote(str(output))}"
    if len(folders) > 1:
        compare += f", or one folder with: aw table {shlex.quote(folders[0])}"
    click.echo(f"{len(reports)} run{'s' if len(reports) > 1 else ''}: {summary}; {compare}", err=True)
    if failed:
        raise AwError(f"{len(failed)} of {len(reports)} runs failed: " + failed[0].error)
