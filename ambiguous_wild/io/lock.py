"""Folder locks: one command at a time on one folder."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ambiguous_wild.core.errors import AwError


class Busy(AwError):
    """Another process works on the folder."""


@contextmanager
def folder_lock(folder: Path | str, doing: str) -> Iterator[None]:
    """Lock `.<name>.lock` beside the folder; the kernel frees it even after kill -9.

    Args:
        folder: it need not exist yet.
        doing: the command, for the error message of other processes, e.g. ``"aw bench"``.

    Raises:
        Busy: another process holds it.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.parent / f".{folder.name}.lock"
    handle = _locked(path, folder)
    try:
        os.truncate(handle, 0)
        os.write(handle, f"{doing} (process {os.getpid()})".encode())
        yield
    finally:
        # Unlinked while it is locked: no stale file is left.
        path.unlink(missing_ok=True)
        os.close(handle)


@contextmanager
def patient_lock(folder: Path | str, doing: str, patience_s: float) -> Iterator[None]:
    """As `folder_lock`, but wait for up to `patience_s` seconds.

    Raises:
        Busy: it is locked even then.
    """
    deadline = time.monotonic() + patience_s
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(folder_lock(folder, doing))
                break
            except Busy:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.5)
        yield


def _locked(path: Path, folder: Path) -> int:
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(handle, 200).decode(errors="replace").strip() or "another process"
            os.close(handle)
            raise Busy(
                f"{folder} is being worked on by {holder}; wait for it to end, or choose another folder"
            ) from None
        # The previous holder may unlink the file between our open and our lock. Then other processes would
        # lock a new file of this name, so try again.
        try:
            if os.path.samestat(os.fstat(handle), os.stat(path)):
                return handle
        except FileNotFoundError:
            pass
        os.close(handle)
