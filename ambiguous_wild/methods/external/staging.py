"""The scene as an external program sees it: a folder of links, so that its writes do not change the scene.

Programs of the 3DGS family write into the scene (``sparse/0/points3D.ply``) and want their split in files of
their own. Photos are linked, folders are real; ``truth/`` is left out: no method may read it.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from ambiguous_wild.core import AwError, Scene

_LEFT_OUT = {"truth", "scene.json"}


def stage(scene: Scene, folder: Path, files: Mapping[str, str]) -> Path:
    """Make the folder anew.

    Args:
        scene: the scene.
        folder: of links, replaced if it exists.
        files: text by path relative to the folder; replaces a link of the same name.

    Raises:
        AwError: a path leaves the folder.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for path in sorted(scene.root.resolve().iterdir()):
        if path.name in _LEFT_OUT or path.name.startswith("."):
            continue
        if path.is_dir() and path.name != "sparse":
            os.symlink(path, folder / path.name, target_is_directory=True)
        else:
            _link_files(path, folder / path.name)
    for name, text in files.items():
        pure = PurePosixPath(name)
        target = folder / pure
        if pure.is_absolute() or ".." in pure.parts or target.parent.resolve() != target.parent.absolute():
            raise AwError(f"scene_files: {name!r} lies outside the copy, or among the scene's own photos")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        target.write_text(text, encoding="utf-8")
    return folder


def _link_files(path: Path, target: Path) -> None:
    if path.is_dir():
        target.mkdir()
        for child in sorted(path.iterdir()):
            _link_files(child, target / child.name)
    else:
        os.symlink(path, target)


def split_lists(scene: Scene) -> dict[str, str]:
    """Names of the photos of each side, one a line: values for placeholders in `files`."""
    sides = {"train": scene.train, "test": scene.test}
    out = {f"{side}_names": "".join(f"{v.name}\n" for v in views) for side, views in sides.items()}
    stems = {side: [PurePosixPath(v.name).with_suffix("") for v in views] for side, views in sides.items()}
    return out | {f"{side}_stems": "".join(f"{s}\n" for s in names) for side, names in stems.items()}
