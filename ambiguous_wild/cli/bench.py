"""`aw bench`: train methods on scenes and measure them."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ambiguous_wild.cli.options import (
    PathName,
    SectionedCommand,
    engine_options,
    json_option,
    metric_file_option,
    training_options,
)
from ambiguous_wild.cli.run_progress import finish
from ambiguous_wild.cli.study_file import Recorded, StudyFile, is_plan, read_study, typed_in
from ambiguous_wild.core.config import check_limits, with_options
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.harness.benchmark import Engine, bench, check_request
from ambiguous_wild.io.terminal import line_width, say

if TYPE_CHECKING:
    from ambiguous_wild.datasets.suites import Suite
    from ambiguous_wild.report.suite import PreparedSuite

SUITES = (
    "aw-sim", "aw-sim-mini", "aw-sim-large", "ambiguous-wild", "on-the-go", "robustnerf", "photo-tourism", "drone",
)  # fmt: skip
DATASETS = Path("datasets")  # where 'aw fetch' puts them
# Settings that are given by --set, and the range of each; None: its type says all.
RARE: dict[str, dict[str, Any]] = {
    "train": {"probes": (0, 100), "checkpoint_every_s": (0.01, math.inf), "on_nonfinite": None},
    "engine": {"retries": (0, 1000), "cpus_per_cell": (1e-4, math.inf), "gpus_per_cell": (0, math.inf),
               "memory_per_cell": (0, math.inf), "transfer": None, "transfer_limit": (0.001, math.inf)},
}  # fmt: skip
_NO_TRUTH = "exact poses are known of simulated suites alone: --suite aw-sim"
LONGEST_S = 366 * 24 * 3600.0
_UNITS = {"s": 1, "sec": 1, "second": 1, "m": 60, "min": 60, "minute": 60, "h": 3600, "hour": 3600}


def parse_budget(text: str) -> float:
    """Convert "90s", "10m" or "1.5h" to seconds.

    Raises:
        AwError: it is no duration of this form.
    """
    units = "|".join(unit if len(unit) == 1 else f"{unit}s?" for unit in _UNITS)
    match = re.fullmatch(rf"\s*(\d+(?:\.\d+)?)\s*({units})\s*", text)
    if not match or float(match[1]) <= 0:
        raise AwError(f"budget {text!r} is no duration above zero: write 90s, 10m or 1.5h")
    seconds = float(match[1]) * _UNITS[match[2] if len(match[2]) == 1 else match[2].removesuffix("s")]
    if seconds > LONGEST_S:
        raise AwError(f"budget {text[:40]!r} is above a year: write 90s, 10m or 1.5h")
    return seconds


@click.command(name="bench", cls=SectionedCommand)
@click.argument("study", required=False, is_eager=True, callback=read_study)
@click.option(
    "--method",
    "methods",
    multiple=True,
    help="A name of 'aw methods', also 3dgs@mask=A,density=B,regulariser=C with parts of other methods, or "
    "3dgs+2passes, trained again with the final masks; FILE.py:RECIPE, external:FILE.yaml or "
    "nerfbaselines:METHOD. Several with commas.",
)
@click.option(
    "--scene",
    "scenes",
    multiple=True,
    type=PathName(),
    help="A scene folder; repeatable. With --suite: a folder with one folder per scene, in any layout of "
    "'aw import'; of a simulated suite where it lies or is made.  [default for these: datasets/SUITE]",
)
@click.option(
    "--suite",
    "suite_name",
    type=click.Choice(SUITES),
    metavar="NAME",
    help="All scenes of a suite that is simulated here, printed beside the leaderboard: aw-sim, aw-sim-mini, "
    "aw-sim-large; or of a published table, beside its numbers: ambiguous-wild, on-the-go, robustnerf, "
    "photo-tourism, drone.",
)
@click.option(
    "--poses",
    type=click.Choice(["estimated", "truth"]),
    default="estimated",
    show_default=True,
    help="Of a simulated suite; truth: exact poses, so that masks are judged without structure from motion.",
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
    metavar="METHOD|FOLDER",
    help="Masks of another method, for all; FOLDER: of files, white = static (docs/training.md); none; motion: of "
    "moving features; or truth: exact masks.",
)
@click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="NAME.KEY=VALUE",
    help="Option of a method ('aw methods METHOD'), or one of the settings above; repeatable.",
)
@click.option(
    "--effects",
    metavar="auto|none|all|LIST|PLAN.json",
    multiple=True,
    default=("auto",),
    show_default=True,
    help="Optional effects (docs/effects.md), the same for all methods; auto: a plan of the scene is made; "
    "LIST: names with commas; PLAN.json: as 'aw plan' wrote it. Repeatable: trains each.",
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
    help="Start from this splat file (PLY, compressed PLY, SPZ, SOG, glTF) or point cloud (PLY) in the scene's "
    "coordinates.  [default: the scene's points]",
)
@click.option(
    "--corrections",
    type=PathName(dir_okay=False),
    help="Masks corrected by hand, as the page of 'aw view' saves them; --overwrite longer continues a run with "
    "them.",
)
@metric_file_option
@click.option("-o", "--output", type=PathName(), default=Path("runs"), show_default=True)
@click.option(
    "--pictures/--no-pictures",
    default=True,
    show_default=True,
    help="Save pictures of masks and training in RUN/pictures.",
)
@engine_options
@json_option
@click.pass_context
def command(
    ctx: click.Context,
    study: StudyFile | None,
    methods: tuple[str, ...],
    scenes: tuple[Path, ...],
    suite_name: str | None,
    poses: str,
    iterations: int | None,
    budgets: tuple[str, ...],
    resolution: str,
    max_gaussians: int | None,
    mask: str | None,
    settings: tuple[str, ...],
    effects: tuple[str, ...],
    protocol: str | None,
    output: Path,
    as_json: bool,
    **given: Any,  # the other arguments of `bench`, and the fields of `Engine`, by their names
) -> None:
    """Train METHODs on SCENEs and measure them on the test views.

    \b
    aw bench --method 3dgs,refinesplat --scene scene -o runs
    aw bench runs/study.yaml --seed 0 --seed 1
    aw bench --method refinesplat --scene scene --budget 10m --set refinesplat.mask_every=8
    aw bench --method 3dgs,refinesplat --scene scene --budget 1m --budget 3m --budget 10m -o runs
    aw bench --method 3dgs,robustsplat --mask refinesplat --scene scene -o runs
    aw bench --suite aw-sim --method mine.py:mine -o runs
    aw bench --suite on-the-go --scene datasets/on-the-go -o runs

    STUDY is a file with options by their names, as every command writes it into the folder of its runs
    (study.yaml), or the config.yaml of a run, to make that run again. An option that is given replaces the
    file's, --set adds to its settings.

    A run is one method on one scene with one seed. --jobs 4 trains four runs at a time, --engine ray as many
    as a cluster has room for.

    Several --budget or --effects train every combination, each into its own folder:
    runs/budget-60s/effects-exposure/SCENE/METHOD/seed0. 'aw cost runs' compares all of them, 'aw table' the
    runs of one folder.

    \b
    Settings that few need, as --set NAME.KEY=VALUE:
      train.probes=8               measurements of the test PSNR while training
      train.checkpoint_every_s=60  seconds between checkpoints
      train.on_nonfinite=stop      at a NaN; rollback: leave that photo out
      engine.retries=3             of a run whose process or node was lost
      engine.cpus_per_cell=1       with Ray: CPUs per run, also its threads
      engine.gpus_per_cell=1       with Ray: GPUs per run; 0.5: two share one
      engine.memory_per_cell=GB    with Ray: memory per run
      engine.transfer=store        with Ray: send scenes; shared: shared storage
      engine.transfer_limit=4000   with Ray: MB of the largest scene or run
    """
    if iterations is not None and budgets:
        typed = {name for name in ("iterations", "budgets") if typed_in(ctx, name)}
        if study is None or len(typed) != 1:
            raise AwError(
                "--iterations and --budget exclude each other: a run is as long as one of them says"
            )
        iterations, budgets = (iterations, ()) if "iterations" in typed else (None, budgets)
    if study is not None:
        study.check_method(any(typed_in(ctx, name) for name in ("plugins", "methods", "mask")))
        settings = (*study.settings, *settings) if typed_in(ctx, "settings") else settings
    recorded = {**ctx.params, "iterations": iterations, "budgets": budgets, "settings": settings}
    seconds = [parse_budget(budget) for budget in budgets]
    rare, own = _rare_settings(settings)
    wanted_effects, plan = plan_among(effects)
    prepared = None
    if suite_name is not None:
        from ambiguous_wild.datasets.suites import get_suite
        from ambiguous_wild.report.suite import suite_methods

        suite = get_suite(suite_name)
        methods = methods or tuple(suite_methods(suite))
        root = _suite_folder(suite, scenes)
        recorded["scenes"] = (root,)
        if suite.simulated is None:
            prepared = _imported(suite, root, poses, output)
        else:
            # Before minutes of simulation.
            parts: dict[Any, str] = {"mask": mask} if mask else {}
            check_request(methods, given["plugins"], parts, own, wanted_effects)
            prepared = _made(suite, root, poses, output)
        scenes = tuple(prepared.scenes.values())
        protocol = protocol or (suite.protocol if suite.simulated is None else None)
        iterations = iterations if iterations is not None or seconds else suite.iterations
    elif poses != "estimated":
        raise AwError(f"--poses {poses}: {_NO_TRUTH}")
    for flag, names in (("--method", methods), ("--scene", scenes)):
        if not names:
            raise AwError(f"{flag} is missing: 'aw bench --help' shows examples")
    train = {"resolution": resolution, "max_gaussians": max_gaussians, **rare["train"]}
    engine = {name: given.pop(name) for name in Engine.__dataclass_fields__ if name in given}
    report = bench(
        methods,
        scenes,
        output=output,
        iterations=iterations,
        budgets_s=seconds,
        effects=wanted_effects,
        plan=plan,
        settings=own,
        parts={"mask": mask} if mask else {},
        train=train,  # type: ignore[arg-type]
        protocol=protocol,  # type: ignore[arg-type]
        engine=Engine(**engine, **rare["engine"]),
        callbacks=Recorded(ctx, recorded, study, output),
        **given,
    )
    printed = False
    if prepared is not None and not as_json:
        for folder in report.folders:
            printed |= _print_tables(prepared, folder, given["factor"])
    finish(report, as_json, tabulated=printed and given["overwrite"] in ("never", "missing"))


def _rare_settings(settings: Sequence[str]) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """Split `train.KEY=VALUE` and `engine.KEY=VALUE` from the options of methods.

    Returns:
        the values by key, for "train" and "engine"; the options of methods.

    Raises:
        AwError: unknown key, or a value that is none of its.
    """
    texts: dict[str, dict[str, str]] = {owner: {} for owner in RARE}
    own = []
    for setting in settings:
        name, equals, text = setting.partition("=")
        owner, _, key = name.partition(".")
        if owner not in RARE or not equals:
            own.append(setting)
            continue
        if key not in RARE[owner]:
            raise unknown("name in --set", name, [f"{owner}.{key}" for key in RARE[owner]])
        texts[owner][key] = text
    values: dict[str, dict[str, Any]] = {owner: {} for owner in RARE}
    if texts["train"]:
        from ambiguous_wild.splat.train_config import TrainConfig

        values["train"] = _typed(TrainConfig(), "train", texts["train"])
    if texts["engine"]:
        values["engine"] = _typed(Engine(), "engine", texts["engine"])
    return values, own


def _typed(config: Any, owner: str, texts: Mapping[str, str]) -> dict[str, Any]:
    changed = with_options(config, texts, "setting")
    check_limits(changed, f"--set {owner}", **{key: RARE[owner][key] for key in texts if RARE[owner][key]})
    return {key: getattr(changed, key) for key in texts}


def plan_among(effects: Sequence[str]) -> tuple[list[str], Path | None]:
    """Replace the file of a plan among the values of --effects by "auto", and return the file.

    Raises:
        AwError: two plans, or a plan and "auto".
    """
    plans = [text for text in effects if is_plan(text)]
    if plans and (len(plans) > 1 or "auto" in effects):
        raise AwError(f"--effects {plans[0]} is a plan, and auto or another plan stands beside it: give one")
    wanted = ["auto" if text in plans else text for text in effects]
    return wanted, Path(plans[0]) if plans else None


def _suite_folder(suite: Suite, scenes: Sequence[Path]) -> Path:
    """Return the folder of the suite's scenes: of a simulated one there is a default."""
    if len(scenes) == 1:
        return scenes[0]
    if suite.simulated is None:
        raise AwError(f"--suite {suite.name} takes its scenes from one folder: give --scene DIR once")
    if scenes:
        raise AwError(f"--suite {suite.name} lies in one folder: give --scene DIR once, or not at all")
    return DATASETS / suite.dataset


