"""Add runs to a board after checking each, remove runs, and check a board."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.harness.store import find_runs
from ambiguous_wild.io.files import folder_lock, sha256_file, sweep
from ambiguous_wild.report import board_pictures
from ambiguous_wild.report.board import (
    ALL,
    CHECKED,
    Entry,
    Key,
    examine,
    measured,
    read_board,
    write_board,
)
from ambiguous_wild.report.board_reproduce import Scenes
from ambiguous_wild.report.board_verify import Unfinished, VerifiedRun, verify
from ambiguous_wild.report.simulated_suite import difference_from_suite

Outcome = Literal["added", "there already", "replaced", "refused", "unfinished"]
Tick = Callable[[int, int], None]


@dataclass(frozen=True)
class AddReport:
    """The outcome of one run."""

    run: Path
    outcome: Outcome
    error: str = ""


def add(
    board: Path,
    paths: Sequence[Path],
    *,
    dataset: str | None = None,
    scenes: Path | None = None,
    images: int = 3,
    replace_other: bool = False,
    quick: bool = False,
    dry: bool = False,
    tick: Tick = lambda done, total: None,
) -> list[AddReport]:
    """Check runs and add those that pass.

    Args:
        board: folder of the leaderboard; it is made if it does not exist.
        paths: run folders, or folders of runs.
        dataset: dataset of all these runs; None: what their scenes say.
        scenes: where the scenes lie; None: where the runs say.
        images: number of test images, and of train photos with masks, to copy for each scene.
        replace_other: replace a run on the board whose numbers differ.
        quick: recompute only PSNR.
        dry: write nothing.
        tick: called with (runs done, runs).

    Returns:
        One report for each run, in the order of their paths.

    Raises:
        AwError: there is no run, or the board is damaged or in use.
    """
    runs = find_runs(paths)
    with folder_lock(board, "aw leaderboard add"):
        if not dry:
            sweep(measured(board))
        on_board = read_board(board)
        board_pictures.read_index(board)  # a damaged index is found before anything is written
        finder = Scenes(scenes, dataset, on_board)
        reports: dict[Path, AddReport] = {}
        passed: list[VerifiedRun] = []
        for done, run in enumerate(sorted(runs)):
            tick(done, len(runs))
            try:
                passed.append(verify(run, finder, quick=quick))
            except Unfinished as error:
                reports[run] = AddReport(run, "refused" if run in paths else "unfinished", str(error))
            except AwError as error:
                reports[run] = AddReport(run, "refused", str(error))
        tick(len(runs), len(runs))
        merged = _merge(on_board, passed, replace_other, reports)
        if not dry:
            accepted = [v for v in passed if reports[v.run].outcome != "refused"]
            if accepted:
                write_board(board, merged)
                board_pictures.keep(board, accepted, images)  # after the runs: every picture has a run
    return [reports[run] for run in sorted(runs)]


def _merge(
    on_board: list[Entry],
    passed: list[VerifiedRun],
    replace_other: bool,
    reports: dict[Path, AddReport],
) -> list[Entry]:
    """Return the runs of the board with those that passed, and add their reports."""
    entries = {e.key: e for e in on_board}
    kept = set(entries) - ({v.entry.key for v in passed} if replace_other else set())
    for reason, bad in _conflicts(on_board, passed, kept):
        reports[bad.run] = AddReport(bad.run, "refused", reason)
    for v in passed:
        if v.run in reports:
            continue
        old = entries.get(v.entry.key)
        if old is None:
            reports[v.run] = AddReport(v.run, "added")
            entries[v.entry.key] = v.entry
        elif old.result_hash == v.entry.result_hash and old.config_hash == v.entry.config_hash:
            reports[v.run] = AddReport(v.run, "there already")
            # a run that was once checked against the photos stays checked
            better = max(old.checked, v.entry.checked, key=CHECKED.index)
            # the commands that make the scene are known only if the scene is on this machine
            reproduce = v.entry.reproduce if v.scene is not None else old.reproduce
            entries[v.entry.key] = replace(old, checked=better, reproduce=reproduce)
        elif replace_other:
            reports[v.run] = AddReport(v.run, "replaced")
            entries[v.entry.key] = v.entry
        else:
            reports[v.run] = AddReport(v.run, "refused", _other_numbers(v, old))
    return [entries[k] for k in sorted(entries)]


def _other_numbers(new: VerifiedRun, old: Entry) -> str:
    key = next((k for k in old.quality if old.quality[k] != new.entry.quality.get(k)), None)
    shown = "only its cost differs"
    if key is not None:
        shown = f"{key} is {new.entry.quality.get(key)}, on the board {old.quality[key]}"
    return (
        f"{new.run}: {old.name} is on the board with another result ({shown}); leave it out, or pass "
        "--overwrite"
    )


def _conflicts(
    on_board: list[Entry], passed: list[VerifiedRun], kept: set[Key]
) -> list[tuple[str, VerifiedRun]]:
    """Return (reason, run) of runs that contradict others; the result does not depend on their order.

    `kept` are the cells of the board that the new runs may not replace.
    """
    everything = [*on_board, *(v.entry for v in passed)]
    fixed = [e for e in on_board if e.key in kept]
    cells = grouped(passed, lambda v: v.entry.key)
    in_scene = grouped(everything, lambda e: (e.dataset, e.scene))
    configs = grouped(everything, lambda e: e.config_hash)
    board_hashes: dict[tuple[str, str], set[str]] = defaultdict(set)
    for e in on_board:
        board_hashes[e.dataset, e.scene].add(e.scene_hash)
    differences: dict[tuple[str, str], str] = {}
    conflicts: list[tuple[str, VerifiedRun]] = []
    for v in passed:
        e = v.entry
        twins = [o for o in configs[e.config_hash] if o.key != e.key]
        others = [o for o in cells[e.key] if o.entry.result_hash != e.result_hash]
        of_method = [o for o in fixed if o.method == e.method] or [
            o.entry for o in passed if o.entry.method == e.method
        ]
        edited = [o for o in of_method if o.source != e.source]
        of_setting = [
            o for o in of_method if (o.scene, o.setting, o.options) == (e.scene, e.setting, e.options)
        ]
        devices = [o for o in of_setting if o.device.partition(":")[0] != e.device.partition(":")[0]]
        planned = [o for o in passed if o.effects != v.effects and replace(o.entry, seed=e.seed).key == e.key]
        measures = list(_other_functions(e, fixed, [o.entry for o in passed]))
        if difference := _other_scene(
            v, in_scene[e.dataset, e.scene], board_hashes[e.dataset, e.scene], differences
        ):
            reason = (
                f"{v.run}: scene {e.scene!a} has hash {e.scene_hash[:12]}, in another run it has another, so "
                f"their numbers cannot be compared ({difference}); give it another --dataset"
            )
        elif others:
            reason = f"{v.run} and {others[0].run} are the same cell with different numbers; give only one"
        elif twins:
            twin = min(twins, key=lambda o: o.key)
            reason = (
                f"{v.run}: its configuration is on the board as {twin.name} of dataset {twin.dataset!a}; "
                "give it the same --dataset, or 'aw leaderboard remove' the other"
            )
        elif edited:
            reason = (
                f"{v.run}: the file of {e.method!a} differs from that of {edited[0].name}, so they cannot be "
                "averaged or compared; give its version another name, or 'aw leaderboard remove' the other"
            )
        elif devices:
            reason = (
                f"{v.run}: it ran on {e.device!a}, {devices[0].name} on {devices[0].device!a}: leave one out"
            )
        elif planned:
            reason = (
                f"{v.run}: its plan chose other effects than that of {planned[0].run}, so they have no mean: "
                "name the effects by --effects, or give one of them"
            )
        elif measures:
            key, other = measures[0]
            reason = (
                f"{v.run}: {key} comes from another function than in {other.name}, so they cannot be "
                "compared; measure both with one by 'aw rescore RUNS --metric-file FILE'"
            )
        else:
            continue
        conflicts.append((reason, v))
    return conflicts


def _other_scene(
    run: VerifiedRun, others: Sequence[Entry], known: set[str], differences: dict[tuple[str, str], str]
) -> str:
    """Return why a run is on another scene than others of its name; empty if it is not.

    Args:
        run: the run.
        others: the runs of this scene, also `run`.
        known: hashes of the scene on the board.
        differences: what `difference_from_suite` said before, by hash of the scene and dataset.
    """
    entry, scene = run.entry, run.scene
    if entry.scene_hash in known or all(other.scene_hash == entry.scene_hash for other in others):
        return ""
    if scene is None:
        return "its scene is not on this machine"
    if any(other.images != entry.images for other in others):
        return "other test photos"
    key = entry.scene_hash, entry.dataset
    if key not in differences:
        differences[key] = difference_from_suite(scene, entry.dataset)
    return differences[key]


def _other_functions(
    entry: Entry, fixed: Sequence[Entry], passed: Sequence[Entry]
) -> Iterator[tuple[str, Entry]]:
    """Yield the users' metrics that another run measured by another function: of the board, or else given."""
    for key, function in _functions(entry).items():
        rivals = [o for o in fixed if key in _functions(o)] or passed
        yield from ((key, o) for o in rivals if _functions(o).get(key, function) != function)


