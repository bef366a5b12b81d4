"""The folders in which files of pretrained weights are searched."""

from __future__ import annotations

import os
from pathlib import Path

DEFAULT_FOLDER = "~/.cache/ambiguous_wild/weights"


def weights_folder() -> Path:
    """The folder AW_WEIGHTS; `DEFAULT_FOLDER` if the variable is not set."""
    return Path(os.environ.get("AW_WEIGHTS", "").strip() or DEFAULT_FOLDER).expanduser()


def torch_hub_folder() -> Path:
    """Folder of checkpoints that torch downloads: TORCH_HOME/hub/checkpoints or its default."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = os.environ.get("TORCH_HOME") or Path(cache) / "torch"
    return Path(home).expanduser() / "hub" / "checkpoints"


def file_places(name: str) -> list[Path]:
    """Folders in which single files of the weights of this name are searched, in order."""
    own = weights_folder()
    return [own / name, own, torch_hub_folder()]


def find_file(name: str, files: tuple[str, ...]) -> Path | None:
    """The first of the files, which stand for each other, that exists in `file_places`."""
    paths = (folder / file for folder in file_places(name) for file in files)
    return next((path for path in paths if path.is_file()), None)
