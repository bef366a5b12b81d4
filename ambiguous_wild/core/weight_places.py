"""The folders in which files of pretrained weights are searched."""

from __future__ import annotations

import os
from pathlib import Path

from ambiguous_wild.core.errors import AwError

DEFAULT_FOLDER = "~/.cache/ambiguous_wild/weights"


def weights_folder() -> Path:
    """The folder AW_WEIGHTS; `DEFAULT_FOLDER` if the variable is not set."""
    return expanded(os.environ.get("AW_WEIGHTS", "").strip() or DEFAULT_FOLDER, "AW_WEIGHTS")


def expanded(path: str | Path, name: str) -> Path:
    """The path with its ~ replaced; `name` is the variable or option that holds it.

    Raises:
        AwError: it begins with the name of a user who has no home folder.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise AwError(
            f"{name} is {str(path)!r}, but no home folder is known for its '~'; give the full path"
        ) from None


def folder_fault() -> str:
    """Why `weights_folder` cannot hold weights, and what to do: a file is in its place; "" if none is."""
    folder = weights_folder()
    there = next((place for place in (folder, *folder.parents) if place.exists()), None)
    if there is None or there.is_dir():
        return ""
    what = "the folder of weights" if there == folder else f"which the folder of weights {folder} is in"
    return f"{there}, {what}, is a file; set AW_WEIGHTS to a folder"


def torch_hub_folder() -> Path:
    """Folder of checkpoints that torch downloads: TORCH_HOME/hub/checkpoints or its default."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("TORCH_HOME")
    folder = expanded(home, "TORCH_HOME") if home else expanded(cache, "XDG_CACHE_HOME") / "torch"
    return folder / "hub" / "checkpoints"


def file_places(name: str) -> list[Path]:
    """Folders in which single files of the weights of this name are searched, in order."""
    own = weights_folder()
    return [own / name, own, torch_hub_folder()]


def find_file(name: str, files: tuple[str, ...]) -> Path | None:
    """The first of the files, which stand for each other, that exists in `file_places`."""
    paths = (folder / file for folder in file_places(name) for file in files)
    return next((path for path in paths if path.is_file()), None)
