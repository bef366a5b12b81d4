"""Check a board: rows, duplicates, pictures, and files that do not match."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.leaderboard import pictures
from ambiguous_wild.harness.leaderboard.board import ALL, examine, measured
from ambiguous_wild.harness.leaderboard.entry import Entry
from ambiguous_wild.io.hashing import sha256_file


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
        index = pictures.read_index(board)
    except AwError as error:
        yield str(error)
        return
    for row in index:
        path = pictures.folder_of(board) / row["file"]
        if not path.is_file() or sha256_file(path) != row["sha256"]:
            yield f"picture {path} is missing or changed: restore it, or add its runs again"
