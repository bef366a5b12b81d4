"""Plan a grid of cells, check it before anything is trained, and run it; a failure stops no other cell."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import with_options
from ambiguous_wild.core.errors import AwError, counted, unknown
from ambiguous_wild.harness.callbacks import Callbacks
from ambiguous_wild.harness.cell import (
    Cell,
    CellReport,
    Overwrite,
    Protocol,
    RunOptions,
    scene_identity,
)
from ambiguous_wild.harness.cell_run import (
    check_folder,
    existing_outcome,
    refuse_other_code,
    run_cell,
)
from ambiguous_wild.harness.chosen_effects import (
    ChosenEffects,
    parse_effects,
    published_effects,
    scene_protocol,
    takes_effects,
)
from ambiguous_wild.harness.effects_plan import EffectsPlan, plan_effects
from ambiguous_wild.harness.start import start_file, start_line, with_start
from ambiguous_wild.harness.timing import MAX_RATIO, MIN_RATIO, expected_s, seconds_range, slowness
from ambiguous_wild.io.files import check_output
from ambiguous_wild.io.scene_folder import ALL_TRAINED, load_scene
from ambiguous_wild.methods.registry import MethodEntry, get_method
from ambiguous_wild.splat.effects import check_effects
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig, default_iterations


def try_recipes(cells: Sequence[Cell]) -> list[str]:
    """Build the hooks of every method once, so that a faulty last method is found before the first trains.

    Returns:
        A line for each method and scene on the file that they start from (`--start`).

    Raises:
        AwError: a recipe refuses an option, or its weights are missing. Other errors are left to the runs.
    """
    from ambiguous_wild.splat.effects import with_effects

    different = {
        (cell.method.name, repr(cell.options), cell.chosen.effects, cell.scene_id): cell for cell in cells
    }
    lines = []
    for cell in different.values():
        try:
            hooks = with_effects(cell.method.build(cell.options), cell.chosen.effects)
            if cell.start is not None:
                lines.append(start_line(cell.start, cell.method.name, hooks, cell.train, cell.scene))
        except AwError as error:
            raise AwError(f"{cell.method.name}: {error}") from error
        except (Exception, SystemExit):
            continue  # a plug-in's bug: its runs fail with their traceback, the others are trained
    return list(dict.fromkeys(lines))


def check_grafts(cells: Sequence[Cell]) -> list[str]:
    """Return the warnings about grafted methods, each once.

    Raises:
        AwError: a graft could not train, or would change nothing.
    """
    from ambiguous_wild.methods.graft import check_graft

    lines = []
    for name, cell in {cell.method.name: cell for cell in cells}.items():
        try:
            lines += [f"warning: {name}: {line}" for line in check_graft(cell.method, cell.options)]
        except AwError as error:
            raise AwError(f"{name}: {error}") from error
    return lines


def plan_cells(
    methods: Sequence[str | MethodEntry],
    scenes: Sequence[Path],
    seeds: Sequence[int],
    train: TrainConfig,
    *,
    settings: Iterable[str] = (),
    device: str = "cpu",
    factor: int | None = None,
    effects: str = "none",
    plan: EffectsPlan | None = None,
    protocol: Protocol | None = None,
    start: Path | None = None,
    default_length: bool = False,
) -> list[Cell]:
    """Plan every method on every scene with every seed, after a check of all names and options.

    Args:
        methods: names of `aw methods`, or their entries.
        scenes: scene folders.
        seeds: seeds of training.
        train: length and bookkeeping; its seed is replaced.
        settings: "method.key=value" strings.
        device: "cpu" or "cuda".
        factor: N of the folder images_N; None = the one that the scene was built for.
        effects: "none", "all", "auto" or names of effects; the same for all methods that can take them.
        plan: plan of the only scene, if it was made before; None = made where one is needed.
        protocol: "full" measures whole test photos, "half" the right half; None = what scene.json says.
        start: a splat file or point cloud to start from; None = the scene's points.
        default_length: replace `train.iterations` by each scene's default.

    Raises:
        AwError: unknown method, option or scene; a start that no camera sees; two scenes of the same name.
    """
    named = _by_name(methods)
    resolved = resolved_options(methods, settings)  # before a plan is made: making one trains
    distinct = list({path.resolve(): path for path in scenes}.values())
    loaded = [load_scene(path, factor=factor) for path in distinct]
    for scene in loaded:
        if not scene.test and dict(scene.info).get("split") != ALL_TRAINED:
            raise AwError(
                f"{scene.root} tests nothing: no name in its test_list.txt is a photo of the model; correct "
                "the list (one name a line, UTF-8), or remove both lists, then every 8th photo tests; 'aw "
                "build-scene --no-test' trains on all"
            )
    names = [scene.name for scene in loaded]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise AwError(
            f"two scenes are called {', '.join(sorted(twice))}: their runs would share a folder; "
            "rename one in its scene.json or bench them into different -o"
        )
    file = None if start is None else start_file(start)
    if file and (programs := [name for name, entry in named.items() if not takes_effects(entry)]):
        raise AwError(
            f"--start {start}: the external program {', '.join(programs)} cannot start from a file; bench it "
            "without --start"
        )
    for scene in loaded:
        with_start(MethodHooks(), file, scene)
    cells = []
    for scene in loaded:
        identity = scene_identity(scene)
        chosen = choose_effects(effects, scene, list(named.values()), plan)
        measured = protocol or scene_protocol(scene)
        iterations = default_iterations(len(scene.train)) if default_length else train.iterations
        for entry, options in resolved:
            for seed in dict.fromkeys(seeds):
                config = dataclasses.replace(train, seed=seed, iterations=iterations)
                cells.append(
                    Cell(entry, options, scene, identity, config, device, chosen[entry.name], measured, file)
                )
    return cells


def _by_name(methods: Sequence[str | MethodEntry]) -> dict[str, MethodEntry]:
    """Return the methods by name, each once: a graft, or a path, may be written in two ways."""
    named: dict[str, MethodEntry] = {}
    for method in methods:
        entry = get_method(method) if isinstance(method, str) else method
        other = named.setdefault(entry.name, entry)
        if other.source_hash != entry.source_hash:
            raise AwError(f"two methods are called {entry.name}: their runs would share a folder; rename one")
    return named


def _listed(entry: MethodEntry) -> str:
    """Return where the keys of --set are listed."""
    command = shlex.join(["aw", "methods", entry.given_as or entry.name])
    own = f"'{command}' lists them; " if dataclasses.fields(entry.options()) else ""
    return f"{own}for every method: train.KEY and engine.KEY of 'aw bench --help'"


def resolved_options(
    methods: Sequence[str | MethodEntry], settings: Iterable[str]
) -> list[tuple[MethodEntry, Any]]:
    """Return each method with its options.

    Args:
        methods: each once.
        settings: "method.key=value" strings.

    Raises:
        AwError: unknown method or option, or a value that is none of its.
    """
    named = _by_name(methods)
    by_method = _settings_by_method(settings, list(named.values()))
    return [
        (entry, with_options(entry.options(), by_method[name], f"option of {entry.name}", _listed(entry)))
        for name, entry in named.items()
    ]


def _settings_by_method(settings: Iterable[str], entries: Sequence[MethodEntry]) -> dict[str, dict[str, str]]:
    grouped: dict[str, dict[str, str]] = {entry.name: {} for entry in entries}
    for setting in settings:
        key, equals, value = setting.partition("=")
        method, dot, option = key.partition(".")
        if not equals or not dot:
            example = f"{entries[0].name}.{setting}" if equals else "refinesplat.lambda_cr=0.1"
            raise AwError(f"--set {setting!r}: write METHOD.KEY=VALUE, e.g. --set {example}")
        applied = False
        for entry in entries:
            keys = entry.option_keys(method, option)
            grouped[entry.name] |= dict.fromkeys(keys, value)
            applied = applied or bool(keys)
        if not applied:
            names = {entry.name for entry in entries} | {name for e in entries for _, name in e.slots}
            raise unknown("method in --set", method, names)
    return grouped


def cell_folder(output: Path, cell: Cell) -> Path:
    """Return the run folder OUTPUT/[<group>/]<scene>/<method>/seed<k>."""
    return output / cell.group / cell.scene.name / cell.method.name / f"seed{cell.train.seed}"


def run_cells(
    cells: Sequence[Cell],
    output: Path,
    options: RunOptions | None = None,
    callbacks: Callbacks | None = None,
) -> list[CellReport]:
    """Run the unfinished cells one after another; an error of one is its outcome and does not stop others.

    Args:
        cells: what to run.
        output: folder of the runs.
        options: how they are made and kept; None = the defaults, with the cache in OUTPUT/.cache.
        callbacks: told when a run starts, ticks and ends.

    Raises:
        AwError: a run folder holds another configuration; checked before anything is trained.
    """
    options, callbacks = options or RunOptions(output / ".cache"), callbacks or Callbacks()
    reports = []
    for cell, folder in zip(cells, check_run_folders(cells, output, options)):
        callbacks.started(cell, folder)
        reports.append(run_cell(cell, folder, options, callbacks.tick))
        callbacks.ended(cell, reports[-1])
    return reports


def check_run_folders(cells: Sequence[Cell], output: Path, options: RunOptions) -> list[Path]:
    """Return the run folder of every cell, after a check of all of them.

    Raises:
        AwError: a folder holds another configuration or foreign files, or cannot be written; or another seed
            was trained with another version of the method's file.
    """
    folders = [cell_folder(output, cell) for cell in cells]
    for cell, folder in zip(cells, folders):
        if folder.exists() and options.overwrite != "never":
            check_folder(cell, folder, options.overwrite)
    kept = {folder for folder in folders if options.overwrite == "never" and folder.exists()}
    trained = {folder: cell for folder, cell in zip(folders, cells) if folder not in kept}
    methods = {folder.parent: cell for folder, cell in trained.items()}  # seeds share the method's file
    for parent, cell in methods.items():
        for other in sorted({*parent.glob("seed*/")} - trained.keys()):
            refuse_other_code(other, cell)
    for needed in (output, options.cache_dir):
        check_output(needed / "run")  # a folder that cannot be written is found before the training
    return folders


def expand_budgets(planned: Mapping[str, Sequence[Cell]], budgets_s: Sequence[float] = ()) -> list[Cell]:
    """Combine every cell with every budget, shortest first, and name the group of each.

    Where there is a single budget or choice of effects, it gets no folder of its own.

    Args:
        planned: cells by the effects that were asked for.
        budgets_s: seconds of training; empty = the cells keep their length.
    """
    cells = []
    lengths: list[float | None] = [*sorted(set(budgets_s))]
    for seconds in lengths or [None]:
        for effects, members in planned.items():
            group = [f"budget-{seconds:g}s"] if len(lengths) > 1 else []
            group += [f"effects-{effects.replace(' ', '').replace(',', '+')}"] if len(planned) > 1 else []
            for cell in members:
                budget = cell.train.budget_s if seconds is None else seconds
                train = dataclasses.replace(cell.train, budget_s=budget)
                cells.append(dataclasses.replace(cell, train=train, group="/".join(group)))
    return cells


def cells_to_run(cells: Sequence[Cell], output: Path, overwrite: Overwrite) -> list[Cell]:
    """Return the cells that will be run, without those that are kept or skipped."""
    return [
        cell for cell in cells if existing_outcome(cell_folder(output, cell), overwrite, cell.config) is None
    ]


def expected_time_line(cells: Sequence[Cell]) -> str:
    """Return a line with the expected time of runs of the default length on this machine's CPU.

    The kernels must be compiled.
    """
    total, slower = 0.0, slowness()
    for cell in cells:
        camera = cell.scene.train[0].camera
        pixels = camera.width * camera.height
        gaussians = min(cell.train.max_gaussians or pixels, pixels)
        total += expected_s(cell.train.iterations, pixels, gaussians) * slower
    length = seconds_range([cell.train.iterations for cell in cells])
    return (
        f"no --iterations and no --budget: {counted(len(cells), 'run')} of {length} iterations take "
        f"{_duration(MIN_RATIO * total)} to {_duration(MAX_RATIO * total)} with 3dgs on this machine, "
        "most other methods up to 3 times as long, those with networks for appearance up to 12; --budget 10m "
        "ends each after ten minutes"
    )


def _duration(seconds: float) -> str:
    if seconds < 5400:
        return f"{max(round(seconds / 60), 1)} min"
    return f"{seconds / 3600:.1f} h"


def choose_effects(
    wanted: str,
    scene: Scene,
    methods: Sequence[MethodEntry],
    plan: EffectsPlan | None = None,
) -> dict[str, ChosenEffects]:
    """Return the effects that every method trains with on this scene, by the method's name.

    Args:
        wanted: the value of `--effects`, for all methods except external programs, which take no effects.
        scene: the scene.
        methods: the methods.
        plan: a plan made before; None = made now if any method needs it.

    Raises:
        AwError: an effect is unknown, or the plan is of another scene.
    """
    named = parse_effects(wanted)
    again = f"'aw plan {shlex.quote(str(scene.root))}'"
    if plan is not None and plan.scene != scene.name:
        raise AwError(f"the plan is of scene {plan.scene}, not of {scene.name}: run {again}")
    if plan is not None and plan.scene_hash and plan.scene_hash != scene_identity(scene):
        raise AwError(
            f"the plan is of another state of scene {scene.name} (its files, its split, or the size of its "
            f"photos have changed): run {again}"
        )
    chosen = ChosenEffects(named, "" if wanted == "none" else wanted)
    if wanted == "auto" and any(map(takes_effects, methods)):
        plan = plan_effects(scene) if plan is None else plan
        chosen = ChosenEffects(check_effects([*plan.effects(), *published_effects(scene)]), "auto", plan)
    return {m.name: chosen if takes_effects(m) else ChosenEffects() for m in methods}
