"""Safe writes: files and folders appear complete or not at all, replace only ours, and can be locked.

The policy of all outputs:

1. `check_output`, before the work: the place can be written and does not lie in the input; `new`: it is free.
   A link's target is written, devices and pipes are written into, everything else is refused (`place_of`).
2. `check_replaceable`: a folder that is not free is replaced only if a record of ours lists all its files;
   `refuse_files_there`: a file among the user's is replaced only with --overwrite.
3. `folder_lock` around the work: one command at a time works on a folder, on every system, through filelock.
4. `atomic_path`, `atomic_dir` write: complete or not at all. `sweep...` removes what killed commands left.

Scenes, runs and cache entries are identified by the sha256 of their files and arrays.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from ambiguous_wild.core.errors import AwError, disk_line

# Time to try again, for the case that the holder unlinked the file between our open and our lock.
_TRY_S, _AGAIN_S = 0.05, 0.005
# names of `atomic_path` and `atomic_dir` while they write
_TEMPORARY = re.compile(r"\..+\.(\d+-[a-z0-9_]{8}\.tmp(\..*)?|(tmp|old)-[a-z0-9_]{8})", re.DOTALL)


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
        AwError: nothing can be written there.
    """
    folder = Path(folder)
    with ExitStack() as stack:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(file_lock(lock_path(folder), f"{doing} (process {os.getpid()})"))
        except Held as held:
            holder = str(held) or Busy.holder
            busy = Busy(
                f"{folder} is being worked on by {holder}; wait for it to end, or choose another folder"
            )
            busy.holder = holder
            raise busy from None
        except OSError as error:
            named = OSError(error.errno, error.strerror, str(folder))
            raise AwError(f"cannot write beside {disk_line(named, 'make it writable')}") from error
        yield


@contextmanager
def patient_lock(
    folder: Path | str, doing: str, patience_s: float, waiting: Callable[[str], None] | None = None
) -> Iterator[None]:
    """Lock as `folder_lock`, but wait up to `patience_s` seconds; `waiting` is called once with the holder.

    Raises:
        Busy: it is still locked after that time.
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
    """Return the file that is locked for a folder."""
    return folder.parent / f".{folder.name}.lock"


@contextmanager
def file_lock(path: Path, text: str) -> Iterator[None]:
    """Lock a file, and write `text` into it for a process that waits; it is removed afterwards.

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
        # It is unlinked while locked, so no stale file is left; afterwards if the system refuses that.
        with contextlib.suppress(OSError):
            path.unlink()
        lock.release()


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")[:200].strip()
    except OSError:
        return ""


def sha256_file(path: Path | str) -> str:
    """Return the sha256 of the file's bytes, 64 hex digits."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def sha256_array(array: np.ndarray) -> str:
    """Return the sha256 of the array's dtype, shape and bytes."""
    contiguous = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{contiguous.dtype.str}{contiguous.shape}".encode())
    digest.update(contiguous.tobytes())
    return digest.hexdigest()


