"""The table of a simulated suite: our rows by kind of ambiguity, the board's rows, and paired differences.

A run of the board stands beside ours if it has the same dataset, poses, setting, size and seeds, and belongs
to a method that has such runs on all scenes; what is left out is said.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ambiguous_wild
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.datasets.suites import Suite
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.harness.measures import MEASURES, Measure
from ambiguous_wild.harness.result_file import RunConfig
from ambiguous_wild.harness.store import Runs, read_config, read_runs
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats
from ambiguous_wild.report.board import Entry, dataset_file, measured, read_board
from ambiguous_wild.report.board_reproduce import dataset_of, setting
from ambiguous_wild.report.board_verify import chosen_by_plan
from ambiguous_wild.report.comparison import ranked
from ambiguous_wild.report.pairs import counts_of, interval_text
from ambiguous_wild.report.suite import PreparedSuite
from ambiguous_wild.report.table_layout import ARROWS, Column, Row, State, Table, TableCell, text_table

MEASURED = ("psnr", "mask_iou")
REFERENCES = ("refinesplat", "3dgs")  # methods that ours are compared with
ALL = "all"
BOARD = " (board)"  # follows the name of a method of the board
Values = Mapping[str, float]  # by key of a measure


@dataclass
class MethodScores:
    """The values of a method: scene -> seed -> measure; a measure that is not defined is absent."""

    name: str  # as shown
    scenes: dict[str, dict[int, Values]] = field(default_factory=dict)
    failed: set[str] = field(default_factory=set)
    ranked: bool = True

    def value(self, scene: str, key: str) -> float:
        """Return the mean over seeds; NaN where a seed lacks it or there is no run."""
        seeds = self.scenes.get(scene, {})
        return stats.mean([of.get(key, math.nan) for of in seeds.values()])

    def has(self, scene: str, key: str) -> bool:
        return not math.isnan(self.value(scene, key))


def suite_board(
    prepared: PreparedSuite, folder: Path, *, factor: int | None = None, board: Path | None = None
) -> list[Table]:
    """Return the suite's table, and that of the paired differences.

    Args:
        prepared: from `prepare_simulated`.
        folder: folder of the runs.
        factor: that they were trained at; None: the suite's.
        board: folder of the leaderboard; None: there is none.

    Raises:
        AwError: no finished run, or the board is damaged.
    """
    suite = prepared.suite
    hashes = {
        name: scene_identity(load_scene(scene, factor=factor, verify=False, check=False))
        for name, scene in prepared.scenes.items()
    }
    own, settings, other = _own(read_runs(folder), hashes)
    if not any(method.scenes for method in own):
        raise AwError(f"{folder} has no finished run of {suite.name}")
    seeds = {seed for method in own for of in method.scenes.values() for seed in of}
    dataset = dataset_of(suite.dataset, prepared.exact_poses)
    rows, notes = _of_board(board, dataset, hashes, settings, seeds, factor or suite.factor)
    notes = [*other, *notes]
    table = _table(prepared, dataset, own, rows)
    pairs = _differences(own, rows, suite.scenes)
    return [table.with_notes(*notes), *([pairs] if pairs else [])]


def find_board() -> Path | None:
    """Return the leaderboard of the present folder, or else of the clone that this package lies in."""
    places = (Path("leaderboard"), Path(ambiguous_wild.__file__).parents[1] / "leaderboard")
    return next((place for place in places if measured(place).is_dir()), None)


def _own(runs: Runs, hashes: Mapping[str, str]) -> tuple[list[MethodScores], dict[str, set[str]], list[str]]:
    """Return our methods, the settings of their runs by scene, and a line on runs that are left out."""
    images = runs.images[runs.images["metric"] == "psnr"]
    psnr = {
        key: stats.mean(of.to_numpy()) for key, of in images.groupby(["scene", "method", "seed"])["value"]
    }
    methods: dict[str, MethodScores] = {}
    settings: dict[str, set[str]] = {}
    other = []
    rows: Any = runs.runs[runs.runs["scene"].isin(list(hashes))].itertuples()
    for run in rows:
        if run.scene_hash != hashes[run.scene]:
            other.append(f"{run.method} on {run.scene}")
            continue
        method = methods.setdefault(
            run.method, MethodScores(run.method, ranked=not knows_truth(runs.method_of(run.method)))
        )
        if run.status == "failed":
            method.failed.add(run.scene)
            continue
        values = {"psnr": psnr.get((run.scene, run.method, run.seed), math.nan)}
        if not math.isnan(run.mask_recall):  # without a distractor an IoU has no meaning
            values["mask_iou"] = run.mask_iou
        method.scenes.setdefault(run.scene, {})[run.seed] = values
        config: RunConfig = read_config(Path(run.folder))  # type: ignore[assignment]
        if "train" in config:  # else it is absent or damaged
            settings.setdefault(run.scene, set()).add(setting(config, chosen_by_plan(Path(run.folder))))
    order = [methods[name] for name in runs.rows() if name in methods]
    lines = [f"left out, of other poses, photos or size of the scene: {shortlist(other)}"] if other else []
    return order, settings, lines


def _of_board(
    board: Path | None,
    dataset: str,
    scenes: Mapping[str, str],  # name -> hash
    settings: Mapping[str, set[str]],
    seeds: set[int],
    factor: int,
) -> tuple[list[MethodScores], list[str]]:
    """Return the methods of the board whose runs compare with ours, and lines on what is left out."""
    entries = [] if board is None else [e for e in read_board(board) if e.dataset == dataset]
    entries = [e for e in entries if e.scene in scenes]
    if not entries:
        where = (
            "no folder leaderboard here" if board is None else f"no runs in {dataset_file(board, dataset)}"
        )
        return [], [f"no rows of the board: {where}"]
    why: Counter[str] = Counter()
    fitting = []
    for entry in entries:
        if entry.setting not in settings.get(entry.scene, ()):
            why[f"of another setting ({entry.setting})"] += 1
        elif _factor(entry) not in (factor, None):
            why[f"at factor {_factor(entry)}"] += 1
        elif entry.seed not in seeds:
            why[f"with seed {entry.seed}"] += 1
        else:
            fitting.append(entry)
    methods = []
    names = {(e.method, e.options) for e in fitting}
    for (name, options), of in grouped(fitting, lambda e: (e.method, e.options)).items():
        several = sum(other == name for other, _ in names) > 1
        method = MethodScores(name + (f" {options}" if several else "") + BOARD, ranked=not knows_truth(name))
        for entry in of:
            method.scenes.setdefault(entry.scene, {})[entry.seed] = {
                key: value
                for key, value in entry.quality.items()
                if key == "psnr" or "mask_recall" in entry.quality
            }
        lacking = [scene for scene in scenes if method.scenes.get(scene, {}).keys() != seeds]
        if lacking:
            why[f"of {name}, which has not all seeds on {shortlist(lacking, 3)}"] += len(of)
        else:
            methods.append(method)
    left = [f"{counted(count, 'run')} {reason}" for reason, count in why.most_common()]
    notes = [f"of the board left out: {shortlist(left, 6)}"] if left else []
    if other := sorted({entry.scene for entry in fitting if entry.scene_hash != scenes[entry.scene]}):
        notes.append(
            f"the board's {shortlist(other, 20)}: with other estimated poses than here, or from "
            "another version; differences include those of the scenes"
        )
    return methods, notes


def _factor(entry: Entry) -> int | None:
    """Return the size of the photos that a run of the board was trained on; None: not stated."""
    found = re.findall(r" --factor (\d+)", entry.reproduce.rpartition("aw bench ")[2])
    return int(found[0]) if found else None


def _table(
    prepared: PreparedSuite, dataset: str, own: Sequence[MethodScores], board: Sequence[MethodScores]
) -> Table:
    suite, methods = prepared.suite, [*own, *board]
    groups = {**suite.tables, ALL: suite.scenes}
    measures = [MEASURES[key] for key in MEASURED]
    columns: list[Column] = []
    cells: list[list[TableCell]] = [[] for _ in methods]
    for title, scenes in groups.items():
        for measure in measures:
            defined = [s for s in scenes if any(method.has(s, measure.key) for method in methods)]
            if not defined:
                continue
            columns.append(Column(f"{title} ({len(scenes)})", measure, dataset=dataset))
            for row, method in zip(cells, methods):
                row.append(_cell(method, defined, measure))
    rows = [
        Row(
            method.name,
            tuple(row),
            runs=sum(map(len, method.scenes.values())),
            ranked=method.ranked,
            note="" if method.ranked else "knows the truth, not ranked",
        )
        for method, row in zip(methods, cells)
    ]
    how = "exact poses" if prepared.exact_poses else "poses by structure from motion"
    title = f"{suite.name}: {counted(len(suite.scenes), 'scene')}, {how}"
    marked = ranked(rows, tuple(column.measure for column in columns), frozenset())
    failed = [f"failed: {m.name} on {shortlist(sorted(m.failed))}" for m in own if m.failed]
    references = [m.name for m in methods if not m.ranked]
    known = [f"references, not ranked: {shortlist(references)}"] if references else []
    return Table(title, tuple(columns), tuple(marked), (*failed, *known, *_undefined(suite, methods)))


def _undefined(suite: Suite, methods: Sequence[MethodScores]) -> list[str]:
    """Return a line for each measure that some scenes cannot have: their means are over the others."""
    lines = []
    for key in MEASURED:
        without = [s for s in suite.scenes if not any(method.has(s, key) for method in methods)]
        if 0 < len(without) < len(suite.scenes):
            lines.append(
                f"{MEASURES[key].label}: no method has it on {shortlist(without)}, left out of the means"
            )
    return lines


def _cell(method: MethodScores, scenes: Sequence[str], measure: Measure) -> TableCell:
    """Return the mean over scenes; missing where a scene has no value."""
    if method.failed & {*scenes}:
        return TableCell(state="failed")
    value = stats.mean([method.value(scene, measure.key) for scene in scenes])
    if math.isnan(value):
        state: State = "missing" if all(scene in method.scenes for scene in scenes) else "absent"
        return TableCell(state=state)
    seeds = sorted({seed for scene in scenes for seed in method.scenes[scene]})
    means = [
        stats.mean([method.scenes[s].get(seed, {}).get(measure.key, math.nan) for s in scenes])
        for seed in seeds
    ]
    return TableCell(value, stats.sample_std(means))


def _differences(
    own: Sequence[MethodScores], board: Sequence[MethodScores], scenes: Sequence[str]
) -> Table | None:
    """Return each of our methods against the references; those of the board if it has them."""
    boards = {method.name: method for method in board}
    ours = {method.name: method for method in own}
    pairs = []
    for at, name in enumerate(REFERENCES):
        other = boards.get(name + BOARD, ours.get(name))
        # of two references of ours one difference is enough
        without = {name, *REFERENCES[at + 1 :]} if other is ours.get(name) else set()
        pairs += [(a, other) for a in own if other is not None and a.name not in without]
    pairs.sort(key=lambda pair: own.index(pair[0]))
    rows = [row for a, b in pairs for key in MEASURED if (row := _pair(a, b, MEASURES[key], scenes))]
    if not rows:
        return None
    head = ["difference of", "to", "measure", "mean", "95 %", "w/t/l", "scenes"]
    notes = (
        "95 %: other scenes (Student's t, paired by scene); w/t/l: scenes on which it is better, equal as "
        "printed, and worse",
    )
    return dataclasses.replace(
        text_table("paired differences", head, rows, words=("to", "measure")), notes=notes
    )


def _pair(a: MethodScores, b: MethodScores, measure: Measure, scenes: Sequence[str]) -> list[str] | None:
    """Return the row of a pair; None where no scene has a value of both."""
    key, digits = measure.key, measure.digits
    own = [a.value(s, key) - b.value(s, key) for s in scenes if a.has(s, key) and b.has(s, key)]
    if not own:
        return None
    head = [a.name, b.name, f"{measure.label}{ARROWS[measure.better]}"]
    if (a.failed | b.failed) & {*scenes}:  # a method must not gain by failing on hard scenes
        return [*head, "failed", "", "", f"{len(own)}"]
    interval = stats.mean_interval(own).within(-measure.range, measure.range)
    between = interval_text(interval, digits)
    return [*head, f"{interval.mean:+z.{digits}f}", between, counts_of(own, measure).text, f"{len(own)}"]
