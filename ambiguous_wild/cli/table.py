"""`aw table`: runs in tables; `aw rescore`: metrics that were missing; `aw audit`: errors in printed tables."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import (
    Format,
    PathName,
    command_line,
    json_option,
    label_option,
    metric_file_option,
    only_option,
    reported_option,
    scene_folder_option,
    style_of,
)
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.terminal import line_width, say

if TYPE_CHECKING:
    from ambiguous_wild.harness.store import Runs
    from ambiguous_wild.report.table_layout import Table

STYLES = ("text", "markdown", "csv", "latex", "html", "tidy")
# Suffix of -o -> format.
SUFFIXES = {
    ".txt": "text", ".md": "markdown", ".csv": "csv", ".tex": "latex", ".html": "html", "": "text"
}  # fmt: skip
AUDIT_SUFFIXES = {".txt": "text", ".md": "markdown", ".csv": "csv", ".json": "json", "": "text"}
LAYOUTS = ("blocks", "paper", "means", "ablation")


@click.command(name="table")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "--format",
    "style",
    type=Format(STYLES, {"tex": "latex", "md": "markdown", "txt": "text"}),
    help="[default: by the suffix of -o, else text]",
)
@click.option(
    "--layout", type=click.Choice(LAYOUTS), default="blocks", show_default=True,
    help="blocks: a table per scene; paper: scenes side by side; means: datasets side by side; "
    "ablation: RUNS is the output of 'aw ablate'.",
)  # fmt: skip
@click.option("-o", "--output", type=PathName(dir_okay=False), help="Write to this file.")
@click.option(
    "--metric",
    "metrics",
    multiple=True,
    help="Only this column; repeatable. all: every column, however wide.  [default: those that fit, in text]",
)
@only_option
@label_option
@click.option(
    "--compare", metavar="METHOD,METHOD",
    help="Differences of the first method to each other one, with intervals, p, wins and losses.",
)  # fmt: skip
@click.option(
    "--dataset", "datasets", multiple=True, metavar="NAME=SCENE,SCENE",
    help="Group these scenes as dataset NAME; repeatable.  [default: as in the papers' tables]",
)  # fmt: skip
@reported_option("those of the package")
def table_command(
    runs: tuple[Path, ...],
    style: str | None,
    layout: str,
    output: Path | None,
    metrics: tuple[str, ...],
    scenes: tuple[str, ...],
    labels: tuple[str, ...],
    compare: str | None,
    datasets: tuple[str, ...],
    reported: Path | bool | None,
) -> None:
    """Compare the runs below the folders RUNS: quality, cost and masks, method by method.

    Means are over images, then seeds, then scenes. Missing, failed and incomparable runs are named below the
    table (for CSV: on standard error; what limits ranks also in the column note). If several folders hold
    runs of one method, scene and seed, the rows of this method name their folder.

    \b
    aw table runs
    aw table runs runs-masked                     several folders in one table
    aw table runs --layout paper -o table.tex
    aw table runs --label 3dgs=3DGS --label mine=Ours -o table.tex
    aw table runs --compare mine,robustsplat      is the difference more than chance?
    aw table runs --format tidy -o results.csv    one row per method, scene, seed, image and metric
    """
    if output is not None and output.suffix.lower() not in SUFFIXES and output.exists():
        raise AwError(f"{output} exists, and by its name it is no table: choose another -o")
    style = style or style_of(output, SUFFIXES, ", or give --format")
    everything = "all" in metrics
    if everything and len(metrics) > 1:
        raise AwError("--metric all names every column: leave the other --metric out")
    metrics = () if everything else metrics
    if style == "tidy":
        if layout != "blocks" or datasets or reported or compare:
            raise AwError(
                "--format tidy goes with --metric, --only, --label and -o alone: it is every number there is"
            )
        _write_tidy(_read(runs, labels), output, metrics, scenes)
        return
    if compare is not None and (layout != "blocks" or datasets or reported):
        raise AwError("--compare is a table of its own: leave --layout, --dataset and --reported out")
    if layout in ("blocks", "ablation"):
        refused = {"--dataset": datasets, "--reported": reported}
        if layout == "ablation":
            if len(runs) > 1:
                raise AwError("--layout ablation shows one folder, the output of 'aw ablate': give RUNS once")
            refused |= {"--only": scenes, "--label": labels}
        for flag, value in refused.items():
            if value:
                instead = "leave it out" if layout == "ablation" else "give --layout paper or means"
                raise AwError(f"{flag} does not go with --layout {layout}: {instead}")
    loaded = None if layout == "ablation" else _read(runs, labels)
    named_style = None if style == "text" else style
    made_by = "command: " + command_line(style=named_style, output=None, metrics=metrics)
    if compare is not None and loaded is not None:
        _write_pairs(loaded, compare, style, output, metrics, scenes, made_by)
        return
    tables = _layouts(loaded, runs[0], layout, metrics, scenes, _named(datasets), reported)
    blocks = layout == "blocks" and style != "html"
    width = _width(everything or (blocks and bool(metrics)), output) if style == "text" else None
    color = style == "text" and output is None and sys.stdout.isatty()
    notes_width = None if output is not None else line_width()
    _put(*_formatted(tables, style, blocks, made_by, color, width, notes_width), output)


def _put(text: str, summary: str, output: Path | None) -> None:
    """Print the text, or write it to a file and say what it holds."""
    if output is None:
        click.echo(text, nl=False)
        return
    from ambiguous_wild.io.files import write_text

    write_text(output, text)
    say(f"wrote {output}: {summary}")


def _read(runs: Sequence[Path], labels: Sequence[str]) -> Runs:
    from ambiguous_wild.harness.store import read_runs

    return read_runs(*runs, labels=labels)


def _width(everything: bool, output: Path | None) -> int | None:
    """Return how many characters a row of a text table may have; None: any number."""
    from ambiguous_wild.report.plain_formats import WIDTH

    if everything:
        return None
    return WIDTH if output is not None else shutil.get_terminal_size((WIDTH, 0)).columns


def _write_tidy(loaded: Runs, output: Path | None, metrics: Sequence[str], scenes: Sequence[str]) -> None:
    from ambiguous_wild.report.comparison import comparison, tidy
    from ambiguous_wild.report.plain_formats import UNEQUAL, to_csv

    for note in comparison(loaded, metrics=metrics, scenes=scenes)[-1].notes:
        if note.startswith(UNEQUAL):
            say(note)
    frame = tidy(loaded, metrics=metrics, scenes=scenes)
    text = to_csv(list(frame.columns), frame.itertuples(index=False, name=None))
    for run in loaded.incomplete:
        say(f"incomplete: {run.folder}: {run.reason}")
    _put(text, f"{len(frame)} rows", output)


def _write_pairs(
    loaded: Runs,
    compare: str,
    style: str,
    output: Path | None,
    metrics: Sequence[str],
    scenes: Sequence[str],
    made_by: str,
) -> None:
    from ambiguous_wild.report.pairs import compared, names_of, pair_table, pairs_csv
    from ambiguous_wild.report.plain_formats import divided

    pairs, notes = compared(loaded, names_of(compare, loaded), metrics=metrics, scenes=scenes)
    table = pair_table(pairs, notes).with_notes(made_by)
    width = _width(False, output) if style == "text" else None
    if style == "csv":
        _echo_notes([table], made_by)
        text = pairs_csv(pairs, notes)
    else:
        notes_width = None if output is not None else line_width()
        text = _written([table] if width is None else divided(table, width), style, False, notes_width)
    _put(text, counted(len(pairs), "difference"), output)


def _formatted(
    tables: list[Table],
    style: str,
    blocks: bool,
    made_by: str,
    color: bool,
    width: int | None,
    notes_width: int | None,
) -> tuple[str, str]:
    """Return the tables as text, and what they hold in words; `blocks`: all have the same columns."""
    from ambiguous_wild.report.papers import cost_at_the_end
    from ambiguous_wild.report.plain_formats import divided, fitted, to_long_csv, to_wide_csv

    if blocks and width is not None:
        tables = fitted(tables, width)
    columns = [column for table in tables for column in table.columns]
    counts = {
        tables[0].head: len({row.name for table in tables for row in table.rows}),
        "scene": len({column.scene for column in columns} - {""}),  # none where all are means
        "metric": len({column.measure.key for column in columns if not column.words}),
    }
    summary = ", ".join(counted(number, what) for what, number in counts.items() if number)
    if style == "csv":
        _echo_notes(tables, made_by)
        return to_wide_csv(tables) if blocks else to_long_csv(tables), summary
    if blocks:
        tables = [cost_at_the_end(tables)] if style == "latex" else tables
        return _written([*tables[:-1], tables[-1].with_notes(made_by)], style, color, notes_width), summary
    tables = [one.with_notes(made_by) for one in tables]
    if width is not None:
        tables = [part for one in tables for part in divided(one, width)]
    return _written(tables, style, color, notes_width), summary


def _echo_notes(tables: Sequence[Table], made_by: str) -> None:
    for note in dict.fromkeys([note for table in tables for note in table.notes] + [made_by]):
        say(note)


def _written(tables: Sequence[Table], style: str, color: bool, width: int | None) -> str:
    from ambiguous_wild.report.plain_formats import to_markdown, to_text
    from ambiguous_wild.report.typeset import to_html, to_latex

    if style == "text":
        return to_text(tables, color=color, width=width)
    return {"markdown": to_markdown, "latex": to_latex, "html": to_html}[style](tables)


def _layouts(
    loaded: Runs | None,
    runs: Path,
    layout: str,
    metrics: Sequence[str],
    scenes: Sequence[str],
    datasets: dict[str, list[str]],
    reported: Path | bool | None,  # True: the numbers of the package
) -> list[Table]:
    from ambiguous_wild.report import papers
    from ambiguous_wild.report.papers import datasets_of, read_reported, with_reported

    if loaded is None:
        from ambiguous_wild.report.ablation_report import ablation

        return ablation(runs, tuple(metrics))
    if layout == "blocks":
        return papers.in_blocks(loaded, metrics=metrics, scenes=scenes)
    numbers = read_reported(reported if isinstance(reported, Path) else None) if reported else []
    if not datasets:
        datasets = datasets_of(numbers or read_reported(), sorted(set(loaded.runs["scene"])))
    if layout == "means":
        tables = papers.means(loaded, metrics=metrics, scenes=scenes, datasets=datasets)
    else:
        tables = papers.paper(loaded, metrics=metrics, scenes=scenes, datasets=datasets)
    return [with_reported(one, numbers) for one in tables] if numbers else tables


def _named(datasets: Sequence[str]) -> dict[str, list[str]]:
    named: dict[str, list[str]] = {}
    for text in datasets:
        name, equals, members = text.partition("=")
        scenes = [scene.strip() for scene in members.split(",") if scene.strip()]
        if not equals or not name.strip() or not scenes:
            raise AwError(f"--dataset {text!r}: write NAME=SCENE,SCENE")
        named.setdefault(name.strip(), []).extend(scenes)
    return named


@click.command(name="rescore")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@scene_folder_option
@metric_file_option
@json_option
def rescore_command(
    runs: tuple[Path, ...], scene_folder: Path | None, metrics: tuple[Path, ...], as_json: bool
) -> None:
    """Add metrics that were missing when the runs below RUNS ended, e.g. LPIPS whose weights were absent.

    Nothing is trained: the saved renders are compared with the scene's test photos. First every number of a
    result is computed again; a run whose renders, photos or settings were changed is refused. metrics.json
    records the added metrics and the version that added them.

    \b
    aw rescore runs
    aw table runs
    """
    from ambiguous_wild.harness.measures import load_metrics
    from ambiguous_wild.report.rescore import rescore

    for file in metrics:
        load_metrics(file)
    reports = rescore(runs, scene=scene_folder)
    if as_json:
        click.echo(json.dumps([dataclasses.asdict(r) | {"run": str(r.run)} for r in reports], indent=2))
    else:
        for r in reports:
            what = r.error or (f"added {', '.join(r.added)}" if r.added else "nothing to add")
            still = f"; still missing: {', '.join(r.missing)}" if r.missing and not r.error else ""
            say(f"{r.run}: {what}{still}", out=True)
    counts = Counter(r.outcome for r in reports)
    say(", ".join(f"{n} {outcome}" for outcome, n in counts.items()))
    refused = [r for r in reports if r.outcome == "refused"]
    if refused:
        raise AwError(f"{len(refused)} of {len(reports)} runs refused: {refused[0].error}")


@click.command("audit")
@click.argument("tables", nargs=-1, type=PathName())
@click.option(
    "-o", "--output", type=PathName(dir_okay=False), help="Write to this file: .txt, .md, .csv or .json."
)
@click.option("--strict", is_flag=True, help="Exit with code 1 if anything is found.")
@json_option
def audit_command(tables: tuple[Path, ...], output: Path | None, strict: bool, as_json: bool) -> None:
    """Check TABLES (CSV, or folders of them; default: the paper's tables, which come with the package).

    Finds suspiciously equal numbers, contradictions between tables, swapped numbers, means that do not match
    their values, implausible SSIM and LPIPS, and wrong ranks. The correct values are not known, so a finding
    is a question to the authors of the table.
    """
    from ambiguous_wild.io.files import write_text
    from ambiguous_wild.report.audit import audit, csv_of, markdown_of, text_of
    from ambiguous_wild.report.audit_numbers import REPORTED, read_tables

    style = "json" if as_json else style_of(output, AUDIT_SUFFIXES)
    numbers = read_tables(tables or (REPORTED,))
    findings = audit(numbers)
    if style == "json":
        text = json.dumps([dataclasses.asdict(f) for f in findings], indent=2, ensure_ascii=False) + "\n"
    else:
        text = {"text": text_of, "markdown": markdown_of, "csv": csv_of}[style](findings)
    if output is not None:
        write_text(output, text)
    else:
        click.echo(text, nl=style == "text" and bool(findings))
    count = len({n.table for n in numbers})
    say(
        f"{counted(len(findings), 'finding')} in {counted(len(numbers), 'number')} of {counted(count, 'table')}"
    )
    if strict and findings:
        sys.exit(1)
