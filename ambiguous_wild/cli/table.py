"""`aw table`: compare runs."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from ambiguous_wild.harness.store import Runs


@click.command(name="table")
@click.argument("runs", type=click.Path(path_type=Path))
@click.option("--format", "style", type=click.Choice(["text", "markdown", "csv", "latex", "tidy"]), default="text",
              show_default=True)  # fmt: skip
@click.option(
    "-o", "--output", type=click.Path(path_type=Path, dir_okay=False), help="Write to a file instead."
)
@click.option(
    "--metric", "metrics", multiple=True, help="Only this column; repeatable.  [default: all measured]"
)
@click.option("--scene", "scenes", multiple=True, help="Only this scene; repeatable.  [default: all]")
@click.option(
    "--sheet",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Also write a PNG: test renders side by side, and what each method masks.",
)
def command(
    runs: Path,
    style: str,
    output: Path | None,
    metrics: tuple[str, ...],
    scenes: tuple[str, ...],
    sheet: Path | None,
) -> None:
    """Compare the runs below the folder RUNS: quality, cost and masks, method by method.

    Means are over images, then seeds, then scenes. What is missing, failed or not comparable stands below
    the table (for CSV: on standard error).

    \b
    aw table runs
    aw table runs --format latex --metric psnr --metric ssim -o table.tex
    aw table runs --format tidy -o results.csv    one row a method, scene, seed, image and metric
    """
    from ambiguous_wild.harness.render_tables import RENDERERS, plain, to_text
    from ambiguous_wild.harness.store import read_runs
    from ambiguous_wild.harness.tables import comparison
    from ambiguous_wild.io.atomic import write_text

    found = read_runs(runs)
    if style == "tidy":
        _write_tidy(found, output, metrics, scenes)
        return
    table = comparison(found, metrics=metrics, scenes=scenes)
    if sheet is not None:
        from ambiguous_wild.harness.sheet import write_sheet

        shown = write_sheet(found, sheet, scene=scenes[0] if scenes else None)
        click.echo(f"wrote {sheet}: {shown} methods side by side", err=True)
    made_by = "made by: " + command_line(runs, style, metrics, scenes)
    if style == "csv":
        for note in (*table.notes, made_by):
            click.echo(plain(note), err=True)
    else:
        table = table.with_note(made_by)
    color = style == "text" and output is None and sys.stdout.isatty()
    text = to_text(table, color=True) if color else RENDERERS[style](table)
    if output is None:
        click.echo(text, nl=False)
        return
    write_text(output, text)
    counts = {
        "method": len(table.blocks[0].rows),
        "scene": len(table.scenes),
        "column": len(table.columns),
    }
    told = ", ".join(f"{n} {what}{'' if n == 1 else 's'}" for what, n in counts.items())
    click.echo(f"wrote {output}: {told}", err=True)


def _write_tidy(runs: Runs, output: Path | None, metrics: tuple[str, ...], scenes: tuple[str, ...]) -> None:
    from ambiguous_wild.harness.table_frame import tidy, to_csv
    from ambiguous_wild.io.atomic import write_text

    frame = tidy(runs, metrics=metrics, scenes=scenes)
    for run in runs.incomplete:
        click.echo(f"incomplete: {run.folder}: {run.reason}", err=True)
    if output is None:
        click.echo(to_csv(frame), nl=False)
        return
    write_text(output, to_csv(frame))
    click.echo(f"wrote {output}: {len(frame)} rows", err=True)


def command_line(runs: Path, style: str, metrics: tuple[str, ...], scenes: tuple[str, ...]) -> str:
    """The command that makes this table again."""
    words = ["aw", "table", str(runs)]
    words += ["--format", style] if style != "text" else []
    for flag, values in (("--metric", metrics), ("--scene", scenes)):
        for value in values:
            words += [flag, value]
    return shlex.join(words)