def place_of(path: Path | str) -> tuple[Path, bool]:
    """Return where an output to `path` goes, links followed, and whether it is a device or a pipe.

    Those are written into; a file or a folder is replaced whole, which the caller decides.

    Raises:
        AwError: a link to nowhere, a disk or a socket.
    """
    if not os.path.exists(path):
        if os.path.islink(path):
            raise AwError(f"cannot write {path}: it is a link to nowhere; remove it or choose another -o")
        return Path(path), False
    kind = os.stat(path).st_mode
    if stat.S_ISCHR(kind) or stat.S_ISFIFO(kind):
        return Path(path), True  # links are not followed: /dev/stdout may lead to a pipe without a path
    if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
        raise AwError(f"cannot write {path}: a disk or a socket lies there; choose another -o")
    return Path(os.path.realpath(path) if os.path.islink(path) else path), False


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path` with the same suffix; rename it to `path` on success.

    After an error the temporary file is removed and `path` is unchanged. A link's target is replaced, not
    the link; a device or a pipe gets the bytes.

    Raises:
        AwError: a folder, a link to nowhere, a disk, a socket or a pipe that nobody reads lies there.
        OSError: it cannot be written; the error names `path`, not the temporary file.
    """
    target, into = place_of(path)
    if target.is_dir():
        raise AwError(f"cannot write the file {path}: a folder lies there; choose another -o")
    folder = Path(tempfile.gettempdir()) if into else target.parent
    folder.mkdir(parents=True, exist_ok=True)
    start = f".{target.stem}."
    with _named_errors(folder / start, target):
        suffix = f".tmp{target.suffix}"
        handle, name = tempfile.mkstemp(prefix=f"{start}{os.getpid()}-", suffix=suffix, dir=folder)
        os.close(handle)
        temporary = Path(name)
        try:
            yield temporary
            with open(temporary, "rb") as f:
                os.fsync(f.fileno())
            share(temporary)
            if into:
                _write_into(temporary, target)
                temporary.unlink()
            else:
                os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def _named_errors(start: Path, target: Path) -> Iterator[None]:
    """Raise errors of the disk with the name of `target` for temporary names, which begin with `start`."""
    beginning = os.path.abspath(start)
    try:
        yield
    except AwError:
        raise
    except Exception as error:
        # safetensors has a class of its own
        words = re.search(r"(?:Os \{ code: |\(os error )(\d+)", str(error))
        number = error.errno if isinstance(error, OSError) else words and int(words[1])
        # of a copy the second name is the target
        for name in (getattr(error, "filename2", None), getattr(error, "filename", None) or start):
            path = os.path.abspath(str(name))
            if number and path.startswith(beginning):
                below = path.removeprefix(beginning).partition(os.sep)[2]
                raise OSError(number, os.strerror(number), str(target / below)) from error
        raise


def share(path: Path) -> None:
    """Give a private temporary file or folder the permissions that the user's umask leaves."""
    umask = os.umask(0)
    os.umask(umask)
    os.chmod(path, (0o777 if path.is_dir() else 0o666) & ~umask)


def _write_into(source: Path, target: Path) -> None:
    """Write the bytes of a file into a device or a pipe."""
    try:
        handle = os.open(target, os.O_WRONLY | os.O_NONBLOCK)  # a pipe without a reader would block for ever
    except OSError as error:
        if error.errno != errno.ENXIO:
            raise
        raise AwError(f"cannot write {target}: nobody reads this pipe; choose another -o") from None
    os.set_blocking(handle, True)
    with open(source, "rb") as f, open(handle, "wb", buffering=0) as out:
        shutil.copyfileobj(f, out)


@contextmanager
def atomic_dir(path: Path | str, *, replace: bool = True) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; rename it to `path` on success, replacing an older folder.

    If `path` is a link, its target is replaced, not the link. After an error no folder above it stays that
    was not there before.

    Raises:
        AwError: `path` is a file or a link to nowhere; without `replace`, it was created meanwhile.
    """
    target = Path(os.path.realpath(place_of(path)[0]))
    refuse_file(path)
    above = [folder for folder in target.parents if not folder.exists()]
    start, temporary = target.parent / f".{target.name}.", None
    with _named_errors(start, target):
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary = Path(tempfile.mkdtemp(prefix=f"{start.name}tmp-", dir=target.parent))
            share(temporary)
            yield temporary
            if not replace:
                try:
                    os.rename(temporary, target)  # fails unless the target is absent or an empty folder
                except OSError as error:
                    if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                        raise
                    raise AwError(
                        f"another command made {path} meanwhile; nothing of it is replaced: choose another -o"
                    ) from None
            else:
                replace_folder(temporary, target)
        except BaseException:
            if temporary is not None:
                shutil.rmtree(temporary, ignore_errors=True)
            for folder in above:
                with contextlib.suppress(OSError):  # another command has written into it
                    folder.rmdir()
            raise


def replace_folder(source: Path, target: Path) -> None:
    """Rename a folder to `target`, over an older folder."""
    if not target.exists():
        os.replace(source, target)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{target.name}.old-", dir=target.parent))
    os.replace(target, old / target.name)
    try:
        os.replace(source, target)
    finally:
        _remove_left(old)


def refuse_file(path: Path | str) -> None:
    """Raise AwError if `path`, a folder to be made, is a file."""
    if os.path.exists(path) and not os.path.isdir(path):
        raise AwError(f"cannot make the folder {path}: a file lies there; move it, or choose another -o")


def sweep(folder: Path | str) -> None:
    """Remove temporary files of killed processes; call it only with the folder locked."""
    for left in sorted(Path(folder).rglob(".*")):
        if _TEMPORARY.fullmatch(left.name):
            _remove_left(left)


def _remove_left(left: Path) -> None:
    """Remove what a call left; a folder that `replace_folder` took away and did not replace goes back."""
    for old in left.glob("*") if left.name[:-8].endswith(".old-") else ():
        if not os.path.lexists(left.parent / old.name):
            os.replace(old, left.parent / old.name)
    remove(left)


def remove(path: Path) -> None:
    """Remove a file, a link or a folder, if there is one."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def sweep_killed(path: Path | str) -> None:
    """Remove temporary files of `atomic_path(path)` whose processes ended; other files are left alone."""
    target = Path(path)
    start = f".{target.stem}."
    for left in target.parent.glob(glob.escape(start) + "*-*.tmp" + glob.escape(target.suffix)):
        number = left.name.removeprefix(start).partition("-")[0]
        try:
            os.kill(int(number), 0)
        except (ProcessLookupError, OverflowError):
            left.unlink(missing_ok=True)
        except (PermissionError, ValueError):  # another user's process, another program's file
            continue


def sweep_siblings(path: Path | str) -> None:
    """Remove temporary folders of killed `atomic_dir(path)` calls; call it only with `path` locked."""
    target = Path(path)
    name = glob.escape(target.name)
    for pattern in (f".{name}.tmp-*", f".{name}.old-*"):
        for left in sorted(target.parent.glob(pattern)):
            _remove_left(left)


def check_output(path: Path | str, *, outside: Mapping[str, Path] | None = None, new: bool = False) -> Path:
    """Check, before long work, that `path` can be written; nothing is made.

    Args:
        path: the output.
        outside: folders that the command reads, by name, e.g. ``{"the scene porch": root}``.
        new: it must not exist, or be an empty folder.

    Returns:
        The absolute path that will be written: the target of a link.

    Raises:
        AwError: a parent is a file, the folder is not writable, `place_of` refuses what is there, the output
            lies in a folder of `outside`, or it is not `new`.
    """
    if new and not is_free(path):
        raise AwError(f"{path} exists; nothing is overwritten: choose another -o or remove it")
    for name, folder in (outside or {}).items():
        if Path(path).resolve().is_relative_to(folder.resolve()):
            raise AwError(f"{path} lies inside {name} and would change it; choose another -o")
    target, into = place_of(path)
    if into:
        return target
    folder = Path(os.path.abspath(target)).parent
    folder = next(part for part in (folder, *folder.parents) if os.path.lexists(part))
    if not folder.is_dir():
        raise AwError(f"cannot write {path}: {folder} is a file, not a folder; choose another -o")
    try:
        os.rmdir(tempfile.mkdtemp(prefix=".aw-probe-", dir=folder))
    except OSError as error:
        raise AwError(
            f"cannot write in {folder}: {error.strerror or error}; choose another -o, or change the "
            "permissions"
        ) from error
    return Path(os.path.abspath(target))


def list_names(folder: Path) -> list[str]:
    """Files and links below a folder, sorted, as paths relative to it with slashes."""
    files = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(folder).as_posix() for path in files)


def is_free(path: Path | str) -> bool:
    """Tell whether nothing lies at a path, or an empty folder."""
    return not os.path.exists(path) or (os.path.isdir(path) and not os.listdir(path))


def check_replaceable(folder: Path, kind: str, ours: Collection[str] | None) -> None:
    """Raise AwError unless a folder is free, or holds only files that a command of ours wrote.

    Args:
        folder: the output.
        kind: what the command writes, for the message, e.g. ``"package"``.
        ours: names of the files that its record lists; None = it has no record of ours.
    """
    if is_free(folder):
        return
    if ours is None:
        raise AwError(f"{folder} exists and is no {kind}; choose another -o")
    refuse_foreign_files(folder, ours)


def refuse_foreign_files(folder: Path, ours: Collection[str]) -> None:
    """Raise AwError if the folder holds a file that is not in `ours` and would be lost."""
    for name in list_names(folder):
        if name not in ours:
            raise AwError(
                f"{folder} also holds {name}, which this command did not write and would remove: "
                "move it to another folder, or choose another -o"
            )


def refuse_files_there(folder: Path, names: Iterable[str], flag: str = "") -> None:
    """Raise AwError if the folder already holds one of the files that a command is to write.

    `flag` is the option that replaces it.
    """
    for name in names:
        if os.path.lexists(folder / name):
            how = f"; replace it with {flag}, or choose another -o" if flag else "; choose another -o"
            raise AwError(f"{folder / name} exists, and this command would replace it{how}")


def unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a JSON object; a key that stands in it twice is a ValueError (for `object_pairs_hook`)."""
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {key!r} stands in it twice")
        found[key] = value
    return found


def own_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file that this program wrote; empty if it is absent or damaged."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}


def is_record(path: Path, key: str) -> bool:
    """Tell whether a file is a JSON object with this key, which shows that a command of ours wrote it."""
    return key in own_json(path)


def write_bytes(path: Path | str, parts: Iterable[bytes | memoryview]) -> None:
    """Write the parts of a file atomically."""
    with atomic_path(path) as temporary, open(temporary, "wb") as f:
        f.writelines(parts)


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path | str, data: Any) -> None:
    """Write JSON atomically: two-space indent, key order as given, NaN refused."""
    write_text(path, json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts IMG_2 before IMG_10."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(p), p) if p.isascii() and p.isdigit() else (0, 0, p.casefold()) for p in parts]
