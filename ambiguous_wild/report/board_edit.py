"""Add runs to the board, where each is checked first; remove runs; check a board."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.harness.store import run_folders
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
from ambiguous_wild.report.board_verify import Unfinished, Verified, verify

Outcome = Literal["added", "there already", "replaced", "refused", "unfinished"]
Tick = Callable[[int, int], None]


@dataclass(frozen=True)
class AddReport:
    """What became of one run."""

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
        board: folder of the leaderboard; made where there is none.
        paths: run folders, or folders of runs.
        dataset: of all these runs; None: what their scenes say.
        scenes: where the scenes lie, if not where the runs say.
        images: test images, and train photos with masks, a scene of which copies are kept.
        replace_other: a run with other numbers takes the place of the one on the board.
        quick: of the metrics recompute PSNR alone.
        dry: write nothing.
        tick: called with (runs done, runs).

    Returns:
        One report a run, in the order of their paths.

    Raises:
        AwError: no run there, the board is damaged or in use.
    """
    runs = _find(paths)
    with folder_lock(board, "aw leaderboard add"):
        if not dry:
            sweep(measured(board))
        there = read_board(board)
        board_pictures.read_index(board)  # a damaged one is found before anything is written
        finder = Scenes(scenes, dataset, there)
        reports: dict[Path, AddReport] = {}
        passed: list[Verified] = []
        for done, run in enumerate(sorted(runs)):
            tick(done, len(runs))
            try:
                passed.append(verify(run, finder, quick=quick))
            except Unfinished as error:
                reports[run] = AddReport(run, "refused" if run in paths else "unfinished", str(error))
            except AwError as error:
                reports[run] = AddReport(run, "refused", str(error))
        tick(len(runs), len(runs))
        merged = _merge(there, passed, replace_other, reports)
        if not dry:
            taken = [v for v in passed if reports[v.run].outcome != "refused"]
            if taken:
                write_board(board, merged)
                board_pictures.keep(board, taken, images)  # after its run: no picture without one
    return [reports[run] for run in sorted(runs)]


def _find(paths: Sequence[Path]) -> set[Path]:
    found: set[Path] = set()
    for path in paths:
        if not path.is_dir():
            raise AwError(f"no run folder {path}: give a folder that 'aw bench -o' wrote")
        below = list(run_folders(path))
        if not below:
            raise AwError(f"no run in {path}: 'aw bench --method NAME --scene SCENE -o {path}' makes one")
        found.update(below)
    return found


def _merge(
    there: list[Entry],
    passed: list[Verified],
    replace_other: bool,
    reports: dict[Path, AddReport],
) -> list[Entry]:
    """The runs of the board afterwards; fills in the reports."""
    entries = {e.key: e for e in there}
    for reason, bad in _conflicts(there, passed):
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
            # A run that was once checked against the photos stays checked.
            better = max(old.checked, v.entry.checked, key=CHECKED.index)
            # The commands that make the scene are known where the scene is at hand.
            again = v.entry.reproduce if v.scene is not None else old.reproduce
            entries[v.entry.key] = replace(old, checked=better, reproduce=again)
        elif replace_other:
            reports[v.run] = AddReport(v.run, "replaced")
            entries[v.entry.key] = v.entry
        else:
            reports[v.run] = AddReport(v.run, "refused", _other_numbers(v, old))
    return [entries[k] for k in sorted(entries)]


def _other_numbers(new: Verified, old: Entry) -> str:
    differing = [k for k in old.quality if old.quality[k] != new.entry.quality.get(k)]
    key = differing[0] if differing else None
    shown = (
        f"{key} {new.entry.quality.get(key)} here and {old.quality[key]} there"
        if key
        else "only its cost differs"
    )
    return (
        f"{new.run}: {old.name} is on the board with another result ({shown}); leave it out, or pass "
        "--overwrite"
    )


def _conflicts(there: list[Entry], passed: list[Verified]) -> list[tuple[str, Verified]]:
    """(why, run) of those that cannot stand together; the same whatever the order they came in."""
    cells: dict[Key, list[Verified]] = defaultdict(list)
    hashes: dict[tuple[str, str], set[str]] = defaultdict(set)
    configs: dict[str, list[Entry]] = defaultdict(list)
    for v in passed:
        cells[v.entry.key].append(v)
    for e in (*there, *(v.entry for v in passed)):
        hashes[e.dataset, e.scene].add(e.scene_hash)
        configs[e.config_hash].append(e)
    on_board = {(e.dataset, e.scene): e.scene_hash for e in there}
    found: list[tuple[str, Verified]] = []
    for v in passed:
        e = v.entry
        scenes = hashes[e.dataset, e.scene]
        twins = [o for o in configs[e.config_hash] if o.key != e.key]
        others = [o for o in cells[e.key] if o.entry.result_hash != e.result_hash]
        if len(scenes) > 1 and e.scene_hash != on_board.get((e.dataset, e.scene)):
            reason = (
                f"{v.run}: scene {e.scene!a} has hash {e.scene_hash[:12]}, another run's of that name has "
                f"{min(scenes - {e.scene_hash})[:12]}: other photos, split or size, so their numbers do not "
                "compare; put it under another --dataset"
            )
        elif others:
            reason = f"{v.run} and {others[0].run} are the same cell with other numbers; give one of them"
        elif twins:
            twin = min(twins, key=lambda o: o.key)
            reason = (
                f"{v.run}: its configuration is there already as {twin.name} of dataset {twin.dataset!a}; "
                "give it the same --dataset, or 'aw leaderboard remove' the other"
            )
        else:
            continue
        found.append((reason, v))
    return found


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
    """Remove the runs of a method, or those of them that the other words choose.

    Returns:
        What was removed; with `dry` what would be.

    Raises:
        AwError: a name that is not on the board, no run that all words fit, or the board is in use.
    """
    if not board.is_dir():
        raise AwError(f"no leaderboard {board}: name its folder with --board")
    asked = {"method": method, "dataset": dataset, "scene": scene, "setting": setting, "seed": seed}
    with folder_lock(board, "aw leaderboard remove"):
        entries = read_board(board)
        for what, value in asked.items():
            there = {str(getattr(e, what)) for e in entries}
            if value is not None and str(value) not in there:
                raise unknown(f"{what} on the board {board}", str(value), there)
        gone = [e for e in entries if all(v is None or getattr(e, k) == v for k, v in asked.items())]
        if not gone:
            raise AwError(f"no run on {board} is all of this; leave out one of the choices")
        if not dry:
            kept = [e for e in entries if e not in gone]
            board_pictures.drop(board, kept)  # before its run: no picture without one
            write_board(board, kept)
    return gone


@dataclass(frozen=True)
class Checked:
    """What a check found."""

    runs: int
    problems: tuple[str, ...]  # one line each


def check(board: Path) -> Checked:
    """Read everything again and compare.

    Raises:
        AwError: no board.
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
    """Runs that are there twice: under one configuration, or as two seeds with the same numbers."""
    by_config: dict[str, Entry] = {}
    by_values: dict[object, Entry] = {}
    for e in entries:
        first = by_config.setdefault(e.config_hash, e)
        if first is not e:
            yield f"{e.name} and {first.name} have the same configuration hash: one is the other's copy"
        # Whole runs of noise-free reference rows may agree between methods; between seeds nothing does.
        values = tuple(sorted((k, v) for k, v in e.quality.items() if not k.startswith("mask_")))
        other = by_values.setdefault((*e.key[:-1], values), e)
        if values and other is not e:
            yield f"{e.name} and seed {other.seed} have the same numbers in all digits: is it the same run?"


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
