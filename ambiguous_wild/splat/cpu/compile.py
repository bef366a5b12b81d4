"""How kernels are compiled: the cache, the threads and the threading layer.

Numba's own cache compares only a kernel's own file, so a change in another file that the kernel uses would go
unnoticed. Here compiled kernels lie in a folder whose name is a hash over the source of all kernels.

The layer is OpenMP where Numba finds it. It shares two cores with torch's threads without loss: a step of 11
ms and torch work of 7 ms took 20 ms one after the other. Numba's work queue took 35 to 80 ms, because torch's
threads wait on the core that its worker needs. The queue is used where there is no OpenMP. It allows one
caller at a time, so parallel kernels run under a lock. OpenMP does not survive a fork: start processes anew.
"""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
from numba.extending import intrinsic as _intrinsic

from ambiguous_wild.io.numba_cache import rebuild_damaged_cache as forgiving

LAYERS = ["omp", "tbb", "workqueue"]  # threading layers; the first that is installed is used
_config: Any = numba.config
_lock = threading.RLock()
_TEMPORARY = "ambiguous_wild-"  # folder for kernels of a user without a writable home
_ONCE = f"{_TEMPORARY}once-"  # where that folder belongs to somebody else, too: one for each process


def kernel_cache() -> Path:
    """Return the folder of compiled kernels: NUMBA_CACHE_DIR, else in the home cache, else temporary."""
    explicit = os.environ.get("NUMBA_CACHE_DIR")
    if explicit:
        return Path(explicit)
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    name = f"kernels-{digest.hexdigest()[:12]}"
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ambiguous_wild"
        base.mkdir(parents=True, exist_ok=True)
        if os.access(base, os.W_OK):
            return base / name
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        pass
    return _private_temporary() / name


def how_often() -> str:
    """Return how often kernels are compiled, for the line that announces it."""
    folder = Path(_config.CACHE_DIR).parent
    if "NUMBA_CACHE_DIR" in os.environ or not folder.name.startswith(_TEMPORARY):
        return "once per machine"
    when = "at every command" if folder.name.startswith(_ONCE) else f"again when {folder} is emptied"
    return f"{when}, as no cache in the home folder can be written: set NUMBA_CACHE_DIR to a folder that can"


def _private_temporary() -> Path:
    """Return a temporary folder that only this user can write to, as compiled code is loaded from it."""
    user = os.getuid() if hasattr(os, "getuid") else None  # Windows: its temporary folder is the user's own
    folder = Path(tempfile.gettempdir()) / f"{_TEMPORARY}{'user' if user is None else user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return Path(tempfile.mkdtemp(prefix=_ONCE))
    mine = user is None or (status.st_uid == user and not status.st_mode & 0o022)
    mine = mine and stat.S_ISDIR(status.st_mode)
    return folder if mine else Path(tempfile.mkdtemp(prefix=_ONCE))


def _prepare() -> None:
    _config.CACHE_DIR = str(kernel_cache())
    if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
        _config.THREADING_LAYER_PRIORITY = LAYERS


_prepare()


def intrinsic(function: Callable[..., Any]) -> Any:
    """Decorate with Numba's `intrinsic`; untyped, because callers do not pass the typing context."""
    return _intrinsic(function)


def kernel(function: Callable[..., Any]) -> Any:
    """Compile for one thread; the result is kept on disk. Every operation is rounded as written."""
    return forgiving(numba.njit(cache=True, error_model="numpy")(function))


_njit: Any = numba.njit  # `_nrt` is an option without a documented type


def inner_kernel(function: Callable[..., Any]) -> Any:
    """Like `kernel`, for what a kernel calls often; it may not make arrays.

    References to arrays are not counted: two atomic operations for each array of a call took 40 % of Adam.
    """
    return forgiving(_njit(cache=True, error_model="numpy", _nrt=False)(function))


def fused_kernel(function: Callable[..., Any]) -> Any:
    """Like `kernel`, but a product may be fused into a sum and a division turned into a product.

    NaN and infinity keep their meaning. Do not use it for values that must round alike in two kernels.
    """
    return forgiving(numba.njit(cache=True, error_model="numpy", fastmath={"contract", "arcp"})(function))


def fused_inner_kernel(function: Callable[..., Any]) -> Any:
    """Like `fused_kernel` and `inner_kernel`, and compiled into its caller."""
    fast = {"contract", "arcp"}
    return forgiving(
        _njit(cache=True, error_model="numpy", fastmath=fast, _nrt=False, forceinline=True)(function)
    )


class _Serialized:
    """A parallel kernel that only one thread of the process runs at a time."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.compiled = forgiving(numba.njit(cache=True, parallel=True, error_model="numpy")(function))
        self.__doc__ = function.__doc__
        self.__name__ = function.__name__

    def __call__(self, *args: Any) -> Any:
        with _lock:
            return self.compiled(*args)


def parallel_kernel(function: Callable[..., Any]) -> Any:
    """Compile with `numba.prange` over threads; the result is kept on disk."""
    return _Serialized(function)


def set_threads(n: int) -> None:
    """Use n threads for the kernels of this process, at most as many as Numba started with.

    Results do not depend on n.
    """
    numba.set_num_threads(max(1, min(int(n), _config.NUMBA_NUM_THREADS)))


def threads() -> int:
    """Return the number of threads that the kernels use."""
    return int(numba.get_num_threads())


@contextmanager
def one_thread() -> Iterator[None]:
    """Run kernels on one thread inside of the context."""
    before = threads()
    set_threads(1)
    try:
        yield
    finally:
        set_threads(before)
