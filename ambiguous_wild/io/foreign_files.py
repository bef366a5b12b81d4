"""Protect the user's own files in a folder that is about to be replaced."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from ambiguous_wild.core.errors import AwError


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
