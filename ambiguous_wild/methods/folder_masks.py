"""Masks from files, of any segmentation or of 'aw masks', in place of those of a method."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.names import check_name
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import orientation, read_mask, upright
from ambiguous_wild.io.keep_resize import smaller_keep
from ambiguous_wild.io.lens import Lens, make_lens
from ambiguous_wild.io.mask_files import SPELLINGS, find_masks, mask_files
from ambiguous_wild.io.original_photos import OriginalPhoto, original_photos
from ambiguous_wild.methods.entry import MethodEntry

if TYPE_CHECKING:
    from ambiguous_wild.splat.method_hooks import MethodHooks

SAME_SHAPE = 0.01  # relative difference of the sides' ratios, as of a photo whose sides were rounded


def folder_entry(folder: Path) -> MethodEntry:
    """Return 3DGS with the masks in a folder, under the folder's name; changed masks are another method.

    Raises:
        AwError: no such folder, no mask in it, or a name that no method can have.
    """
    if not folder.is_dir():
        raise AwError(
            f"no folder of masks {folder}: give one with a PNG for each train photo, white = static"
        )
    if bad := [sign for sign in ",=@" if sign in str(folder.resolve())]:
        raise AwError(
            f"the path of the masks {folder} holds {bad[0]!r}, which no name of a method may: rename it"
        )
    files = sorted(mask_files(folder))
    if not files:
        raise AwError(f"{folder} holds no masks: {SPELLINGS}")
    digest = config_hash([[path.relative_to(folder).as_posix(), sha256_file(path)] for path in files])
    name = check_name("name of a folder of masks", folder.resolve().name)
    recipe = functools.partial(_hooks, folder.resolve())
    return MethodEntry(name, f"3dgs with the masks in {folder.name}/", recipe, source_hash=digest)


def _hooks(folder: Path) -> MethodHooks:
    from ambiguous_wild.methods.given_masks import FolderMasks
    from ambiguous_wild.splat.method_hooks import MethodHooks

    return MethodHooks(mask=FolderMasks(folder))


def folder_keeps(folder: Path, scene: Scene) -> list[np.ndarray]:
    """Return the keep map of each train view, [h, w] float32 in {0, 1}, from a folder of masks.

    A mask is called after the photo in the scene, or after that which the scene was built from; it has the
    photo's shape, at any size. Masks of photos as they were taken are undistorted as the photos were.

    Raises:
        AwError: train photos without a mask, a file that is no mask, or one of another shape.
    """
    originals = {photo.name: photo for photo in original_photos(scene.info) or ()}
    paths = _paths(folder, scene, originals)
    lens_of = functools.cache(make_lens)
    keeps = []
    for view in scene.train:
        original = originals.get(view.name)
        lens = lens_of(original.camera) if original is not None and original.camera is not None else None
        keeps.append(_keep(paths[view.name], view, original, lens))
    return keeps


def _paths(folder: Path, scene: Scene, originals: dict[str, OriginalPhoto]) -> dict[str, Path]:
    sources = {name: photo.source for name, photo in originals.items()}
    by_source = find_masks(folder, [sources[view.name] for view in scene.train if view.name in sources])
    by_name = find_masks(folder, [view.name for view in scene.train])
    paths = {
        view.name: by_source.get(sources.get(view.name, "")) or by_name.get(view.name) for view in scene.train
    }
    absent = [sources.get(name, name) for name, path in paths.items() if path is None]
    if absent:
        raise AwError(
            f"{len(absent)} of {len(paths)} train photos have no mask in {folder}: {shortlist(absent, 3)}; "
            f"{SPELLINGS}; a white one masks nothing"
        )
    return {name: path for name, path in paths.items() if path is not None}


def _keep(path: Path, view: View, original: OriginalPhoto | None, lens: Lens | None) -> np.ndarray:
    mask = upright(read_mask(path), orientation(path))
    size = view.camera.width, view.camera.height
    if original is not None and lens is not None and mask.shape[::-1] != size:
        # drawn on the photo as stored, or as it is shown
        turns: Sequence[int] = (1, original.orientation) if orientation(path) == 1 else (1,)
        turned = next((upright(mask, t) for t in turns if _alike(upright(mask, t), original.size)), None)
        if turned is not None:
            at_size = cv2.resize(np.ascontiguousarray(turned), original.size, interpolation=cv2.INTER_NEAREST)
            mask = lens.remap(at_size, nearest=True)
    if not _alike(mask, size):
        raise AwError(
            f"mask {path} is {mask.shape[1]}x{mask.shape[0]} px, of another shape than its photo "
            f"{view.name}, {size[0]}x{size[1]}"
        )
    if mask.shape[0] <= size[1]:
        return (cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0).astype(np.float32)
    return smaller_keep((mask > 0).astype(np.float32), size[::-1], "majority")


def _alike(mask: np.ndarray, size: tuple[int, int]) -> bool:
    return abs(mask.shape[1] * size[1] / (mask.shape[0] * size[0]) - 1) <= SAME_SHAPE
