"""Photos of the training side, in memory, at every resolution the schedule asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera, Scene, View
from ambiguous_wild.io.images import as_float, load_image_codes, read_keep_map
from ambiguous_wild.splat.photos import CudaCopies, Photos, fit
from ambiguous_wild.splat.step import TrainData


def load_train_data(scene: Scene, *, device: torch.device, seed: int, cache_dir: Path) -> TrainData:
    """Read the train photos and the user's own keep masks.

    Masks lie on the device; so do photos, unless they would fill it (`splat/photos.py`).

    Raises:
        AwError: no train view, or a photo whose size is not its camera's.
    """
    if not scene.train:
        raise AwError(f"scene {scene.root} has no training views: check train_list.txt")
    photos, keeps = [], []
    pixels = sum(view.camera.height * view.camera.width for view in scene.train)
    copies = None if fit(12 * pixels, device) else CudaCopies(device)  # 3 channels of 4 bytes
    for view in scene.train:
        codes = _load_photo(view)
        if copies is None:
            photos.append(torch.from_numpy(as_float(codes)).to(device))
        else:
            small = codes if codes.dtype == np.uint8 else as_float(codes)
            photos.append(copies.hold(torch.from_numpy(small)))
        size = (view.camera.height, view.camera.width)
        keeps.append(None if view.keep_path is None else _load_keep(view.keep_path, size).to(device))
    return TrainData(
        scene=scene,
        photos=photos if copies is None else Photos(photos, device, copies),
        cameras=[view.camera for view in scene.train],
        user_keep=keeps,
        device=device,
        seed=seed,
        cache_dir=cache_dir,
    )


def _load_photo(view: View) -> np.ndarray:
    codes = load_image_codes(view.image_path)
    size = (view.camera.height, view.camera.width)
    if codes.shape[:2] != size:
        raise AwError(
            f"{view.image_path} is {codes.shape[1]}x{codes.shape[0]} px, its camera says "
            f"{size[1]}x{size[0]}; build the scene again with 'aw build-scene'"
        )
    return codes


def _load_keep(path: Path, size: tuple[int, int]) -> Tensor:
    keep = read_keep_map(path)
    if keep.shape != size:
        raise AwError(
            f"mask {path} is {keep.shape[1]}x{keep.shape[0]} px, its photo is {size[1]}x{size[0]} px; "
            "build the scene again with 'aw build-scene --masks'"
        )
    return torch.from_numpy(keep)


def shrink(image: Tensor, divisor: int) -> Tensor:
    """[H, W, 3] to [H // divisor, W // divisor, 3], area-averaged; divisor 1 returns it unchanged."""
    if divisor == 1:
        return image
    height, width = image.shape[0] // divisor, image.shape[1] // divisor
    chw = image.permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(chw, size=(height, width), mode="area")
    return small[0].permute(1, 2, 0).contiguous()


def shrink_keep(keep: Tensor, divisor: int) -> Tensor:
    """[H, W] to [H // divisor, W // divisor]: kept only where every parent pixel is kept."""
    if divisor == 1:
        return keep
    height, width = keep.shape[0] // divisor, keep.shape[1] // divisor
    return -torch.nn.functional.adaptive_max_pool2d(-keep[None, None], (height, width))[0, 0]


def shrink_camera(camera: Camera, divisor: int) -> Camera:
    """The camera of `shrink`'s image."""
    return camera if divisor == 1 else camera.resized(camera.width // divisor, camera.height // divisor)
