"""`aw bench`: train methods on scenes and measure them."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.cli.options import (
    FiniteFloat,
    PathName,
    engine_options,
    metric_file_option,
    say,
    training_options,
)
from ambiguous_wild.cli.run_progress import ProgressBar, finish
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.harness.benchmark import Engine, bench

if TYPE_CHECKING:
    from ambiguous_wild.report.suite import PreparedSuite

SUITES = ("ambiguous-wild", "on-the-go", "robustnerf", "photo-tourism", "drone")
LONGEST_S = 366 * 24 * 3600.0
_UNITS = {"s": 1, "m": 60, "min": 60, "h": 3600}


def parse_budget(text: str) -> float:
    """Convert "90s", "10m" or "1.5h" to seconds.

    Raises:
        AwError: it is no duration of this form.
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
    help="A name of 'aw methods', FILE.py:RECIPE, external:FILE.yaml or nerfbaselines:METHOD; several with commas.",
)
@click.option(
    "--scene",
    "scenes",
    multiple=True,
    type=PathName(),
    help="A scene folder; repeatable.",
)
@click.option(
    "--suite",
    "suite_name",
    type=click.Choice(SUITES),
    help="All scenes of a published table instead of --scene; prints the table beside the reported numbers.",
)
@click.option(
    "--root", type=PathName(), help="One folder per scene of the suite, in any layout of 'aw import'."
)
@training_options
@click.option(
    "--budget",
    "budgets",
    multiple=True,
    help="Training time instead of --iterations: 90s, 10m, 1.5h. Repeatable: trains each, for 'aw cost'.",
)
@click.option(
    "--resolution",
    type=click.Choice(["auto", "full", "coarse-to-fine"]),
    default="auto",
    show_default=True,
    help="auto: coarse-to-fine under a budget, else full.",
)
@click.option(
    "--mask",
    metavar="METHOD",
    help="Masks of another method; none; motion: of moving features; or truth: exact masks.",
)
@click.option("--density", metavar="METHOD", help="Density control of another method.")
@click.option("--regulariser", metavar="METHOD", help="Losses of another method on the render.")
@click.option("--passes", type=click.IntRange(1, 2), default=1, show_default=True,
              help="2: train again with the final masks; the cost counts both trainings.")  # fmt: skip
