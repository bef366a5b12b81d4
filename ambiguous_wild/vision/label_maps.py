"""Instance masks from the user: a folder with one label map a photo, made with any tool."""

from __future__ import annotations

import math
import tokenize
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.weight_files import expanded
from ambiguous_wild.io.images import decode
from ambiguous_wild.io.progress_bar import Progress

SUFFIXES = (".png", ".npy")
_ASPECT = 0.02  # a map is rejected if its aspect ratio differs from the photo's by more


class LabelMaps:
    """Label maps found by the photo's name; ids in different photos are unrelated.

    A file is a PNG of one channel (8 or 16 bits), a colour PNG (each colour is a label, black is none), or a
    .npy of integers [H, W]; 0 and below = none. A map of another size is resized (nearest).
    """

    def __init__(self, folder: str | Path) -> None:
        """Check the folder.

        Raises:
            AwError: it does not exist, its ~ names no home folder, or it holds no label map.
        """
        self.folder = expanded(folder, "labels:FOLDER")
        if not self.folder.is_dir():
            raise AwError(f"no folder {self.folder} with label maps; give one with a .png or .npy per photo")
        if not any(p.suffix.lower() in SUFFIXES for p in self.folder.rglob("*")):
            raise AwError(
                f"{self.folder} holds no label map (.png, .npy); add one per photo, named like the photo"
            )
        self.name = f"labels-1-{self.folder.name}"

    def labels(self, photo: Tensor) -> np.ndarray:
        """Not available: a label map is found by the photo's name.

        Raises:
            AwError: always; use `labels_of`, which takes names.
        """
        raise AwError(f"label maps in {self.folder} are found by the photo's name; call labels_of")

    def labels_of(self, photos: Sequence[Tensor], names: Sequence[str]) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, 1..K without gaps; 0 = none.

        Args:
            photos: [H, W, 3]; only their sizes are used.
            names: names of the photos; the map of ``a/b.jpg`` is ``a/b.png`` or ``b.png`` (or .npy).

        Raises:
            AwError: photos without a map; a map that cannot be read or whose shape differs from the photo's.
        """
        # the added 0 is always the first sorted id, even if every pixel has a label
        return [
            np.searchsorted(np.unique(np.r_[0, m.ravel()]), m).astype(np.int32)
            for m in self._raw(photos, names)
        ]

    def _raw(self, photos: Sequence[Tensor], names: Sequence[str]) -> list[np.ndarray]:
        """Read the map of every photo, [H, W] int64 at the photo's size, with the ids of the files."""
        bases = Counter(Path(name).stem for name in names)
        paths = [self._path(name, bases[Path(name).stem] == 1) for name in names]
        missing = [name for name, path in zip(names, paths) if path is None]
        if missing:
            raise AwError(
                f"{len(missing)} of {len(names)} photos have no label map in {self.folder}: "
                f"{shortlist(missing)}; add a .png or .npy of the same name for each"
            )
        sizes = [(int(p.shape[0]), int(p.shape[1])) for p in photos]
        return [_resized(read_labels(path), *size, path) for path, size in zip(paths, sizes) if path]

    def _path(self, name: str, alone: bool) -> Path | None:
        """The photo's file; without its folder only where no other photo has its base name."""
        stem = Path(name).with_suffix("")
        if stem.is_absolute() or ".." in stem.parts:  # a name must not lead out of the folder
            return None
        for base in (self.folder / stem, *[self.folder / stem.name] * alone):
            for suffix in SUFFIXES:
                path = base.with_name(base.name + suffix)
                if path.is_file():
                    return path
        return None


class SceneLabelMaps(LabelMaps):
    """Label maps whose ids are shared by all photos, as a video tracker writes them."""

    def __init__(self, folder: str | Path) -> None:
        super().__init__(folder)
        self.name = f"labels-scene-1-{self.folder.name}"

    def identities(
        self,
        photos: Sequence[Tensor],
        names: Sequence[str],
        folder: Path | None = None,
        progress: Progress = iter,
    ) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, with ids 1..P without gaps over the whole scene; 0 = none."""
        maps = self._raw(photos, names)
        ids = np.unique(np.concatenate([np.zeros(1, np.int64), *(np.unique(m) for m in maps)]))
        return [np.searchsorted(ids, m).astype(np.int32) for m in maps]


def read_labels(path: Path) -> np.ndarray:
    """Read the ids of a label map, [H, W] int64 >= 0.

    Raises:
        AwError: the file cannot be read or does not hold labels.
    """
    if path.suffix.lower() == ".npy":
        return _checked(_load_npy(path), path)
    try:
        image = decode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED, f"label map {path}")
    except OSError:
        image = None
    if image is None:
        raise AwError(f"cannot read label map {path}: it is empty, truncated or not an image; save it again")
    if image.ndim == 3:
        if image.dtype != np.uint8:
            raise AwError(f"label map {path} has {image.shape[2]} channels of 16 bits; save one channel")
        blue, green, red = (image[:, :, c].astype(np.int64) for c in range(3))
        return red + 256 * green + 65536 * blue
    return _checked(image, path)


def _load_npy(path: Path) -> np.ndarray:
    try:
        with open(path, "rb") as f:
            return _read_array(f, path.stat().st_size)
    # a damaged header is parsed as Python; the parser's errors have no common base class
    except (OSError, ValueError, EOFError, SyntaxError, tokenize.TokenError, OverflowError) as error:
        raise AwError(f"cannot read label map {path}: {error}; save integers [H, W] with np.save") from error


def _read_array(f: BinaryIO, size: int) -> np.ndarray:
    """Read the array of a .npy file; refuse a header that claims more data than the file holds."""
    version = np.lib.format.read_magic(f)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"format {version} is not supported")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(f)
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    if any(side < 0 for side in shape) or math.prod(shape) * dtype.itemsize > size - f.tell():
        raise ValueError(f"truncated: the header says {dtype} {list(shape)}")
    f.seek(0)
    return np.lib.format.read_array(f, allow_pickle=False)


def _checked(array: np.ndarray, path: Path) -> np.ndarray:
    if array.ndim != 2 or array.size == 0 or array.dtype.kind not in "bui":
        raise AwError(f"label map {path} is {array.dtype} {list(array.shape)}; integers [H, W] are needed")
    if array.dtype == np.uint64 and int(array.max()) > np.iinfo(np.int64).max:
        raise AwError(f"label map {path} holds ids of 2^63 or more; number its instances from 1")
    return np.maximum(array.astype(np.int64), 0)


def _resized(labels: np.ndarray, height: int, width: int, path: Path) -> np.ndarray:
    h, w = labels.shape
    if abs(w / h - width / height) > _ASPECT * width / height:
        raise AwError(
            f"label map {path} is {w}x{h}, its photo {width}x{height}: not the same shape; make it from the "
            "scene's undistorted photo"
        )
    if (h, w) == (height, width):
        return labels
    rows = ((np.arange(height) + 0.5) * h / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * w / width).astype(np.int64)
    return labels[rows[:, None], columns[None, :]]
