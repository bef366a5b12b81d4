"""Reproduce a published table: import a suite's scenes, choose methods, print beside the reported numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.datasets.foreign import plain
from ambiguous_wild.datasets.suites import (
    Suite,
    find_scenes,
    measured_ambiguity,
    scene_id,
    simulated_suites,
)

if TYPE_CHECKING:
    from ambiguous_wild.report.table_layout import Table

SCENES = ".scenes"  # below the runs: imported scenes
OCCLUSIONS = (0.15, 0.3)  # shares of a photo between which scenes are grouped


@dataclass(frozen=True)
class PreparedSuite:
    """Scene folders that are ready to train."""

    suite: Suite
    scenes: dict[str, Path]  # name in runs -> folder
    absent: tuple[str, ...]  # scenes of the table that were not found
    exact_poses: bool = False  # by simulated cameras, not by structure from motion


def prepare_suite(
    suite: Suite,
    root: Path,
    output: Path,
    *,
    say: Callable[[str], None] = lambda text: None,
) -> PreparedSuite:
    """Find and import the suite's scenes.

    Args:
        suite: a suite of `datasets.suites`.
        root: folder with one folder for each scene, in any layout of `aw import`, or scene folders.
        output: folder of the runs; imported scenes are put below it.
        say: gets a line about each step.

    Raises:
        AwError: no scene is found, or one cannot be imported or differs from its folder's name.
    """
    folders, absent = find_scenes(suite, root)
    if absent:
        count = f"{len(absent)} of {len(suite.scenes)} scenes"
        say(f"{suite.name}: {count} are not in {root}: {shortlist(absent, 20)}")
    ready = {}
    for scene, folder in folders.items():
        name = scene_id(scene)
        ready[name] = _ready(suite, name, folder, output / SCENES / name, say)
    return PreparedSuite(suite, ready, tuple(absent))


def _ready(suite: Suite, name: str, folder: Path, target: Path, say: Callable[[str], None]) -> Path:
    from ambiguous_wild.datasets.write import ImportSettings, import_scene
    from ambiguous_wild.io.scene_folder import read_scene_json

    info = read_scene_json(folder)
    if info is not None:
        called = str(info.get("name", folder.name))
        if plain(called) != plain(name):
            raise AwError(
                f"{folder} is the scene {called!r} by its scene.json, not {name!r}: runs and tables would "
                "have the wrong name; rename the folder, or import it again with --name"
            )
        if suite.factor and info["factor"] != suite.factor:
            say(
                f"warning: {folder} has factor {info['factor']}; {suite.dataset} is measured at "
                f"{suite.factor}"
            )
        return folder
    settings = ImportSettings(
        factor=suite.factor or None, name=name, dataset=suite.dataset, license=suite.license
    )
    done = import_scene(folder, target, settings)
    if not done.up_to_date:
        say(f"imported {folder} ({done.info['imported']['layout']}, {done.why}) into {target}")
        for warning in done.info["warnings"]:
            say(f"warning: {name}: {warning}")
    return target


def scene_facts(datasets: Collection[str]) -> dict[str, dict[str, Facts]]:
    """Return what is known of the scenes of simulated suites, for a page: dataset -> scene -> facts."""
    from ambiguous_wild.simulate.presets import preset

    measured = measured_ambiguity()
    found: dict[str, dict[str, Facts]] = {}
    for suite in simulated_suites().values():
        for kind, scenes in suite.tables.items() if suite.dataset in datasets else ():
            for scene in scenes:
                spec, ambiguity = preset(scene), measured.get(scene, {})
                covered = ambiguity.get("occlusion")
                found.setdefault(suite.dataset, {})[scene] = {
                    "ambiguity": kind,
                    "place": spec.world.place,
                    "occlusion": _occlusion_class(covered),
                    "covered": None if covered is None else round(100 * covered),
                    "summary": spec.summary,
                    "half": spec.effects.changes_colours,  # measured on half of a test photo
                    "verdict": ambiguity.get("class", "not measured"),
                }
    return found


def _occlusion_class(share: float | None) -> str:
    if share is None:
        return "not measured"
    limit = next((limit for limit in OCCLUSIONS if share < limit), None)
    return f"{OCCLUSIONS[-1]:.0%} and more" if limit is None else f"below {limit:.0%}"


def suite_methods(suite: Suite) -> list[str]:
    """Return our methods that papers report on the suite's dataset; without any, 3DGS and RefineSplat."""
    from ambiguous_wild.methods.registry import all_methods
    from ambiguous_wild.report.papers import read_reported

    reported = {plain(n.method) for n in read_reported() if n.dataset == suite.dataset and not n.setting}
    return [name for name in all_methods() if plain(name) in reported] or ["3dgs", "refinesplat"]


def suite_tables(prepared: PreparedSuite, runs: Path) -> list[Table]:
    """Return the suite's tables with the scenes as printed: our runs, then the reported rows, never mixed.

    Args:
        prepared: from `prepare_suite`.
        runs: folder of the runs.

    Raises:
        AwError: no finished run.
    """
    from ambiguous_wild.harness.store import read_runs
    from ambiguous_wild.report.papers import paper, read_reported, with_reported

    suite, measured = prepared.suite, read_runs(runs)
    present = set(measured.runs["scene"]) if len(measured.runs) else set()
    numbers = read_reported()
    tables = []
    for title, scenes in suite.tables.items():
        names = [scene_id(s) for s in scenes if scene_id(s) in present]
        if not names:
            continue
        for table in paper(measured, scenes=names, datasets={suite.dataset: names}):
            named = dataclasses.replace(table, title=f"{suite.dataset}, {title}")
            # a paper's mean over all scenes of its table is not shown beside our mean over some of them
            whole = len(names) == len(scenes) and len(suite.tables) == 1
            shown = with_reported(named, numbers)
            tables.append(shown if whole else _without_reported_mean(shown))
    if not tables:
        raise AwError(f"{runs} has no finished run of {suite.name}")
    if not prepared.absent:
        return tables
    absent = ", ".join(prepared.absent)
    note = f"scenes not found: {absent}; our mean is over fewer scenes than the papers'"
    return [table.with_notes(note) for table in tables]


def _without_reported_mean(table: Table) -> Table:
    from ambiguous_wild.report.table_layout import BLANK

    rows = []
    for row in table.rows:
        cells = tuple(cell if c.scene else BLANK for c, cell in zip(table.columns, row.cells))
        rows.append(row if row.kind == "measured" else dataclasses.replace(row, cells=cells))
    return dataclasses.replace(table, rows=tuple(rows))
