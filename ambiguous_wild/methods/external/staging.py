"""The scene as an external program sees it: a folder of links, so that its writes do not change the scene.

Programs of the 3DGS family write into the scene (``sparse/0/points3D.ply``) and want their split in files of
their own. Photos are linked, folders are real; ``truth/`` is left out: no method may read it.
"""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

from ambiguous_wild.core import UNMOVED, AwError, Scene, View
from ambiguous_wild.io.colmap_model import write_views
from ambiguous_wild.io.images import image_size

Photos = Literal["all", "train", "nerf-w"]

_LEFT_OUT = {"truth", "scene.json"}


def stage(scene: Scene, folder: Path, files: Mapping[str, str], *, photos: Photos = "all") -> Path:
    """Make the folder anew.

    Args:
        scene: the scene.
        folder: of links, replaced if it exists.
        files: text by path relative to the folder; replaces a link of the same name.
        photos: "all" links the scene as it is; "train" its train photos alone, at the size at which the
            scene is loaded, as images/ with a binary model; "nerf-w" all photos at full size, as dense/ with
            a binary model and NeRF-W's table of the split, for programs that shrink them by {factor}.

    Raises:
        AwError: a path leaves the folder, or photos at full size are missing.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    if photos == "train":
        _link_views(scene.train, {v.name: v.image_path for v in scene.train}, folder, scene)
    elif photos == "nerf-w":
        _stage_nerfw(scene, folder)
    elif scene.place != UNMOVED:
        write_views(folder / "sparse" / "0", scene.views, scene.points)
    for path in () if photos != "all" else sorted(scene.root.resolve().iterdir()):
        if path.name in _LEFT_OUT or path.name.startswith(".") or (folder / path.name).exists():
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


def _link_views(
    views: Sequence[View], photos: Mapping[str, Path], folder: Path, scene: Scene, model: str = "sparse/0"
) -> None:
    for view in views:
        target = folder / "images" / view.name
        target.parent.mkdir(parents=True, exist_ok=True)
        os.symlink(photos[view.name].resolve(), target)
    write_views(folder / model, views, scene.points)


def _stage_nerfw(scene: Scene, folder: Path) -> None:
    factor = int(scene.info.get("loaded_factor") or 1)
    if factor < 2:
        raise AwError(
            f"{scene.name} is loaded at full size, and loaders of the NeRF-W family fail there: "
            "give --factor 2 or more"
        )
    views = sorted(scene.views, key=lambda view: view.name)
    photos = {view.name: _full_size(scene, view.name, factor) for view in views}
    sizes = {name: image_size(path) for name, path in photos.items()}
    full = [replace(view, camera=view.camera.resized(*sizes[view.name])) for view in views]
    _link_views(full, photos, folder / "dense", scene, model="sparse")
    rows = [f"{view.name}\t{number}\t{view.split}\t{scene.name}\n" for number, view in enumerate(views)]
    (folder / f"{scene.name}.tsv").write_text(
        "filename\tid\tsplit\tdataset\n" + "".join(rows), encoding="utf-8"
    )


def _full_size(scene: Scene, name: str, factor: int) -> Path:
    stem = (scene.root / "images" / name).with_suffix("")
    found = sorted(p for p in stem.parent.glob(f"{glob.escape(stem.name)}.*") if p.is_file())
    if len(found) != 1:
        raise AwError(f"{scene.root} has no images/{name} at full size, of which images_{factor} was made")
    return found[0]


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
