"""Plan a grid of cells, check it before anything is trained, and run it; a failure stops no other cell."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import with_options
from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.harness.cell import (
    Cell,
    CellReport,
    Overwrite,
    Protocol,
    RunOptions,
    scene_identity,
)
from ambiguous_wild.harness.choosing import (
    Chosen,
    check_wanted,
    chosen_by,
    scene_protocol,
    takes_effects,
)
from ambiguous_wild.harness.effects_plan import Plan
from ambiguous_wild.harness.run import (
    left_alone,
    made_anew,
    refuse_other_config,
    refuse_strange_folder,
    run_cell,
)
from ambiguous_wild.harness.start import start_file, start_line, started
from ambiguous_wild.harness.timing import LEAST, MOST, expected_s, slowness
from ambiguous_wild.harness.training import Tick
from ambiguous_wild.io.files import check_output
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import MethodEntry, get_method
from ambiguous_wild.splat.effects import ALL
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts


def try_recipes(cells: Sequence[Cell]) -> list[str]:
    """Put every method's parts together once: the last method's fault is found before the first is trained.

    Returns:
        What they start from with `--start`, a line for each scene.

    Raises:
        AwError: an option or the weights that a recipe refuses. Other errors are a run's own.
    """
    from ambiguous_wild.splat.effects import with_effects

    different = {
        (cell.method.name, repr(cell.options), cell.chosen.effects, cell.scene_id): cell for cell in cells
    }
    lines = []
    for cell in different.values():
        try:
            parts = with_effects(cell.method.build(cell.options), cell.chosen.effects)
            if cell.start is not None:
                lines.append(start_line(cell.start, cell.method.name, parts, cell.train, cell.scene))
        except AwError as error:
            raise AwError(f"{cell.method.name}: {error}") from error
        except (Exception, SystemExit):
            continue  # a plug-in's bug: its runs fail with their traceback, the others are trained
    return list(dict.fromkeys(lines))


def check_grafts(cells: Sequence[Cell]) -> list[str]:
    """Warnings of grafts, each once.

    Raises:
        AwError: a graft that could not train, or would change nothing.
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
    methods: Sequence[str],
    scenes: Sequence[Path],
    seeds: Sequence[int],
    train: TrainConfig,
    *,
    settings: Iterable[str] = (),
    device: str = "cpu",
    factor: int | None = None,
    effects: str = "none",
    plan: Plan | None = None,
    protocol: Protocol | None = None,
    start: Path | None = None,
    probing: Probing | None = None,
) -> list[Cell]:
    """Every method on every scene with every seed; all names and options are checked before any training.

    Args:
        methods: names of `aw methods`.
        scenes: scene folders.
        seeds: seeds of training.
        train: length and bookkeeping; its seed is replaced.
        settings: "method.key=value" strings.
        device: "cpu" or "cuda".
        factor: which images_N; None = what the scene was built for.
        effects: "none", "all", "auto" or names of effects; the same for all methods that can take them.
        plan: of the one scene, where it was made before; None = made where one is needed.
        protocol: "full" measures whole test photos, "half" the right half; None = what scene.json says.
        start: a splat file or point cloud to start from; None = the scene's points.
        probing: for plans that are made; None = the limits decide alone.

    Raises:
        AwError: unknown method, option or scene; a start that no camera sees; two scenes of the same name.
    """
    named = _named(methods)
    by_method = _settings_by_method(settings, list(named.values()))
    resolved = [  # before a plan is made: that trains
        (entry, with_options(entry.options(), by_method[name], f"option of {entry.name}"))
        for name, entry in named.items()
    ]
    distinct = list({path.resolve(): path for path in scenes}.values())
    loaded = [load_scene(path, factor=factor) for path in distinct]
    for scene in loaded:
        if not scene.test:
            raise AwError(
                f"{scene.root} tests nothing: no name in its test_list.txt is a photo of the model; correct "
                "the list (one name a line, UTF-8), or remove both lists, then every 8th photo tests"
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
        raise AwError(f"--start {start}: {', '.join(programs)} starts by itself; bench it without")
    for scene in loaded:
        started(Parts(), file, scene)
    cells = []
    for scene in loaded:
        identity = scene_identity(scene)
        chosen = choose(effects, scene, list(named.values()), plan, probing)
        measured = protocol or scene_protocol(scene)
        for entry, options in resolved:
            for seed in dict.fromkeys(seeds):
                config = dataclasses.replace(train, seed=seed)
                cells.append(
                    Cell(entry, options, scene, identity, config, device, chosen[entry.name], measured, file)
                )
    return cells


def _named(methods: Sequence[str]) -> dict[str, MethodEntry]:
    """The methods by name, each once: a graft may be written two ways, and so may a path."""
    named: dict[str, MethodEntry] = {}
    for entry in map(get_method, methods):
        other = named.setdefault(entry.name, entry)
        if other.source_hash != entry.source_hash:
            raise AwError(f"two methods are called {entry.name}: their runs would share a folder; rename one")
    return named


def _settings_by_method(settings: Iterable[str], entries: Sequence[MethodEntry]) -> dict[str, dict[str, str]]:
    grouped: dict[str, dict[str, str]] = {entry.name: {} for entry in entries}
    for setting in settings:
        key, equals, value = setting.partition("=")
        method, dot, option = key.partition(".")
        if not equals or not dot:
            raise AwError(f"--set {setting!r}: write METHOD.KEY=VALUE, e.g. refinesplat.lambda_cr=0.1")
        reached = False
        for entry in entries:
            keys = entry.option_keys(method, option)
            grouped[entry.name] |= dict.fromkeys(keys, value)
            reached = reached or bool(keys)
        if not reached:
            known = {entry.name for entry in entries} | {name for e in entries for _, name in e.places}
            raise unknown("method in --set", method, known)
    return grouped


def cell_folder(output: Path, cell: Cell) -> Path:
    """OUTPUT/[<group>/]<scene>/<method>/seed<k>."""
    return output / cell.group / cell.scene.name / cell.method.name / f"seed{cell.train.seed}"


def run_cells(
    cells: Sequence[Cell],
    output: Path,
    *,
    overwrite: Overwrite = "missing",
    cache_dir: Path | None = None,
    tick: Tick | None = None,
    pictures: bool = True,
    on_start: Callable[[Cell, Path], None] | None = None,
    on_end: Callable[[Cell, CellReport], None] | None = None,
) -> list[CellReport]:
    """Run what is missing; a cell's error becomes its result and the next cell goes on.

    Raises:
        AwError: a run folder holds another configuration (found before anything is trained).
    """
    options = RunOptions(cache_dir or output / ".cache", overwrite, pictures)
    reports = []
    for cell, folder in zip(cells, checked_folders(cells, output, options)):
        if on_start is not None:
            on_start(cell, folder)
        report = run_cell(cell, folder, options, tick)
        if on_end is not None:
            on_end(cell, report)
        reports.append(report)
    return reports


def checked_folders(cells: Sequence[Cell], output: Path, options: RunOptions) -> list[Path]:
    """The run folder of every cell; all are checked first.

    Raises:
        AwError: one holds another configuration or no run of ours, or nothing can be written there.
    """
    folders = [cell_folder(output, cell) for cell in cells]
    for cell, folder in zip(cells, folders):
        if folder.exists() and options.overwrite != "never":
            refuse_strange_folder(folder)
            if not made_anew(folder, options.overwrite, cell.config):
                refuse_other_config(folder, cell)
    for needed in (output, options.cache_dir):
        check_output(needed / "run")  # what cannot be written is found before it is needed
    return folders


def grouped(planned: Mapping[str, Sequence[Cell]], budgets_s: Sequence[float] = ()) -> list[Cell]:
    """Every cell with every budget, the shortest budget first, with the name of its group.

    A single budget or choice of effects gets no folder of its own.

    Args:
        planned: cells by the effects they were asked for.
        budgets_s: seconds of training; empty = as the cells have it.
    """
    cells = []
    lengths: list[float | None] = [*sorted(set(budgets_s))]
    for seconds in lengths or [None]:
        for effects, members in planned.items():
            group = [f"budget-{seconds:g}s"] if len(lengths) > 1 else []
            group += [f"effects-{effects.replace(' ', '').replace(',', '+')}"] if len(planned) > 1 else []
            cells += [_moved(cell, seconds, "/".join(group)) for cell in members]
    return cells


def _moved(cell: Cell, seconds: float | None, group: str) -> Cell:
    train = cell.train if seconds is None else dataclasses.replace(cell.train, budget_s=seconds)
    return dataclasses.replace(cell, train=train, group=group)


def unfinished(cells: Sequence[Cell], output: Path, overwrite: Overwrite) -> list[Cell]:
    """The cells that will be run: not those that are kept."""
    return [cell for cell in cells if left_alone(cell_folder(output, cell), overwrite, cell.config) is None]


def expected_line(cells: Sequence[Cell]) -> str:
    """What runs whose length nobody chose take on this machine's CPU; kernels must be compiled."""
    total, slower = 0.0, slowness()
    for cell in cells:
        camera = cell.scene.train[0].camera
        pixels = camera.width * camera.height
        most = min(cell.train.max_gaussians or pixels, pixels)
        total += expected_s(cell.train.iterations, pixels, most) * slower
    runs = "1 run" if len(cells) == 1 else f"{len(cells)} runs"
    return (
        f"no --iterations and no --budget: {runs} of {cells[0].train.iterations} iterations, "
        f"{_words(LEAST * total)} to {_words(MOST * total)} for 3dgs here, other methods up to 3 times that; "
        "--budget 10m ends each after ten minutes"
    )


def _words(seconds: float) -> str:
    if seconds < 5400:
        return f"{max(round(seconds / 60), 1)} min"
    return f"{seconds / 3600:.1f} h"


@dataclass(frozen=True)
class Probing:
    """How a plan is made from probes: for which run, and where they are kept."""

    train: TrainConfig  # length of the runs
    folder: Path
    prepare: Callable[[], None]  # makes the CPU kernels ready
    say: Callable[[str], None]  # told every decision


def choose(
    wanted: str,
    scene: Scene,
    methods: Sequence[MethodEntry],
    plan: Plan | None = None,
    probing: Probing | None = None,
) -> dict[str, Chosen]:
    """What every method trains with on this scene, by its name.

    Args:
        wanted: as `--effects` takes it; for all methods but external programs, which take no effects.
        scene: the scene.
        methods: the methods.
        plan: made before; None = made now if any method needs it.
        probing: for a plan that is made now; None = the limits decide alone.

    Raises:
        AwError: unknown effect, or a plan of another scene.
    """
    named = check_wanted(wanted)
    if plan is not None and plan.scene != scene.name:
        raise AwError(f"the plan is of scene {plan.scene}, not of {scene.name}: run 'aw plan {scene.root}'")
    if wanted != "auto":
        asked = Chosen(ALL if wanted == "all" else named, "" if wanted == "none" else wanted)
        return {m.name: asked if takes_effects(m) else Chosen() for m in methods}
    if plan is None and any(map(takes_effects, methods)):
        plan = _make_plan(scene, probing)
    found = () if plan is None else plan.effects()
    chosen = {m.name: chosen_by(found, scene, m) for m in methods}
    return {name: dataclasses.replace(c, plan=plan if c.asked else None) for name, c in chosen.items()}


def _make_plan(scene: Scene, probing: Probing | None) -> Plan:
    if probing is None:
        from ambiguous_wild.harness.effects_plan import plan_without_training
        from ambiguous_wild.harness.select_effects import untried

        return untried(plan_without_training(scene), "no probes were asked for")
    from ambiguous_wild.harness.make_plan import plan_with_probes

    plan = plan_with_probes(
        scene, probing.train, probing.folder, masks=False, prepare=probing.prepare, say=probing.say
    )
    if plan.cost is not None:
        probing.say(f"{scene.name}: {plan.cost.line()}")
    return plan
