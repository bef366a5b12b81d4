"""`aw ablate`: gain and cost of each part of a method."""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import sys
from pathlib import Path

import click
from click.core import ParameterSource

from ambiguous_wild.cli.options import (
    PathName,
    SectionedCommand,
    choose_device,
    json_option,
    prepare_cpu,
    training_options,
)
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.terminal import say
from ambiguous_wild.methods.ablation_groups import Group


@click.command(name="ablate", cls=SectionedCommand)
@click.option("--method", default="refinesplat", show_default=True, help="Method whose parts are varied.")
@click.option("--scene", "scenes", multiple=True, type=PathName(), help="A scene folder; repeatable.")
@click.option("--group", "groups", multiple=True, help="Only this group; repeatable.  [default: all]")
@click.option(
    "--sweep", "sweeps", multiple=True, metavar="KEY=V1,V2", help="Vary an option, not groups; repeatable."
)
@training_options
@click.option("--budget", help="Training time instead of --iterations: 90s, 10m, 1.5h.")
@click.option(
    "--set", "settings", multiple=True, metavar="KEY=VALUE", help="Option for every variant; repeatable."
)
@click.option("-o", "--output", type=PathName(), default=Path("ablation"), show_default=True)
@click.option("--pictures/--no-pictures", default=False, show_default=True, help="Save every run's pictures.")
@json_option
def command(
    method: str,
    scenes: tuple[Path, ...],
    groups: tuple[str, ...],
    sweeps: tuple[str, ...],
    seeds: tuple[int, ...],
    iterations: int | None,
    budget: str | None,
    device: str,
    threads: int | None,
    factor: int | None,
    max_gaussians: int | None,
    settings: tuple[str, ...],
    plugins: tuple[Path, ...],
    output: Path,
    overwrite: str,
    cache: Path | None,
    pictures: bool,
    as_json: bool,
) -> None:
    """Train the variants of METHOD on SCENEs. Write ablation.csv, .json, .md and .png to OUTPUT.

    Without --scene, the groups and variants of METHOD are listed. Finished runs are kept: after an
    interruption the same command continues. Another --group of the same scenes, seeds and length is added to
    the results in OUTPUT.

    \b
    aw ablate --method refinesplat
    aw ablate --method refinesplat --scene scene --group masks --iterations 3000 -o ablation
    aw ablate --method my.py:trimmed --scene scene --sweep share=0.7,0.9 -o ablation
    """
    from ambiguous_wild.methods.ablation_groups import choose_groups, sweep_groups
    from ambiguous_wild.methods.registry import get_method, load_plugin, registered

    for plugin in plugins:
        load_plugin(plugin)
    entry = get_method(method)
    method = entry.name  # FILE.py:RECIPE would read the file again
    if sweeps:
        swept = sweep_groups(entry.options(), sweeps)
        entry = dataclasses.replace(entry, ablations=(*entry.ablation_groups(), *swept))
        registered[method] = entry  # `register` refuses the names of built-in methods
        groups = (*groups, *(group.name for group in swept))
    chosen = choose_groups(method, entry.ablation_groups(), groups)
    if not scenes:
        if click.get_current_context().get_parameter_source("output") is not ParameterSource.DEFAULT:
            raise AwError("no scene to train on: give one with --scene, or leave -o out to list the groups")
        click.echo(json.dumps(_listed(chosen), indent=2) if as_json else _list_text(chosen))
        return
    if iterations is not None and budget is not None:
        raise AwError("--iterations and --budget exclude each other: a run is as long as one of them says")

    from ambiguous_wild.cli.bench import parse_budget
    from ambiguous_wild.cli.run_progress import ProgressBar
    from ambiguous_wild.harness.ablation_study import as_continued_study, earlier_groups, plan_study, report
    from ambiguous_wild.harness.cell import RunOptions
    from ambiguous_wild.harness.grid import run_cells
    from ambiguous_wild.io.files import check_output
    from ambiguous_wild.report.ablation_report import markdown_of, write_report
    from ambiguous_wild.splat.train_config import TrainConfig

    on = choose_device(device)
    train = TrainConfig(
        iterations=TrainConfig.iterations if iterations is None else iterations,
        budget_s=None if budget is None else parse_budget(budget),
        max_gaussians=max_gaussians,
    )
    settings = tuple(text.removeprefix(f"{method}.") for text in settings)  # as `aw bench` wants them
    plan = functools.partial(
        plan_study,
        method,
        scenes,
        seeds,
        train,
        settings=settings,
        device=on,
        factor=factor,
        default_length=iterations is None and budget is None,
    )
    study = plan(groups=groups)
    before = earlier_groups(study, output)
    if before:
        study = plan(groups=[*groups, *before])
        say(f"with what {output} holds already: {', '.join(before)}")
    check_output(output / "run")
    if on == "cpu":
        prepare_cpu(threads)
    if overwrite == "longer":
        study = as_continued_study(study, output)
    cells = study.cells
    absent = sum(1 for row in study.rows if row.missing)
    more = f", {absent} variants cannot run here" if absent else ""
    say(f"{len(study.rows)} rows: {len(cells)} runs{more}")
    progress = ProgressBar()
    progress.planned(cells, one_by_one=True)
    options = RunOptions(cache or output / ".cache", overwrite, pictures)  # type: ignore[arg-type]
    reports = run_cells(cells, output, options, progress)
    words = ["aw", *sys.argv[1:], *(word for name in before for word in ("--group", name))]
    data = report(study, output, made_by=shlex.join(words))
    written = write_report(data, output)
    click.echo(json.dumps(data, indent=2) if as_json else markdown_of(data))
    say("wrote " + ", ".join(str(path) for path in written))
    failed = [r for r in reports if r.outcome == "failed"]
    if failed:
        raise AwError(f"{len(failed)} of {len(reports)} runs failed: {failed[0].error}")


def _listed(groups: tuple[Group, ...]) -> list[dict[str, object]]:
    return [
        {
            "group": group.name,
            "title": group.title,
            "paper": group.source or None,
            "variants": [
                {"name": v.name, "settings": list(v.settings), "method": v.method or None, "text": v.text}
                for v in group.variants
            ],
        }
        for group in groups
    ]


def _list_text(groups: tuple[Group, ...]) -> str:
    lines = []
    for group in groups:
        lines.append(f"{group.name}: {group.title}" + (f" ({group.source})" if group.source else ""))
        for v in group.variants:
            what = f"method {v.method}" if v.method else " ".join(v.settings)
            lines.append(f"    {v.name:18} {what}" + (f"   {v.text}" if v.text else ""))
    return "\n".join(lines)
