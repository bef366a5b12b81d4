"""`aw cost`: accuracy against training time."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.options import (
    FiniteFloat,
    PathName,
    command_line,
    json_option,
    label_option,
    only_option,
)
from ambiguous_wild.io.terminal import line_width, say

if TYPE_CHECKING:
    from ambiguous_wild.report.cost_runs import CostRuns


@click.command(name="cost")
@click.argument("runs", nargs=-1, required=True, type=PathName())
@click.option(
    "-o", "--output", type=PathName(file_okay=False), default=Path("cost"), show_default=True,
    help="Folder for plots, CSV and JSON.",
)  # fmt: skip
@click.option(
    "--target", "targets", multiple=True, type=FiniteFloat(), metavar="DB",
    help="A test PSNR to reach; repeatable.  [default: 3, 1 and 0.5 dB below the best of each scene]",
)  # fmt: skip
@only_option
@label_option
@click.option(
    "--with-setup",
    is_flag=True,
    help="Add the set-up (features and masks made before the first step) to the time; short if cached.",
)
@click.option(
    "--recommend", "recommended", type=(PathName(file_okay=False), str), metavar="SCENE TIME",
    help="Name the best measured setting for this scene within this training time on this machine, e.g. 5m.",
)  # fmt: skip
@json_option
def command(
    runs: tuple[Path, ...],
    output: Path,
    targets: tuple[float, ...],
    scenes: tuple[str, ...],
    labels: tuple[str, ...],
    with_setup: bool,
    recommended: tuple[Path, str] | None,
    as_json: bool,
) -> None:
    """Compare accuracy and cost of the runs below the folders RUNS: time to reach a PSNR, dB per extra
    minute of each effect and refresh interval, and the Pareto front.

    Runs of the same method may differ in length, effects and options, in one folder or in several.

    \b
    aw bench --method 3dgs --method refinesplat --scene scene --budget 1m --budget 3m --budget 10m -o runs
    aw cost runs --target 25 -o cost
    aw cost runs --recommend my-scene 5m
    """
    from ambiguous_wild.io.files import check_output
    from ambiguous_wild.report.cost_report import cost_report, plain_data, to_text, write_report
    from ambiguous_wild.report.cost_runs import read_cost_runs

    cost_runs = read_cost_runs(runs, scenes=scenes, labels=labels)
    if recommended is not None:
        _recommend(cost_runs, *recommended, as_json)
        return
    made_by = command_line(as_json=None)
    report = cost_report(cost_runs, targets=targets, setup=with_setup, made_by=made_by)
    check_output(output / "cost.json")
    written = write_report(report, output)
    from ambiguous_wild.report.cost_plots import draw_all

    written += draw_all(report, output)
    click.echo(
        json.dumps(plain_data(report), indent=2) if as_json else to_text(report, line_width()), nl=as_json
    )
    say(f"wrote {', '.join(p.name for p in written)} in {output}")


def _recommend(cost_runs: CostRuns, scene: Path, budget: str, as_json: bool) -> None:
    from ambiguous_wild.cli.bench import parse_budget
    from ambiguous_wild.harness.cell import scene_identity
    from ambiguous_wild.harness.result_file import encoded
    from ambiguous_wild.io.scene_folder import load_scene
    from ambiguous_wild.report.cost_recommend import in_words, recommend, speed_here

    seconds = parse_budget(budget)
    opened = load_scene(scene)
    speed = speed_here(cost_runs) if cost_runs.reference else 1.0
    advice = recommend(cost_runs.runs, opened.name, seconds, speed=speed, scene_hash=scene_identity(opened))
    if not cost_runs.reference:
        say("the runs have wall times only: this machine is assumed to be as fast as theirs")
    if as_json:
        facts = dataclasses.asdict(advice) | {"command": advice.command(str(scene))}
        click.echo(json.dumps(encoded(facts), indent=2))
    else:
        for line in in_words(advice, str(scene)).splitlines():
            say(line, out=True)
