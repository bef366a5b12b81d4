"""Remove runs from the board, with their pictures."""

from __future__ import annotations

from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.harness.leaderboard import pictures
from ambiguous_wild.harness.leaderboard.board import read_board, write_board
from ambiguous_wild.harness.leaderboard.entry import Entry
from ambiguous_wild.io.lock import folder_lock


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
            pictures.drop(board, kept)  # before its run: no picture without one
            write_board(board, kept)
    return gone