def _functions(entry: Entry) -> dict[str, str]:
    """Return the identity of each user's metric of a run, by key."""
    texts = (text.partition(" ") for text in entry.metric_functions.split(", ") if text)
    return {key: function for key, _, function in texts}


def remove(
    board: Path,
    *,
    method: str,
    dataset: str | None = None,
    scene: str | None = None,
    setting: str | None = None,
    seed: int | None = None,
    dry: bool = False,
) -> list[Entry]:
    """Remove the runs of a method, or only those that match all other arguments.

    Returns:
        The runs that were removed, or with `dry` would be.

    Raises:
        AwError: a name is not on the board, no run matches all arguments, or the board is in use.
    """
    if not board.is_dir():
        raise AwError(f"no leaderboard {board}: name its folder with --board")
    asked = {"method": method, "dataset": dataset, "scene": scene, "setting": setting, "seed": seed}
    with folder_lock(board, "aw leaderboard remove"):
        entries = read_board(board)
        for what, value in asked.items():
            present = {str(getattr(e, what)) for e in entries}
            if value is not None and str(value) not in present:
                raise unknown(f"{what} on the board {board}", str(value), present)
        removed = [e for e in entries if all(v is None or getattr(e, k) == v for k, v in asked.items())]
        if not removed:
            raise AwError(f"no run on {board} matches all of these options; leave one of them out")
        if not dry:
            kept = [e for e in entries if e not in removed]
            board_pictures.drop(board, kept)  # before the runs: every picture has a run
            write_board(board, kept)
    return removed


