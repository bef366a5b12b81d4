"""One command at a time on one folder; says who holds it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ambiguous_wild.core.errors import AwError


@contextmanager
def folder_lock(folder: Path | str, doing: str) -> Iterator[None]:
    """Hold `.<name>.lock` beside the folder; the kernel frees it even after kill -9.

    Args:
        folder: what is worked on; need not exist yet.
        doing: what for, shown to whoever is refused, e.g. ``"aw bench"``.

    Raises:
        AwError: another process holds it.
    """
    folder = Path(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    path = folder.parent / f".{folder.name}.lock"
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(handle, 200).decode(errors="replace").strip() or "another process"
            raise AwError(
                f"{folder} is being worked on by {holder}; wait for it to end, or choose another folder"
            ) from None
        os.truncate(handle, 0)
        os.write(handle, f"{doing} (process {os.getpid()})".encode())
        yield
        # Unlinked while still held, so that no stale file stays behind.
        path.unlink(missing_ok=True)
    finally:
        os.close(handle)
