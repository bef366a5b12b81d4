"""`aw cost`: accuracy against training time."""

from __future__ import annotations

import json
import math
import shlex
from pathlib import Path

import click

from ambiguous_wild.cli.paths import PathName
from ambiguous_wild.core.errors import AwError


@click.command(name="cost")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "-o", "--output", type=PathName(file_okay=False), default=Path("cost"), show_default=True,
    help="For plots, CSV and JSON.",
)  # fmt: skip
@click.option(
    "--target", "targets", multiple=True, type=float, metavar="DB",
    help="A test PSNR to reach; repeatable.  [default: 3, 1 and 0.5 dB below the best of each scene]",
)  # fmt: skip
@click.option("--scene", "scenes", multiple=True, help="Only this scene; repeatable.  [default: all]")
@click.option(
    "--with-setup",
    is_flag=True,
    help="Count features and masks made before the first step as time too; a cache makes them short.",
)
@click.option("--plots/--no-plots", default=True, show_default=True, help="Draw SVG and PNG.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON instead of tables.")
def command(
    runs: tuple[Path, ...],
    output: Path,
    targets: tuple[float, ...],
    scenes: tuple[str, ...],
    with_setup: bool,
    plots: bool,
    as_json: bool,
) -> None:
    """Show what accuracy costs: time to reach a PSNR, dB per extra minute of each effect and refresh
    interval, and which method to pay for, from the runs below the folders RUNS.

    Runs of the same method may differ in length, effects and options, in one folder or in several.

    \b
    aw bench --method 3dgs --method refinesplat --scene scene --budget 1m --budget 3m --budget 10m -o runs
    aw cost runs --target 25 -o cost
    """
    if any(not math.isfinite(t) for t in targets):
        raise AwError("--target must be a number of dB, e.g. 25")
    from ambiguous_wild.harness.cost.read import read_cost_runs
    from ambiguous_wild.harness.cost.report import cost_report, plain_data, write_report
    from ambiguous_wild.harness.cost.text import to_text
    from ambiguous_wild.io.atomic import check_output

    found = read_cost_runs(runs, scenes=scenes)
    made_by = command_line(runs, output, targets, scenes, with_setup)
    report = cost_report(found, targets=targets, setup=with_setup, made_by=made_by)
    check_output(output / "cost.json")  # not before: it makes the folder, and there may be nothing to write
    written = write_report(report, output)
    if plots:
        from ambiguous_wild.harness.cost.plots import draw_all

        written += draw_all(report, output)
    click.echo(json.dumps(plain_data(report), indent=2) if as_json else to_text(report), nl=as_json)
    click.echo(f"wrote {', '.join(p.name for p in written)} in {output}", err=True)


def command_line(
    runs: tuple[Path, ...], output: Path, targets: tuple[float, ...], scenes: tuple[str, ...], setup: bool
) -> str:
    """The command that makes this report again."""
    words = ["aw", "cost", *map(str, runs), "-o", str(output)]
    for target in targets:
        words += ["--target", f"{target:g}"]
    for scene in scenes:
        words += ["--scene", scene]
    return shlex.join(words + (["--with-setup"] if setup else []))
