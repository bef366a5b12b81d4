"""`aw bench`: train methods on scenes and measure them."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ambiguous_wild.cli.devices import prepare_cpu
from ambiguous_wild.cli.engines import Engine, Grid, Session, engine_options
from ambiguous_wild.cli.options import training_options
from ambiguous_wild.cli.paths import PathName
from ambiguous_wild.cli.progress import Progress, finish
from ambiguous_wild.core.errors import AwError

if TYPE_CHECKING:
    from ambiguous_wild.harness.cell import Cell

LONGEST_S = 366 * 24 * 3600.0
_UNITS = {"s": 1, "m": 60, "min": 60, "h": 3600}


def parse_budget(text: str) -> float:
    """ "90s", "10m", "1.5h" in seconds.

    Raises:
        AwError: it is none of these.
    """
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(s|m|min|h)\s*", text)
    if not match or float(match[1]) <= 0:
        raise AwError(f"budget {text!r} is no duration above zero: write 90s, 10m or 1.5h")
    seconds = float(match[1]) * _UNITS[match[2]]
    if seconds > LONGEST_S:
        raise AwError(f"budget {text[:40]!r} is above a year: write 90s, 10m or 1.5h")
    return seconds


@click.command(name="bench")
@click.option(
    "--method",
    "methods",
    multiple=True,
    required=True,
    help="A name of 'aw methods', FILE.py:RECIPE, external:FILE.yaml or nerfbaselines:METHOD; repeatable.",
)
@click.option(
    "--scene",
    "scenes",
    multiple=True,
    required=True,
    type=PathName(),
    help="A scene folder; repeatable.",
)
@training_options
@click.option(
    "--budget",
    "budgets",
    multiple=True,
    help="Training time instead: 90s, 10m, 1.5h. Schedules scale with it. Repeatable: every length, for 'aw cost'.",
)
@click.option(
    "--resolution",
    type=click.Choice(["auto", "full", "coarse-to-fine"]),
    default="auto",
    show_default=True,
    help="auto: coarse-to-fine under a budget, else full.",
)
@click.option("--mask", metavar="METHOD", help="Masks of another method, none, or truth (exact ones).")
@click.option("--density", metavar="METHOD", help="Density control of another method.")
@click.option("--regulariser", metavar="METHOD", help="Loss on the render of another method.")
@click.option(
    "--set", "settings", multiple=True, metavar="METHOD.KEY=VALUE", help="An option of a method; repeatable."
)
@click.option(
    "--effects",
    metavar="auto|none|all|LIST",
    multiple=True,
    default=("default",),
    help="Optional effects, see 'aw plan'; LIST: names with commas. Repeatable: every choice, for 'aw cost'.  [default: auto where the method allows it, else none]",
)
@click.option(
    "--plan",
    "plan_file",
    type=PathName(dir_okay=False),
    help="A plan of 'aw plan' instead of a new one.",
)
@click.option(
    "--protocol",
    type=click.Choice(["full", "half"]),
    default="full",
    show_default=True,
    help="half: colour effects see the left half of a test photo, the right one is measured (NeRF-W).",
)
@click.option("-o", "--output", type=PathName(), default=Path("runs"), show_default=True)
@click.option(
    "--probes",
    type=click.IntRange(0, 100),
    default=8,
    show_default=True,
    help="Times the test PSNR is measured on the way, the clock standing still; does not change the result.",
)
@click.option(
    "--checkpoint-every",
    type=click.FloatRange(min=0.0, min_open=True),
    default=60.0,
    show_default=True,
    help="Seconds between checkpoints.",
)
@click.option(
    "--on-nonfinite",
    type=click.Choice(["stop", "rollback"]),
    default="stop",
    show_default=True,
    help="A value that is no finite number: stop and say where, or go back and leave that photo out.",
)
@click.option(
    "--gpus",
    type=click.IntRange(1, 9),
    default=1,
    show_default=True,
    help="GPUs that share one model, for a scene too large for one; iterations count photos.",
)
@click.option(
    "--pictures/--no-pictures",
    default=True,
    show_default=True,
    help="Draw what the method saw into RUN/pictures; changes nothing else.",
)
@engine_options
@click.option("--json", "as_json", is_flag=True, help="Print the outcome of every run as JSON.")
def command(
    engine: Engine,
    methods: tuple[str, ...],
    scenes: tuple[Path, ...],
    seeds: tuple[int, ...],
    iterations: int | None,
    budgets: tuple[str, ...],
    device: str,
    threads: int | None,
    factor: int | None,
    resolution: str,
    max_gaussians: int | None,
    mask: str | None,
    density: str | None,
    regulariser: str | None,
    settings: tuple[str, ...],
    plugins: tuple[Path, ...],
    effects: tuple[str, ...],
    plan_file: Path | None,
    protocol: str,
    output: Path,
    probes: int,
    overwrite: str,
    cache: Path | None,
    checkpoint_every: float,
    on_nonfinite: str,
    gpus: int,
    pictures: bool,
    as_json: bool,
) -> None:
    """Train METHODs on SCENEs and measure them on the test views.

    \b
    aw bench --method 3dgs --method refinesplat --scene scene -o runs
    aw bench --method refinesplat --scene scene --budget 10m --set refinesplat.lambda_cr=0.1
    aw bench --method 3dgs --method refinesplat --scene scene --budget 1m --budget 3m --budget 10m -o runs
    aw bench --method 3dgs --method robustsplat --mask refinesplat --scene scene -o runs

    With --jobs 4 four cells run at a time, with --engine ray as many as a cluster has room for.
    --mask, --density and --regulariser plug parts of one method into every METHOD: the runs are called
    3dgs@mask=refinesplat, which is also a METHOD.

    Several --budget or --effects train every combination, each into a folder of its own:
    runs/budget-60s/effects-exposure/SCENE/METHOD/seed0. 'aw cost runs' compares them all, 'aw table' those of
    one folder.
    """
    if iterations is not None and budgets:
        raise AwError("--iterations and --budget exclude each other: a run is as long as one of them says")
    seconds = [parse_budget(budget) for budget in budgets]
    if math.isnan(checkpoint_every):
        raise AwError("--checkpoint-every nan: give a number of seconds")
    engine.check()

    from ambiguous_wild.methods.graft import graft_name, idle_regulariser
    from ambiguous_wild.methods.registry import get_method, load_plugin

    for plugin in plugins:
        load_plugin(plugin)
    donors = {"mask": mask, "density": density, "regulariser": regulariser}
    methods = tuple(graft_name(name, donors) for name in methods)
    for name in methods:
        get_method(name)  # a misspelt name is answered before torch is imported
    from ambiguous_wild.harness.choosing import check_wanted

    for wanted in effects:
        check_wanted(wanted)
    if plan_file is not None and len(scenes) > 1:
        raise AwError(
            f"--plan {plan_file} is of one scene; bench {len(scenes)} scenes one by one, or without it"
        )

    from ambiguous_wild.harness.grid import plan_cells, run_cells
    from ambiguous_wild.harness.several import grouped
    from ambiguous_wild.io.atomic import check_output
    from ambiguous_wild.splat.pace import TrainConfig

    session = Session(engine, threads)
    chosen = session.device(device)
    train = TrainConfig(
        iterations=iterations or TrainConfig.iterations,
        budget_s=seconds[0] if seconds else None,
        probes=probes,
        resolution=resolution,  # type: ignore[arg-type]
        max_gaussians=max_gaussians,
        checkpoint_every_s=checkpoint_every,
        on_nonfinite=on_nonfinite,  # type: ignore[arg-type]
    )
    from ambiguous_wild.harness.planning.file import read_plan

    plan = None if plan_file is None else read_plan(plan_file)
    planned = {
        wanted: plan_cells(
            methods,
            scenes,
            seeds,
            train,
            settings=settings,
            device=chosen,
            factor=factor,
            effects=wanted,
            plan=plan,
            protocol=protocol,  # type: ignore[arg-type]
        )
        for wanted in dict.fromkeys(effects)
    }
    cells = grouped(planned, seconds)
    if gpus > 1:
        cells = _sharing(cells, gpus, engine)
    told = {(cell.method.name, cell.scene.name, cell.chosen.effects): None for cell in cells}
    for method, name, on in told:
        if on:
            click.echo(f"{method} on {name}: {', '.join(on)}", err=True)
    for scene in {cell.scene.name: cell.scene for cell in cells}.values():
        for warning in scene.info.get("warnings", ()):
            click.echo(f"warning: {scene.name}: {warning}", err=True)
    for cell in {cell.method.name: cell for cell in cells}.values():
        if idle := idle_regulariser(cell.method, cell.options):
            click.echo(
                f"warning: {cell.method.name}: {idle} adds no loss on the render with these options; "
                f"switch it on with --set {idle}.KEY=VALUE, or leave the regulariser out",
                err=True,
            )
    check_output(output / "run")  # before half a minute of compiling
    if chosen == "cpu" and not engine.remote and any(cell.method.program is None for cell in cells):
        prepare_cpu(threads)
    if gpus > 1 or session.in_process(cells):
        progress = Progress(len(cells))
        reports = run_cells(
            cells,
            output,
            overwrite=overwrite,  # type: ignore[arg-type]
            cache_dir=cache,
            tick=progress.tick,
            pictures=pictures,
            on_start=progress.start,
            on_end=progress.end,
        )
    else:
        cache = cache or output / ".cache"
        with session:
            reports = session.run(Grid(cells, output, overwrite, cache, pictures, plugins, methods))  # type: ignore[arg-type]
    finish(reports, output, as_json, [str(output / group) for group in {cell.group: None for cell in cells}])


def _sharing(cells: list[Cell], gpus: int, engine: Engine) -> list[Cell]:
    """The cells with one model on so many GPUs; refused here what cannot be trained so."""
    import dataclasses

    import torch

    from ambiguous_wild.harness.shared_run import check_shared
    from ambiguous_wild.splat.shared.refuse import refuse_more_than

    if engine.remote or (engine.jobs or 1) > 1:
        raise AwError("--gpus gives all GPUs to one run at a time: leave --jobs and --engine out")
    shared = [dataclasses.replace(cell, gpus=gpus) for cell in cells]
    for cell in shared:
        check_shared(cell)
    refuse_more_than(torch.cuda.device_count(), gpus)
    return shared
