"""The files of a leaderboard: one CSV a dataset, one row a run; all.csv is the same, tidy.

BOARD/reported/*.csv              numbers that others printed, see docs/audit.md
BOARD/measured/<dataset>.csv      what `aw leaderboard add` took in
BOARD/measured/all.csv            the same, one number a row; made from the others
BOARD/measured/images/            small pictures, and index.csv that says what they show
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.leaderboard.entry import FIRST, LAST, TIDY, Entry, from_wide, tidy, wide
from ambiguous_wild.harness.leaderboard.sheet import board_csv, read_csv, slug
from ambiguous_wild.io.atomic import write_text

ALL = "all"


def measured(board: Path) -> Path:
    """The folder of the measured numbers."""
    return board / "measured"


def dataset_file(board: Path, dataset: str) -> Path:
    """Where the runs of a dataset stand.

    Raises:
        AwError: no file can be named after it.
    """
    name = slug(dataset)
    if not name or name == ALL:
        raise AwError(f"dataset {dataset!a} cannot name a file: use letters or digits, and not 'all'")
    return measured(board) / f"{name}.csv"


def dataset_files(board: Path) -> list[Path]:
    """The CSVs of a board, one a dataset."""
    return sorted(p for p in measured(board).glob("*.csv") if p.stem != ALL and not p.name.startswith("."))


def read_board(board: Path) -> list[Entry]:
    """Every run on the board, in order; none where there is no board yet.

    Whoever publishes or writes a board reads it so: what a hand changed must not become what was measured.

    Raises:
        AwError: a file that is damaged or was changed by hand, or a run that is there twice.
    """
    entries, wrong = examine(board)
    if wrong:
        raise AwError(wrong[0])
    return entries


def examine(board: Path) -> tuple[list[Entry], list[str]]:
    """(runs as the files have them, a line for each row and file that was changed by hand).

    Raises:
        AwError: a file that is damaged, or a run that is there twice.
    """
    entries: list[Entry] = []
    wrong: list[str] = []
    for path in dataset_files(board):
        head, rows = read_csv(path, (*FIRST, *LAST))
        found = [from_wide(head, row, f"{path} row {at}") for at, row in enumerate(rows, 2)]
        for e in found:
            if dataset_file(board, e.dataset) != path:
                raise AwError(f"{path} holds a run of dataset {e.dataset!a}: restore the file")
        wrong += [
            f"{path} row {at} ({e.name}) was changed by hand, its cells do not hash to its row_hash: restore "
            "the file from your version control, or remove it and all.csv and add its runs again"
            for at, (row, e) in enumerate(zip(rows, found), 2)
            if row["row_hash"] != e.row_hash
        ]
        entries += found
    seen: set[object] = set()
    for e in entries:
        if e.key in seen:
            raise AwError(f"{e.name} is twice in {dataset_file(board, e.dataset)}: restore the file")
        seen.add(e.key)
    entries.sort(key=lambda e: e.key)
    # Where a row was changed, all.csv must differ: that is not a second problem.
    return entries, wrong or _other_files(board, entries)


def _other_files(board: Path, entries: Sequence[Entry]) -> list[str]:
    """A line for each file that the runs do not give; one that is not there can be made from them."""
    return [
        f"{path} is not what the runs of {path.parent} give: rows were changed, added or taken out by hand, "
        "or a write was cut off; restore the files from your version control. Where "
        f"{ALL}.csv alone is wrong, remove it: 'aw leaderboard add' of any run writes it again"
        for path, text in files_of(board, entries).items()
        if path.is_file() and path.read_bytes() != text.encode()
    ]


def files_of(board: Path, entries: Sequence[Entry]) -> dict[Path, str]:
    """Path and content of every CSV of a board with these runs.

    Raises:
        AwError: two datasets whose names differ only in case or blanks.
    """
    by_file: dict[Path, list[Entry]] = {}
    for e in entries:
        by_file.setdefault(dataset_file(board, e.dataset), []).append(e)
    for path, rows in by_file.items():
        names = sorted({e.dataset for e in rows})
        if len(names) > 1:
            raise AwError(f"datasets {names[0]!a} and {names[1]!a} would share {path.name}: spell them alike")
    files = {path: board_csv(*wide(rows)) for path, rows in sorted(by_file.items())}
    return files | {measured(board) / f"{ALL}.csv": board_csv(TIDY, tidy(entries))}


def write_board(board: Path, entries: Sequence[Entry]) -> None:
    """Write what changed; all.csv last, because it can be made again from the others."""
    files = files_of(board, entries)
    for path in dataset_files(board):
        if path not in files:
            path.unlink()  # of a dataset whose last run was taken down
    for path, text in files.items():
        if not path.is_file() or path.read_bytes() != text.encode():
            write_text(path, text)
