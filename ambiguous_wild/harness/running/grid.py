"""Plan a grid of cells and run them one after the other; one that fails does not stop the others."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.harness.planning.decide import Plan
from ambiguous_wild.harness.running.cell import Cell, CellReport, Overwrite, Protocol
from ambiguous_wild.harness.running.choosing import Probing, choose
from ambiguous_wild.harness.running.identity import scene_identity
from ambiguous_wild.harness.running.published import scene_protocol
from ambiguous_wild.harness.running.run import run_isolated
from ambiguous_wild.harness.running.run_folder import refuse_other_config, refuse_strange_folder
from ambiguous_wild.harness.running.training import Tick
from ambiguous_wild.io.atomic import check_output
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import MethodEntry, get_method
from ambiguous_wild.splat.pace import TrainConfig


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
        effects: "none", "all", "auto", "default" (auto where the method lets it), or names of effects.
        plan: of the one scene, where it was made before; None = made where one is needed.
        protocol: "full" measures whole test photos, "half" the right half; None = what scene.json says.
        probing: for plans that are made; None = the limits decide alone.

    Raises:
        AwError: unknown method, option or scene; two scenes of the same name.
    """
    named = _named(methods)
    by_method = _settings_by_method(settings, list(named.values()))
    resolved = [  # before a plan is made: that trains
        (entry, with_options(entry.options(), by_method[name], f"option of {entry.name}"))
        for name, entry in named.items()
    ]
    distinct = list({path.resolve(): path for path in scenes}.values())
    loaded = [load_scene(path, factor=factor) for path in distinct]
    names = [scene.name for scene in loaded]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise AwError(
            f"two scenes are called {', '.join(sorted(twice))}: their runs would share a folder; "
            "rename one in its scene.json or bench them into different -o"
        )
    cells = []
    for scene in loaded:
        identity = scene_identity(scene)
        chosen = choose(effects, scene, list(named.values()), plan, probing)
        measured = protocol or scene_protocol(scene)
        for entry, options in resolved:
            for seed in dict.fromkeys(seeds):
                config = dataclasses.replace(train, seed=seed)
                cells.append(
                    Cell(entry, options, scene, identity, config, device, chosen[entry.name], measured)
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
    cache_dir = cache_dir or output / ".cache"
    reports = []
    for cell, folder in zip(cells, checked_folders(cells, output, overwrite, cache_dir)):
        if on_start is not None:
            on_start(cell, folder)
        report = run_isolated(
            cell, folder, cache_dir=cache_dir, overwrite=overwrite, tick=tick, pictures=pictures
        )
        if on_end is not None:
            on_end(cell, report)
        reports.append(report)
    return reports


def checked_folders(cells: Sequence[Cell], output: Path, overwrite: Overwrite, cache_dir: Path) -> list[Path]:
    """The run folder of every cell; all are checked first.

    Raises:
        AwError: one holds another configuration or no run of ours, or nothing can be written there.
    """
    folders = [cell_folder(output, cell) for cell in cells]
    for cell, folder in zip(cells, folders):
        if folder.exists() and overwrite != "never":
            refuse_strange_folder(folder)
            if overwrite == "missing":
                refuse_other_config(folder, cell)
    for needed in (output, cache_dir):
        check_output(needed / "run")  # what cannot be written is found before it is needed
    return folders
