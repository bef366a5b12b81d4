"""Photos of the training side, at every resolution of the schedule, on the device that trains.

Photos that fit into `RESIDENT_SHARE` of a GPU's free memory, or `FLOAT32_SHARE` of the machine's memory, stay
there as float32 for the whole run. Others are held as the codes of their files, for 8 bits a quarter of the
bytes: for a GPU in pinned memory of the host, for a CPU in `RESIDENT_SHARE` of the memory, and what does not
fit is read from its file again. The training loop announces the next view (`prefetch`); its photo is copied,
converted or read while the step computes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol, overload

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera, Scene, View
from ambiguous_wild.core.machine import in_order, photo_threads, usable_memory
from ambiguous_wild.io.corrections import corrected
from ambiguous_wild.io.images import as_float, load_image_codes, read_alpha, read_keep_map
from ambiguous_wild.io.keep_resize import smaller_keep
from ambiguous_wild.splat.step import TrainData

RESIDENT_SHARE = 0.25  # share of the memory; Gaussians, their moments, masks and gsplat's lists need the rest
FLOAT32_SHARE = (
    0.05  # share for float32 on a CPU; to convert the codes of 1600x1200 px takes 5 ms of another thread
)
PHOTOS_ON_DEVICE = 3  # photos on the device at a time: this step's, the next one's, and one for comparisons


def load_train_data(
    scene: Scene,
    *,
    device: torch.device,
    seed: int,
    cache_dir: Path,
    corrections: Mapping[str, np.ndarray] | None = None,
) -> TrainData:
    """Read the train photos and the user's own keep masks.

    Masks are put on the device, and photos too, unless they would fill it.

    Args:
        scene: the scene.
        device: where it is trained.
        seed: seed of the run.
        cache_dir: folder for features and instance masks.
        corrections: by photo, masks corrected by hand, see `io/corrections.py`.

    Raises:
        AwError: there is no train view, or a photo differs in size from its camera.
    """
    if not scene.train:
        raise AwError(f"scene {scene.root} has no training views: check train_list.txt")
    keeps: list[Tensor | None] = []
    by_hand: list[Tensor | None] = []
    for view in scene.train:
        keep = load_keep(view, with_alpha="files" not in scene.info)
        keep, hand = corrected(keep, (corrections or {}).get(view.name), view.camera)
        keeps.append(None if keep is None else torch.from_numpy(keep).to(device))
        by_hand.append(None if hand is None else torch.from_numpy(hand).to(device))
    cameras = [view.camera for view in scene.train]
    return TrainData(
        scene=scene,
        photos=read_photos([view.image_path for view in scene.train], cameras, device),
        cameras=cameras,
        user_keep=KeepMaps(keeps),
        device=device,
        seed=seed,
        cache_dir=cache_dir,
        by_hand=KeepMaps(by_hand) if corrections else (),
    )


def read_photos(files: Sequence[Path], cameras: Sequence[Camera], device: torch.device) -> Sequence[Tensor]:
    """Photos [H, W, 3] float32 in [0, 1] on the device: a list, or `PrefetchedPhotos` if memory is short.

    Raises:
        AwError: a photo differs in size from its camera.
    """
    copies: PhotoTransfer | None = None
    if 12 * sum(camera.height * camera.width for camera in cameras) > photo_memory(
        device
    ):  # 3 channels of 4 bytes
        copies = (
            CudaPhotoTransfer(device)
            if device.type == "cuda"
            else HostPhotoTransfer(photo_memory(device, RESIDENT_SHARE))
        )
    held: list[Any] = []
    readers = photo_threads(max((camera.height * camera.width for camera in cameras), default=0))
    for file, camera, codes in zip(files, cameras, in_order(load_image_codes, files, readers), strict=True):
        if codes.shape[:2] != (camera.height, camera.width):
            raise AwError(
                f"{file} is {codes.shape[1]}x{codes.shape[0]} px, its camera says "
                f"{camera.width}x{camera.height}; build the scene again with 'aw build-scene'"
            )
        if copies is None:
            held.append(torch.from_numpy(as_float(codes)).to(device))
        else:
            held.append(copies.hold(file, codes))
    return held if copies is None else PrefetchedPhotos(held, device, copies)


def load_keep(
    view: View, *, with_alpha: bool = True
) -> np.ndarray | None:  # [H, W] float32 in {0, 1}, 1 = static
    """Return the keep map of a photo, from its mask and its alpha; None if it has neither.

    A mask of the full-size photo is reduced.

    Args:
        with_alpha: whether alpha is read; masks of our own scene folders contain it already.

    Raises:
        AwError: the mask and its photo differ in shape.
    """
    size = (view.camera.height, view.camera.width)
    alpha = read_alpha(view.image_path) if with_alpha else None
    if view.keep_path is None:
        return None if alpha is None else (alpha > 0).astype(np.float32)
    keep = read_keep_map(view.keep_path)
    if keep.shape[0] > size[0] and abs(keep.shape[0] * size[1] - keep.shape[1] * size[0]) <= 2 * max(size):
        keep = smaller_keep(keep, size, "majority")
    if keep.shape != size:
        raise AwError(
            f"mask {view.keep_path} is {keep.shape[1]}x{keep.shape[0]} px, its photo is {size[1]}x{size[0]} "
            "px; correct it, or build the scene again with 'aw build-scene --keep-masks'"
        )
    return keep if alpha is None else np.where(alpha > 0, keep, np.float32(0))


def shrink(image: Tensor, factor: int) -> Tensor:
    """Average [H, W, 3] over areas to [H // factor, W // factor, 3]; 1 returns it unchanged."""
    if factor == 1:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    chw = image.permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(chw, size=(height, width), mode="area")
    return small[0].permute(1, 2, 0).contiguous()


def shrink_keep(keep: Tensor, factor: int) -> Tensor:
    """Reduce [H, W] to [H // factor, W // factor]: kept only where every pixel below is kept."""
    if factor == 1:
        return keep
    return smaller_keep(keep, (keep.shape[0] // factor, keep.shape[1] // factor), "any masked")


def shrink_camera(camera: Camera, factor: int) -> Camera:
    """Return the camera of an image that `shrink` made."""
    return camera if factor == 1 else camera.resized(camera.width // factor, camera.height // factor)


class KeepMaps(Sequence[Tensor | None]):
    """Maps [H, W] float32 of whole numbers, such as keep maps, kept as 8 bits; None where a view has none."""

    def __init__(self, maps: Iterable[Tensor | None]) -> None:
        self._codes = [None if m is None else m.to(torch.int8) for m in maps]

    def __len__(self) -> int:
        return len(self._codes)

    @overload
    def __getitem__(self, index: int) -> Tensor | None: ...
    @overload
    def __getitem__(self, index: slice) -> KeepMaps: ...
    def __getitem__(self, index: int | slice) -> Tensor | KeepMaps | None:
        if isinstance(index, slice):
            return KeepMaps(self._codes[index])
        codes = self._codes[index]
        return None if codes is None else codes.float()


class PhotoPyramid:
    """The train photos and cameras at every size; smaller photos are made when they are first asked for."""

    def __init__(self, data: TrainData) -> None:
        self._data = data
        self._photos: dict[int, Tensor] = {}  # smaller photos by view
        self._factor = 1  # of these; the schedule leaves a size for good
        self._cameras: dict[tuple[int, int], Camera] = {}
        # copies the next photo to the device while a step runs; None = all photos fit on it
        self.prefetch = getattr(data.photos, "prefetch", None)

    def sizes(self, factors: Iterable[int]) -> frozenset[tuple[int, int]]:
        """Return the heights and widths of all photos at these downsampling factors."""
        full = {(camera.height, camera.width) for camera in self._data.cameras}
        return frozenset((h // d, w // d) for h, w in full for d in factors)

    def photo(self, view: int, factor: int) -> Tensor:
        """Return a train photo at this size, [H // factor, W // factor, 3]."""
        if factor == 1:
            return self._data.photos[view]
        if self.prefetch is not None:  # the device has no room for photos, so none for smaller copies either
            return shrink(self._data.photos[view], factor)
        if factor != self._factor:
            self._photos, self._factor = {}, factor
        if view not in self._photos:
            self._photos[view] = shrink(self._data.photos[view], factor)
        return self._photos[view]

    def camera(self, view: int, factor: int) -> Camera:
        """Return the camera of `photo`, always the same object: back ends remember cameras by identity."""
        if (view, factor) not in self._cameras:
            self._cameras[view, factor] = shrink_camera(self._data.cameras[view], factor)
        return self._cameras[view, factor]


class PhotoTransfer(Protocol):
    """Brings photos to the device while a step runs."""

    def hold(self, file: Path, codes: np.ndarray) -> Any:
        """Return what `begin` needs of a photo, given its file and its codes."""

    def begin(self, held: Any) -> Any:
        """Start to bring a photo; returns what `finish` needs."""

    def finish(self, coming: Any) -> Tensor:
        """Return the photo on the device, uint8 codes or float32; work launched later waits for it."""


class HostPhotoTransfer:
    """Converts the codes of photos on another thread; those that do not fit are read from their files."""

    def __init__(self, room: float) -> None:
        """
        Args:
            room: bytes that codes may take.
        """
        self._room, self._pool = room, ThreadPoolExecutor(1)

    def hold(self, file: Path, codes: np.ndarray) -> np.ndarray | Path:
        if codes.nbytes > self._room:
            return file
        self._room -= codes.nbytes
        return codes

    def begin(self, held: np.ndarray | Path) -> Future[np.ndarray]:
        return self._pool.submit(_floats, held)

    def finish(self, coming: Future[np.ndarray]) -> Tensor:
        return torch.from_numpy(coming.result())


def _floats(held: np.ndarray | Path) -> np.ndarray:
    return as_float(load_image_codes(held) if isinstance(held, Path) else held)


class CudaPhotoTransfer:
    """Sends tensors to a GPU on a separate stream, without making the host wait."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.stream = device, torch.cuda.Stream(device)

    def hold(self, file: Path, codes: np.ndarray) -> Tensor:
        """Return the photo in pinned memory, from which it can be sent."""
        tensor = torch.from_numpy(codes if codes.dtype == np.uint8 else as_float(codes))
        try:
            return tensor.pin_memory()
        except RuntimeError:  # no more memory can be pinned: the host will wait for this copy
            return tensor

    def begin(self, held: Tensor) -> tuple[Tensor, Any]:
        with torch.cuda.stream(self.stream):
            on_gpu = held.to(self.device, non_blocking=True)
        return on_gpu, self.stream.record_event()

    def finish(self, coming: tuple[Tensor, Any]) -> Tensor:
        on_gpu, arrived = coming
        current = torch.cuda.current_stream(self.device)
        current.wait_event(arrived)
        on_gpu.record_stream(current)  # its memory is not given away before `current` has read it
        return on_gpu


class PrefetchedPhotos(Sequence[Tensor]):
    """Photos [H, W, 3] float32 in [0, 1], of which only a few lie in the device's memory at a time."""

    def __init__(self, held: Sequence[Any], device: torch.device, copies: PhotoTransfer) -> None:
        """
        Args:
            held: what `copies` holds of each photo.
            device: where photos are read.
            copies: brings them to the device.
        """
        self._held, self._device, self._copies = held, device, copies
        # A tensor on the device: a division by a Python number would multiply by its rounded reciprocal.
        self._most = torch.tensor(255.0, device=device)
        self._coming: dict[int, Any] = {}
        self._ready: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self._held)

    @overload
    def __getitem__(self, index: int) -> Tensor: ...
    @overload
    def __getitem__(self, index: slice) -> PrefetchedPhotos: ...
    def __getitem__(self, index: int | slice) -> Tensor | PrefetchedPhotos:
        if isinstance(index, slice):
            return PrefetchedPhotos(self._held[index], self._device, self._copies)
        index = range(len(self._held))[index]
        photo = self._ready.pop(index, None)
        if photo is None:
            self.prefetch(index)
            photo = self._copies.finish(self._coming.pop(index))
            photo = photo if photo.dtype == torch.float32 else photo.float() / self._most
        self._ready[index] = photo  # at the end: read most recently
        while len(self._ready) > PHOTOS_ON_DEVICE:
            del self._ready[next(iter(self._ready))]
        return photo

    def prefetch(self, index: int) -> None:
        """Start to bring this photo, unless it is on the device or on its way."""
        if index not in self._ready and index not in self._coming:
            while len(self._coming) >= PHOTOS_ON_DEVICE:  # announced and never read
                del self._coming[next(iter(self._coming))]
            self._coming[index] = self._copies.begin(self._held[index])


def photo_memory(device: torch.device, share: float = FLOAT32_SHARE) -> float:
    """Return how many bytes of photos may stay in the device's memory for the whole run.

    Args:
        device: of a GPU `RESIDENT_SHARE` of its free memory counts.
        share: of the machine's memory.
    """
    if device.type == "cuda":
        return RESIDENT_SHARE * torch.cuda.mem_get_info(device)[0]
    memory = usable_memory()
    return math.inf if memory is None else share * memory
