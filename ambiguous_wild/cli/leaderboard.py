"""`aw leaderboard`: add runs, publish the page, check the board."""

from __future__ import annotations

import dataclasses
import json
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.cli.options import (
    CommandGroup,
    PathName,
    json_option,
    label_option,
    reported_option,
    title_option,
)
from ambiguous_wild.core.errors import AwError, counted
from ambiguous_wild.io.terminal import say

if TYPE_CHECKING:
    from ambiguous_wild.report.board_edit import AddReport

_board = click.option(
    "--board",
    type=PathName(file_okay=False),
    default=Path("leaderboard"),
    show_default=True,
    help="Folder of the leaderboard.",
)


@click.group("leaderboard", cls=CommandGroup)
def command() -> None:
    """Leaderboard: check runs, collect them in CSV files, publish them as a page.

    \b
    aw leaderboard add runs                 check finished runs and add them
    aw leaderboard remove --method NAME     remove runs
    aw leaderboard publish -o site          CSVs and a page that opens from a file
    aw leaderboard check                    check the board again
    """


@command.command("add")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@_board
@click.option(
    "--dataset",
    help="Dataset of these runs.  [default: as scene.json says; of 'aw simulate' the suite's, else simulated]",
)
@click.option(
    "--scene",
    "scenes",
    type=PathName(file_okay=False),
    help="Scene folder, or a folder of scenes.  [default: as the runs say]",
)
@click.option(
    "--images",
    type=click.IntRange(0, 20),
    default=3,
    show_default=True,
    help="Copies to keep per scene for the page: N test images and N train photos with masks.",
)
@click.option(
    "--overwrite", "replace_other", is_flag=True, help="Replace a run on the board that has other numbers."
)
@click.option("--quick", is_flag=True, help="Recompute only PSNR.")
@click.option("--dry-run", is_flag=True, help="Check only; write nothing.")
@json_option
def add_command(
    runs: tuple[Path, ...],
    board: Path,
    dry_run: bool,
    as_json: bool,
    **options: Any,  # the other arguments of `add`, by their names
) -> None:
    """Check RUNS (run folders, or folders of them) and add those that pass.

    Changed, partial, failed and foreign runs are refused, one line each; unfinished runs are
    left for later. Adding a run twice changes nothing.
    """
    from ambiguous_wild.cli.run_progress import ticking
    from ambiguous_wild.report.board_edit import add

    with ticking(unit="run") as tick:
        reports = add(board, runs, dry=dry_run, tick=tick, **options)
    _print_reports(reports, as_json)
    counts = Counter(r.outcome for r in reports)
    outcomes = ", ".join(f"{n} {outcome}" for outcome, n in counts.items())
    dry_note = " (nothing written)" if dry_run else ""
    say(f"{counted(len(reports), 'run')}: {outcomes}{dry_note}; board {board}")
    if counts["refused"]:
        sys.exit(AwError.exit_code)


def _print_reports(reports: list[AddReport], as_json: bool) -> None:
    if as_json:
        rows = [{"run": str(r.run), "outcome": r.outcome, "error": r.error or None} for r in reports]
        click.echo(json.dumps(rows, indent=2))
        return
    for r in reports:
        if r.error:
            text = f"{r.outcome}: {' '.join(r.error.split())}"
            say(text, out=True, fg="red" if r.outcome == "refused" else "")


@command.command("remove")
@_board
@click.option("--method", required=True, help="Remove runs of this method.")
@click.option("--dataset", help="Only runs of this dataset.")
@click.option("--only", "scene", metavar="NAME", help="Only runs of this scene.")
@click.option("--setting", help="Only runs of this setting, as written on the board.")
@click.option("--seed", type=click.IntRange(0), help="Only runs of this seed.")
@click.option("--dry-run", is_flag=True, help="List the runs; remove nothing.")
def remove_command(board: Path, dry_run: bool, **chosen: Any) -> None:
    """Remove runs and their pictures from the board."""
    from ambiguous_wild.report.board_edit import remove

    gone = remove(board, dry=dry_run, **chosen)
    for entry in gone:
        say(f"{'would remove' if dry_run else 'removed'}: {entry.name}", out=True)
    say(f"{counted(len(gone), 'run')}; board {board}")


@command.command("publish")
@_board
@click.option("-o", "--output", required=True, type=PathName(), help="Folder of the page.")
@reported_option("BOARD/reported or those of the package")
@title_option("Leaderboard")
@label_option
@click.option(
    "--models",
    multiple=True,
    type=PathName(),
    metavar="RUNS",
    help="Run folders, or folders of them, whose models get pages; repeatable.",
)
@json_option
def publish_command(
    board: Path,
    output: Path,
    models: tuple[Path, ...],
    as_json: bool,
    **options: Any,  # the other arguments of `publish`, by their names
) -> None:
    """Write CSVs and an offline page from the CSVs of the board.

    OUT then holds index.html, data/, images/ and, with --models, models/. An earlier page there is replaced.
    """

    from ambiguous_wild.report.board_publish import publish

    done = publish(
        board,
        output,
        models=models,
        say=say,
        **options,
    )
    if as_json:
        click.echo(json.dumps(dataclasses.asdict(done), indent=2))
    summary = f"{counted(done.runs, 'run')} of {counted(done.datasets, 'dataset')}"
    summary += f", {counted(done.images, 'picture')}"
    if models:
        summary += f", {done.model_pages} pages with models"
    if done.reported_from is not None:
        summary += f", {done.reported} reported numbers from {done.reported_from}"
    say(f"wrote {output / 'index.html'}: {summary}")


@command.command("check")
@_board
@json_option
def check_command(board: Path, as_json: bool) -> None:
    """Check the board: hashes, duplicates, pictures, files that do not match.

    A damaged board ends with exit code 2.
    """

    from ambiguous_wild.report.board_edit import check

    result = check(board)
    if as_json:
        click.echo(json.dumps(dataclasses.asdict(result), indent=2, ensure_ascii=False))
    else:
        for problem in result.problems:
            say(f"wrong: {problem}", out=True, fg="red")
    say(f"{counted(result.runs, 'run')}: {counted(len(result.problems), 'problem')}; board {board}")
    if result.problems:
        sys.exit(AwError.exit_code)
