"""Masks from files, of any segmentation or of 'aw masks', in place of those of a method."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.images import orientation, read_mask, upright
from ambiguous_wild.io.keep_resize import smaller_keep
from ambiguous_wild.io.lens import Lens, make_lens
from ambiguous_wild.io.mask_files import SPELLINGS, find_masks
from ambiguous_wild.io.original_photos import OriginalPhoto, original_photos
from ambiguous_wild.methods.mask_policies import FixedMasks
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.step import TrainData

SAME_SHAPE = 0.01  # relative difference of the sides' ratios, as of a photo whose sides were rounded


class FolderMasks(FixedMasks):
    """The masks in a folder of files."""

    def __init__(self, folder: Path) -> None:
        super().__init__([])
        self.folder = folder

    def setup(self, data: TrainData) -> None:
        self.keeps = [torch.from_numpy(keep) for keep in folder_keeps(self.folder, data.scene)]
        super().setup(data)


def build(folder: Path) -> MethodHooks:
    """Return 3DGS with these masks."""
    return MethodHooks(mask=FolderMasks(folder))


def folder_keeps(folder: Path, scene: Scene) -> list[np.ndarray]:
    """Return the keep map of each train view, [h, w] float32 in {0, 1}, from a folder of masks.

    A mask is called after the photo in the scene, or after that which the scene was built from; it has the
    photo's shape, at any size. Masks of photos as they were taken are undistorted as the photos were: those
    of their size, or else of a shape closer to theirs than to that of the undistorted photo.

    Raises:
        AwError: train photos without a mask, a file that is no mask, or one of another shape.
    """
    originals = {photo.name: photo for photo in original_photos(scene.info) or ()}
    paths = _paths(folder, scene, originals)
    lens_of = functools.cache(make_lens)
    return [_keep(paths[view.name], view, originals.get(view.name), lens_of) for view in scene.train]


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


def _keep(
    path: Path, view: View, original: OriginalPhoto | None, lens_of: Callable[[ModelCamera], Lens]
) -> np.ndarray:
    mask = upright(read_mask(path), orientation(path))
    size = view.camera.width, view.camera.height
    if original is not None and original.camera is not None and mask.shape[::-1] != size:
        # drawn on the photo as stored, or as it is shown
        turns: Sequence[int] = (1, original.orientation) if orientation(path) == 1 else (1,)
        lens = lens_of(original.camera)
        taken = _as_taken([upright(mask, turn) for turn in turns], original.size, lens)
        if taken is not None:
            at_size = cv2.resize(np.ascontiguousarray(taken), original.size, interpolation=cv2.INTER_NEAREST)
            mask = lens.remap(at_size, nearest=True)
    if _misfit(mask, size) > SAME_SHAPE:
        raise AwError(
            f"mask {path} is {mask.shape[1]}x{mask.shape[0]} px, of another shape than its photo "
            f"{view.name}, {size[0]}x{size[1]}"
        )
    if mask.shape[0] <= size[1]:
        return (cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST) > 0).astype(np.float32)
    return smaller_keep((mask > 0).astype(np.float32), size[::-1], "majority")


def _as_taken(turned: Sequence[np.ndarray], size: tuple[int, int], lens: Lens) -> np.ndarray | None:
    """Return the turned mask that is of a photo as it was taken; None if it is of the undistorted photo.

    Args:
        turned: the mask [h, w] as it is, and as it may have to be turned.
        size: width and height of the photo as it was taken, in px.
        lens: of the photo.
    """
    flat = lens.pinhole.width, lens.pinhole.height
    for mask in turned:
        if mask.shape[::-1] == size:
            return mask
    if turned[0].shape[::-1] == flat:
        return None
    closest = min(turned, key=lambda mask: _misfit(mask, size))
    misfit = _misfit(closest, size)
    return closest if misfit <= min(SAME_SHAPE, _misfit(turned[0], flat)) else None


def _misfit(mask: np.ndarray, size: tuple[int, int]) -> float:
    """Return the relative difference between the ratios of sides."""
    return abs(mask.shape[1] * size[1] / (mask.shape[0] * size[0]) - 1)