@dataclass(frozen=True)
class Checked:
    """The result of a check."""

    runs: int
    problems: tuple[str, ...]  # one line each


def check(board: Path) -> Checked:
    """Read all files of a board and compare them with each other.

    Raises:
        AwError: there is no board.
    """
    if not measured(board).is_dir():
        raise AwError(
            f"no leaderboard {board}, it has no folder 'measured': 'aw leaderboard add RUNS --board {board}' "
            "makes one"
        )
    try:
        entries, wrong = examine(board)
    except AwError as error:
        return Checked(0, (str(error),))
    everything = measured(board) / f"{ALL}.csv"
    if entries and not everything.is_file():
        wrong.append(f"{everything} is missing: 'aw leaderboard add' of any run writes it again")
    return Checked(len(entries), (*wrong, *_copies(entries), *_pictures(board)))


def _copies(entries: Iterable[Entry]) -> Iterator[str]:
    """Yield lines about runs that are listed twice: with one configuration, or as two seeds."""
    by_config: dict[str, Entry] = {}
    by_values: dict[object, Entry] = {}
    for e in entries:
        first = by_config.setdefault(e.config_hash, e)
        if first is not e:
            yield f"{e.name} and {first.name} have the same configuration hash: one is a copy of the other"
        # references without noise may agree between methods, but seeds never agree
        values = tuple(sorted((k, v) for k, v in e.quality.items() if not k.startswith("mask_")))
        other = by_values.setdefault((*e.key[:-1], values), e)
        if values and other is not e:
            yield f"{e.name} and seed {other.seed} agree in all digits: check whether it is the same run"


def _pictures(board: Path) -> Iterator[str]:
    try:
        index = board_pictures.read_index(board)
    except AwError as error:
        yield str(error)
        return
    for row in index:
        path = board_pictures.folder_of(board) / row["file"]
        if not path.is_file() or sha256_file(path) != row["sha256"]:
            yield f"picture {path} is missing or changed: restore it, or add its runs again"
