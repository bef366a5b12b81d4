"""What else the machine does while a run trains: busy processors, and other runs."""

from __future__ import annotations

import contextlib
import getpass
import os
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

_STAT = Path("/proc/stat")
_IDLE = (3, 4)  # fields of a line of /proc/stat: idle, waiting for a disk
_GUEST = (8, 9)  # counted in user and nice already


def cores() -> int:
    """Processors that this process may use."""
    return len(_allowed()) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def busy_s() -> float | None:
    """Seconds that these processors have worked since the machine started, for anybody; None = not known.

    What a hypervisor gave to other machines counts as work of others.
    """
    allowed = {f"cpu{k}" for k in _allowed()}
    try:
        lines = [line.split() for line in _STAT.read_text(encoding="ascii").splitlines()]
        rows = [[int(n) for n in line[1:]] for line in lines if line and line[0] in allowed]
    except (OSError, ValueError):
        return None
    if not rows:
        return None
    ticks = sum(n for row in rows for k, n in enumerate(row) if k not in _IDLE and k not in _GUEST)
    return ticks / float(os.sysconf("SC_CLK_TCK"))


def own_s() -> float:
    """Processor seconds of this process and of its children that have ended."""
    times = os.times()
    return time.process_time() + times.children_user + times.children_system


def unit(device: str) -> str:
    """What runs on this device share: the processors, or one GPU by its identity."""
    return _gpu_name(device) if device.startswith("cuda") else "cpu"


class Presence:
    """Says that a run of ours works here, and counts the others that say so."""

    def __init__(self, unit: str, folder: Path | None = None) -> None:
        """
        Args:
            unit: runs with the same one share it, see `unit`.
            folder: where runs leave a locked file each; None = one of this user on this machine.
        """
        safe = "".join(c if c.isalnum() or c == "-" else "-" for c in unit)
        self.folder = (_own_folder() if folder is None else folder) / safe

    @contextmanager
    def here(self) -> Iterator[None]:
        """Be counted meanwhile; the system frees the file even of a process that was killed."""
        lock = None
        with contextlib.suppress(OSError):  # a temporary folder that cannot be written: nobody is counted
            self.folder.mkdir(parents=True, exist_ok=True)
            path = self.folder / f"{os.getpid()}-{uuid.uuid4().hex[:8]}.lock"
            lock = FileLock(path, timeout=1.0, thread_local=False)
            with contextlib.suppress(Timeout):
                lock.acquire()
        try:
            yield
        finally:
            if lock is not None:
                with contextlib.suppress(OSError):
                    lock.release()
                    Path(lock.lock_file).unlink(missing_ok=True)

    def count(self) -> int:
        """Runs here now, this one included; files of processes that are gone are removed."""
        try:
            paths = sorted(self.folder.glob("*.lock"))
        except OSError:
            return 1
        return max(1, sum(_is_held(path) for path in paths))


def _is_held(path: Path) -> bool:
    lock = FileLock(path, timeout=0.0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        return True
    except OSError:
        return False
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)
        lock.release()
    return False


def _allowed() -> set[int]:
    if hasattr(os, "sched_getaffinity"):
        return set(os.sched_getaffinity(0))
    return set(range(os.cpu_count() or 1))


def _gpu_name(device: str) -> str:
    import torch

    index = torch.device(device).index or 0
    try:
        name = getattr(torch.cuda.get_device_properties(index), "uuid", None)
    except (RuntimeError, AssertionError):  # a torch without CUDA
        name = None
    return f"GPU-{name}" if name is not None else str(index)


def _own_folder() -> Path:
    try:
        user = getpass.getuser()
    except (OSError, KeyError, ImportError):
        user = "user"
    return Path(tempfile.gettempdir()) / f"ambiguous_wild-runs-{user}"
