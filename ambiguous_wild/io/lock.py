"""Folder locks: one command at a time on one folder; on every system, through filelock."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from ambiguous_wild.core.errors import AwError

# Long enough to look again where the holder unlinked the file between our open and our lock.
_TRY_S, _AGAIN_S = 0.05, 0.005


class Busy(AwError):
    """Another process works on the folder."""

    holder = "another process"


class Held(Exception):
    """Another process holds the file; the text is what it wrote there, or empty."""


@contextmanager
def folder_lock(folder: Path | str, doing: str) -> Iterator[None]:
    """Lock `.<name>.lock` beside the folder; the system frees it even after kill -9.

    Args:
        folder: it need not exist yet.
        doing: the command, for the error message of other processes, e.g. ``"aw bench"``.

    Raises:
        Busy: another process holds it.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        try:
            stack.enter_context(file_lock(lock_path(folder), f"{doing} (process {os.getpid()})"))
        except Held as held:
            holder = str(held) or Busy.holder
            busy = Busy(
                f"{folder} is being worked on by {holder}; wait for it to end, or choose another folder"
            )
            busy.holder = holder
            raise busy from None
        yield


@contextmanager
def patient_lock(
    folder: Path | str, doing: str, patience_s: float, waiting: Callable[[str], None] | None = None
) -> Iterator[None]:
    """As `folder_lock`, but wait for up to `patience_s` seconds; `waiting` is told once who holds it.

    Raises:
        Busy: it is locked even then.
    """
    deadline = time.monotonic() + patience_s
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(folder_lock(folder, doing))
                break
            except Busy as busy:
                if time.monotonic() > deadline:
                    raise
                if waiting is not None:
                    waiting(busy.holder)
                    waiting = None
                time.sleep(0.5)
        yield


def lock_path(folder: Path) -> Path:
    """The file that is locked for a folder."""
    return folder.parent / f".{folder.name}.lock"


@contextmanager
def file_lock(path: Path, text: str) -> Iterator[None]:
    """Lock a file and write `text` into it, for whoever finds it locked; it is removed afterwards.

    Raises:
        Held: another process, or another call of this one, holds it.
        OSError: it cannot be written.
    """
    lock = FileLock(path, timeout=_TRY_S, thread_local=False)
    try:
        lock.acquire(poll_interval=_AGAIN_S)
    except Timeout:
        raise Held(_read(path)) from None
    try:
        with contextlib.suppress(OSError):  # Windows may refuse a second handle
            path.write_text(text, encoding="utf-8")
        yield
    finally:
        # Unlinked while it is locked: no stale file is left. Where the system refuses that, afterwards.
        with contextlib.suppress(OSError):
            path.unlink()
        lock.release()


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")[:200].strip()
    except OSError:
        return ""