def _imported(suite: Suite, root: Path, poses: str, output: Path) -> PreparedSuite:
    from ambiguous_wild.report.suite import prepare_suite

    if poses != "estimated":
        raise AwError(f"--poses {poses} with --suite {suite.name}: {_NO_TRUTH}")
    return prepare_suite(suite, root, output, say=say)


def _made(suite: Suite, root: Path, poses: str, output: Path) -> PreparedSuite:
    from ambiguous_wild.cli.build_scene import kernels_meanwhile
    from ambiguous_wild.io.files import check_output
    from ambiguous_wild.report.simulated_suite import prepare_simulated

    check_output(output / "run", outside={f"the suite {suite.name}": root})
    with kernels_meanwhile():
        return prepare_simulated(suite, root, exact_poses=poses == "truth", progress=True, say=say)


def _print_tables(prepared: PreparedSuite, folder: Path, factor: int | None) -> bool:
    """Print the suite's tables; tell whether there are any."""
    from ambiguous_wild.report.plain_formats import to_text

    try:
        if prepared.suite.simulated is not None:
            from ambiguous_wild.report.suite_board import find_board, suite_board

            tables = suite_board(prepared, folder, factor=factor, board=find_board())
        else:
            from ambiguous_wild.report.suite import suite_tables

            tables = suite_tables(prepared, folder)
        click.echo(to_text(tables, color=sys.stdout.isatty(), width=line_width()), nl=False)
    except AwError as error:  # every run failed, which `finish` reports; or the board is damaged
        say(str(error))
        return False
    return True
