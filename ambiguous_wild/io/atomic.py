"""Atomic writes: files and folders appear under their name complete or not at all, and replace ours only."""

from __future__ import annotations

import glob
import json
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path` with the same suffix; rename it to `path` on success.

    After an error the temporary file is removed and `path` is unchanged.

    Raises:
        OSError: it cannot be written; names `path`, not the temporary file.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        handle, name = tempfile.mkstemp(
            prefix=f".{target.stem}.", suffix=f".tmp{target.suffix}", dir=target.parent
        )
    except OSError as error:
        raise _named(error, target) from None
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as f:
            os.fsync(f.fileno())
        # mkstemp makes private files; here the user's umask applies.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename in (name, temporary):
            raise _named(error, target) from error
        raise


def _named(error: OSError, target: Path) -> OSError:
    """The same error with the target's name; OSError chooses the subclass."""
    return OSError(error.errno, error.strerror, str(target))


@contextmanager
def atomic_dir(path: Path | str) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; rename it to `path` on success, replacing an older folder.

    If `path` is a link, its target is replaced, not the link.

    Raises:
        AwError: `path` is a file.
    """
    target = Path(os.path.realpath(path))
    refuse_file(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}.tmp-", dir=target.parent))
    umask = os.umask(0)
    os.umask(umask)
    os.chmod(temporary, 0o777 & ~umask)
    try:
        yield temporary
        if target.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{target.name}.old-", dir=target.parent))
            os.replace(target, old / target.name)
            os.replace(temporary, target)
            shutil.rmtree(old)
        else:
            os.replace(temporary, target)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def refuse_file(path: Path | str) -> None:
    """Raise AwError where `path`, a folder to be made, is a file."""
    if os.path.exists(path) and not os.path.isdir(path):
        raise AwError(f"cannot make the folder {path}: a file lies there; move it, or choose another -o")


def sweep(folder: Path | str) -> None:
    """Remove temporary files of killed processes; call it only with the folder locked."""
    for left in sorted(Path(folder).rglob(".*.tmp*")) + sorted(Path(folder).rglob(".*.old-*")):
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        else:
            left.unlink(missing_ok=True)


def sweep_siblings(path: Path | str) -> None:
    """Remove temporary folders of killed `atomic_dir(path)` calls; call it only with `path` locked."""
    target = Path(path)
    name = glob.escape(target.name)
    for pattern in (f".{name}.tmp-*", f".{name}.old-*"):
        for left in sorted(target.parent.glob(pattern)):
            shutil.rmtree(left, ignore_errors=True)


def check_output(path: Path | str) -> None:
    """Check, before long work, that `path` can be written; its parent folders are made.

    Raises:
        AwError: a parent is a file, or the folder is not writable.
    """
    if os.path.islink(path) and not os.path.exists(path):
        raise AwError(f"cannot write {path}: it is a link to nowhere; remove it or choose another -o")
    folder = Path(os.path.abspath(path)).parent
    for part in (folder, *folder.parents):
        if part.exists() and not part.is_dir():
            raise AwError(f"cannot write {path}: {part} is a file, not a folder; choose another -o")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.rmdir(tempfile.mkdtemp(prefix=".aw-probe-", dir=folder))
    except OSError as error:
        raise AwError(
            f"cannot write in {folder}: {error.strerror or error}; choose another -o, or change the "
            "permissions"
        ) from error


def list_names(folder: Path) -> list[str]:
    """Files and links below a folder, sorted, as paths relative to it with slashes."""
    found = (path for path in folder.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(folder).as_posix() for path in found)


def refuse_foreign_files(folder: Path, ours: Collection[str]) -> None:
    """Raise AwError where the folder holds a file that is not in `ours` and would be lost."""
    for name in list_names(folder):
        if name not in ours:
            raise AwError(
                f"{folder} also holds {name}, which this command did not write and would remove: "
                "move it to another folder, or choose another -o"
            )


def write_text(path: Path | str, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path | str, data: Any) -> None:
    """Write JSON atomically: two-space indent, key order as given, NaN refused."""
    write_text(path, json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False) + "\n")