@click.option(
    "--set", "settings", multiple=True, metavar="METHOD.KEY=VALUE", help="Option of a method; repeatable."
)
@click.option(
    "--effects",
    metavar="auto|none|all|LIST",
    multiple=True,
    default=("auto",),
    show_default=True,
    help="Optional effects (docs/effects.md), the same for all methods; auto: the plan of the scene; LIST: "
    "names with commas. Repeatable: trains each.",
)
@click.option(
    "--plan",
    "plan",
    type=PathName(dir_okay=False),
    help="Use this plan of 'aw plan' instead of making a new one.",
)
@click.option(
    "--protocol",
    type=click.Choice(["full", "half"]),
    help="full: measure whole test photos; half: fit colours on the left half, measure the right (NeRF-W).  "
    "[default: as scene.json says, else full]",
)
@click.option(
    "--start",
    type=PathName(dir_okay=False),
    help="Start from this splat file (PLY, compressed PLY, SPZ, SOG) or point cloud (PLY) in the scene's "
    "coordinates.  [default: the scene's points]",
)
@metric_file_option
@click.option("-o", "--output", type=PathName(), default=Path("runs"), show_default=True)
@click.option(
    "--probes",
    type=click.IntRange(0, 100),
    default=8,
    show_default=True,
    help="Measurements of the test PSNR during training; they change neither result nor training time.",
)
@click.option(
    "--checkpoint-every",
    type=FiniteFloat(min=0.0, min_open=True),
    default=60.0,
    show_default=True,
    help="Seconds between checkpoints.",
)
@click.option(
    "--on-nonfinite",
    type=click.Choice(["stop", "rollback"]),
    default="stop",
    show_default=True,
    help="On a NaN or infinite value: stop and say where, or go back and skip that photo.",
)
@click.option(
    "--pictures/--no-pictures",
    default=True,
    show_default=True,
    help="Save pictures of masks and training in RUN/pictures.",
)
@engine_options
@click.option("--json", "as_json", is_flag=True, help="Print the outcome of every run as JSON.")
def command(
    methods: tuple[str, ...],
    scenes: tuple[Path, ...],
    suite_name: str | None,
    root: Path | None,
    iterations: int | None,
    budgets: tuple[str, ...],
    resolution: str,
    max_gaussians: int | None,
    mask: str | None,
    density: str | None,
    regulariser: str | None,
    protocol: str | None,
    output: Path,
    probes: int,
    checkpoint_every: float,
    on_nonfinite: str,
    as_json: bool,
    **given: Any,  # the other arguments of `bench`, and the fields of `Engine`, by their names
) -> None:
    """Train METHODs on SCENEs and measure them on the test views.

    \b
    aw bench --method 3dgs,refinesplat --scene scene -o runs
    aw bench --method refinesplat --scene scene --budget 10m --set refinesplat.mask_every=8
    aw bench --method 3dgs,refinesplat --scene scene --budget 1m --budget 3m --budget 10m -o runs
    aw bench --method 3dgs,robustsplat --mask refinesplat --scene scene -o runs
    aw bench --suite on-the-go --root datasets/on-the-go -o runs

    A run is one method on one scene with one seed. --jobs 4 trains four runs at a time, --engine ray as many
    as a cluster has room for.

    --mask, --density and --regulariser replace a part of every METHOD by that of another method. The runs are
    called 3dgs@mask=refinesplat, which is also a METHOD.

    Several --budget or --effects train every combination, each into its own folder:
    runs/budget-60s/effects-exposure/SCENE/METHOD/seed0. 'aw cost runs' compares all of them, 'aw table' the
    runs of one folder.
    """
    if iterations is not None and budgets:
        raise AwError("--iterations and --budget exclude each other: a run is as long as one of them says")
    seconds = [parse_budget(budget) for budget in budgets]
    prepared = None
    if suite_name is not None:
        from ambiguous_wild.datasets.suites import get_suite
        from ambiguous_wild.report.suite import prepare_suite, suite_methods

        if root is None or scenes:
            raise AwError(f"--suite {suite_name} takes its scenes from --root DIR; leave --scene out")
        suite = get_suite(suite_name)
        prepared = prepare_suite(suite, root, output, say=say)
        scenes, protocol = tuple(prepared.scenes.values()), protocol or suite.protocol
        methods = methods or tuple(suite_methods(suite))
        iterations = iterations if iterations is not None or seconds else suite.iterations
    elif root is not None:
        raise AwError("--root goes with --suite: name the suite whose scenes it holds")
    for flag, names in (("--method", methods), ("--scene", scenes)):
        if not names:
            raise AwError(f"{flag} is missing: 'aw bench --help' shows examples")
    if math.isnan(checkpoint_every):
        raise AwError("--checkpoint-every nan: give a number of seconds")
    parts = {"mask": mask, "density": density, "regulariser": regulariser}
    train: dict[str, Any] = {
        "resolution": resolution,
        "max_gaussians": max_gaussians,
        "probes": probes,
        "checkpoint_every_s": checkpoint_every,
        "on_nonfinite": on_nonfinite,
    }
    report = bench(
        methods,
        scenes,
        output=output,
        iterations=iterations,
        budgets_s=seconds,
        parts={place: donor for place, donor in parts.items() if donor},  # type: ignore[misc]
        train=train,  # type: ignore[arg-type]
        protocol=protocol,  # type: ignore[arg-type]
        engine=Engine(**{name: given.pop(name) for name in Engine.__dataclass_fields__}),
        callbacks=ProgressBar(),
        **given,
    )
    if prepared is not None and not as_json:
        for folder in report.folders:
            _print_tables(prepared, folder)
    finish(report, as_json)


def _print_tables(prepared: PreparedSuite, folder: Path) -> None:
    from ambiguous_wild.report.plain_formats import to_text
    from ambiguous_wild.report.suite import suite_tables

    try:
        click.echo(to_text(suite_tables(prepared, folder), color=sys.stdout.isatty()), nl=False)
    except AwError as error:  # every run failed, which `finish` reports
        say(str(error))
