"""Where compiled kernels are kept.

Numba's own cache depends on the path of the source, and compares only a kernel's own file, so that a change
in another file that the kernel uses would go unnoticed. Here all kernels lie in one folder, whose name is a
hash over the source of all of them, the compiler and the processor: copies of the package and machines with
such a processor share it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
from filelock import FileLock, Timeout

from ambiguous_wild.io.files import sha256_file

_PACKAGE = Path(__file__).parent.parent
_KERNEL = re.compile(rb"^@(\w*kernel|intrinsic)\b", re.MULTILINE)
_FOLDERS = ("splat/cpu", "simulate")  # kernels use those of other files in them
_OPTIONS = ("io/numba_cache.py", "splat/cpu/compile.py")  # files that say how kernels are compiled
_TEMPORARY = "ambiguous_wild-"  # folder for kernels of a user without a writable home
_OF_A_PROCESS = f"{_TEMPORARY}once-"  # where that folder belongs to somebody else, too: one for each process
_PATIENCE_S = 60.0  # another process may write a kernel meanwhile
_config: Any = numba.config


def kernel_files() -> list[Path]:
    """Return the files with kernels that other files use."""
    files = (path for folder in _FOLDERS for path in sorted((_PACKAGE / folder).glob("*.py")))
    return [path for path in files if _KERNEL.search(path.read_bytes())]


def kernel_cache() -> Path:
    """Return the folder of compiled kernels: in NUMBA_CACHE_DIR, else in the home cache, else temporary."""
    host = llvmlite.binding
    processor = f"{host.get_host_cpu_name()} {host.get_host_cpu_features().flatten()}"
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__} {processor}".encode())
    for path in [*kernel_files(), *(_PACKAGE / name for name in _OPTIONS)]:
        digest.update(path.read_bytes())
    name = f"kernels-{digest.hexdigest()[:12]}"
    if explicit := os.environ.get("NUMBA_CACHE_DIR"):
        return Path(explicit) / name
    try:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "ambiguous_wild"
        base.mkdir(parents=True, exist_ok=True)
        if os.access(base, os.W_OK):
            return base / name
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        pass
    return _private_temporary() / name


@lru_cache(maxsize=1)
def cache_in_use() -> Path:
    """Return `kernel_cache` as it was when this process made its first kernel."""
    return kernel_cache()


def is_writable(folder: Path) -> bool:
    """Whether kernels can be written into a folder, which need not exist yet."""
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    return existing.is_dir() and os.access(existing, os.W_OK)


def lifetime(folder: Path) -> str:
    """Return how often kernels of a folder are compiled, for the line that announces it."""
    place = folder.parent
    if not is_writable(folder):
        when = f"at every command, as {place} cannot be written"
    elif "NUMBA_CACHE_DIR" in os.environ or not place.name.startswith(_TEMPORARY):
        return "once per machine"
    else:
        own = place.name.startswith(_OF_A_PROCESS)
        when = "at every command" if own else f"again when {place} is emptied"
        when += ", as no cache in the home folder can be written"
    return f"{when}: set NUMBA_CACHE_DIR to a folder that can"


def _private_temporary() -> Path:
    """Return a temporary folder that only this user can write to, as compiled code is loaded from it."""
    user = os.getuid() if hasattr(os, "getuid") else None  # Windows: its temporary folder is the user's own
    folder = Path(tempfile.gettempdir()) / f"{_TEMPORARY}{'user' if user is None else user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return Path(tempfile.mkdtemp(prefix=_OF_A_PROCESS))
    mine = user is None or (status.st_uid == user and not status.st_mode & 0o022)
    mine = mine and stat.S_ISDIR(status.st_mode)
    return folder if mine else Path(tempfile.mkdtemp(prefix=_OF_A_PROCESS))


class KernelLocator:
    """Tells Numba where a kernel is kept (see NUMBA_CACHE_LOCATOR_CLASSES in its manual)."""

    def __init__(self, function: Any, file: str) -> None:
        self._py_file = file
        self._line = function.__code__.co_firstlineno
        self._stamp = sha256_file(file)

    @classmethod
    def from_function(cls, function: Any, file: str) -> KernelLocator:
        """Return the locator of a kernel."""
        return cls(function, file)

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder is made before a kernel is written."""

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(cache_in_use())

    def get_source_stamp(self) -> str:
        """Return the hash of the kernel's own file, which need not be one of `kernel_files`."""
        return self._stamp

    def get_disambiguator(self) -> str:
        """Return what tells kernels of one name apart: a plug-in's file may be called like another's."""
        return f"{self._line}-{self._stamp[:8]}"


def cached_njit(function: Callable[..., Any], **options: Any) -> Any:
    """Compile with these options of `numba.njit`, and keep the result in the folder of kernels.

    A damaged file, as a full disk or a power failure leaves it, is compiled again; Numba would fail on it
    every time. What cannot be written is compiled in every process, and so is a kernel in a notebook.
    """
    options = {"error_model": "numpy", **options}
    if not Path(function.__code__.co_filename).is_file():
        return numba.njit(**options)(function)
    before = _config.CACHE_LOCATOR_CLASSES
    _config.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelLocator.__name__}"
    try:
        dispatcher: Any = numba.njit(cache=True, **options)(function)
    finally:
        _config.CACHE_LOCATOR_CLASSES = before
    cache: Any = getattr(dispatcher, "_cache", None)
    if not hasattr(cache, "load_overload") or not hasattr(cache, "save_overload"):
        return dispatcher  # it has no cache, or this is another version of Numba
    load, save = cache.load_overload, cache.save_overload

    def load_overload(*args: Any) -> Any:
        try:
            return load(*args)
        except Exception:  # pickle raises any exception on damaged data
            with contextlib.suppress(OSError):
                cache.flush()
            return None

    def save_overload(*args: Any) -> None:
        # One process at a time: Numba writes the index before the code that it names.
        with contextlib.suppress(OSError, Timeout):
            cache_in_use().mkdir(parents=True, exist_ok=True)
            with FileLock(cache_in_use() / ".lock", timeout=_PATIENCE_S):
                save(*args)

    cache.load_overload, cache.save_overload = load_overload, save_overload
    return dispatcher
