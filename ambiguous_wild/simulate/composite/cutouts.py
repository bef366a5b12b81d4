"""Cut-outs: images whose alpha is the mask, or shapes filled with a window of a photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.simulate.atlas import srgb_to_linear

SMALLEST_PX = 8  # shorter side
LARGEST_PX = 1200  # longer side; larger files are reduced
_BLOB_PX = 200
_BLOBS = 3


@dataclass(frozen=True)
class Cutout:
    """One distractor image."""

    name: str
    light: (
        np.ndarray
    )  # [h, w, 4] float32: linear RGB times alpha, and alpha in [0, 1]; transparent rim of 1 px
    source: str = ""  # sha256 of its file, "" where it was drawn

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.light.shape[1] / self.light.shape[0]

    @property
    def filled(self) -> float:
        """Share of the rectangle that alpha covers."""
        return float(self.light[..., 3].mean())

    def reduced(self, height: int) -> Cutout:
        """The same, at most `height` px high, averaged over areas."""
        h, w = self.light.shape[:2]
        if h <= height:
            return self
        size = (max(SMALLEST_PX, round(w * height / h)), height)
        return Cutout(self.name, cv2.resize(self.light, size, interpolation=cv2.INTER_AREA), self.source)


def read_cutouts(folder: Path | str) -> list[Cutout]:
    """All PNG files of the folder, ordered by name.

    Raises:
        AwError: no folder, no PNG in it, or files whose alpha holds no shape.
    """
    root = Path(folder)
    if not root.is_dir():
        raise AwError(f"there is no folder of cut-outs {root}; give one that holds PNG files with alpha")
    paths = sorted(p for p in root.iterdir() if p.is_file() and p.suffix.lower() == ".png")
    if not paths:
        raise AwError(f"{root} holds no PNG file; a cut-out is a PNG whose alpha is its mask")
    images = {path: _read_rgba(path) for path in paths}
    flat = [p.name for p, image in images.items() if image is None]
    if flat:
        raise AwError(
            f"{len(flat)} of {len(paths)} cut-outs in {root} have no shape in alpha: {shortlist(flat)}; "
            "make the background transparent (alpha 0) or remove the file"
        )
    return [Cutout(p.stem, premultiplied(i), sha256_file(p)) for p, i in images.items() if i is not None]


def premultiplied(rgba: np.ndarray) -> np.ndarray:
    """sRGB with alpha to linear light times alpha, with a transparent rim for soft edges.

    Args:
        rgba: [H, W, 4] float32 in [0, 1], not premultiplied.
    """
    alpha = rgba[..., 3:]
    light = np.concatenate([srgb_to_linear(rgba[..., :3]) * alpha, alpha], axis=2).astype(np.float32)
    return np.pad(light, ((1, 1), (1, 1), (0, 0)))


def _read_rgba(path: Path) -> np.ndarray | None:
    """[H, W, 4] float32 in [0, 1], cropped to the visible part; None where alpha holds no shape."""
    read_png_rgb(path)  # its errors name the file and what to do
    pixels = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if (
        pixels is None
        or pixels.ndim != 3
        or pixels.shape[2] != 4
        or pixels.dtype not in (np.uint8, np.uint16)
    ):
        return None
    rgba = cv2.cvtColor(pixels, cv2.COLOR_BGRA2RGBA).astype(np.float32) / (
        255 if pixels.dtype == np.uint8 else 65535
    )
    seen = rgba[..., 3] >= 0.5
    if not seen.any() or (rgba[..., 3] > 0.99).all():
        return None
    rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
    rgba = rgba[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if min(rgba.shape[:2]) < SMALLEST_PX:
        return None
    longest = max(rgba.shape[:2])
    if longest > LARGEST_PX:
        scale = LARGEST_PX / longest
        alpha = rgba[..., 3:]
        mixed = cv2.resize(
            np.concatenate([rgba[..., :3] * alpha, alpha], 2),
            None,
            fx=scale,
            fy=scale,
            interpolation=cv2.INTER_AREA,
        )
        rgba = np.concatenate([mixed[..., :3] / np.maximum(mixed[..., 3:], 1e-6), mixed[..., 3:]], 2)
    return rgba


def blobs(rng: np.random.Generator) -> list[Cutout]:
    """Rounded shapes to be filled with texture."""
    made = []
    grid = (np.arange(_BLOB_PX) + 0.5) / _BLOB_PX * 2 - 1
    angle, radius = np.arctan2(grid[:, None], grid[None]), np.hypot(grid[:, None], grid[None])
    for k in range(_BLOBS):
        edge = np.full_like(angle, 0.72)
        for wave in (2, 3, 5):
            edge += rng.uniform(0.02, 0.24 / wave) * np.cos(wave * angle + rng.uniform(0, 2 * np.pi))
        alpha = np.clip((edge - radius) * _BLOB_PX / 4 + 0.5, 0, 1).astype(np.float32)
        made.append(Cutout(f"blob {k + 1}", np.repeat(alpha[..., None], 4, 2)))
    return made


def filled(
    shape: Cutout,
    photo: np.ndarray,  # [H, W, 3] uint8, sRGB
    corner: Sequence[int],  # row and column of the window in the photo
    size: tuple[int, int],  # height and width of the window, px
) -> Cutout:
    """The shape filled with a window of a photo."""
    (top, left), (height, width) = corner, size
    window = photo[top : top + height, left : left + width].astype(np.float32) / 255
    # Area averaging keeps the mean of alpha; linear interpolation keeps edges smooth.
    how = cv2.INTER_AREA if height < shape.light.shape[0] else cv2.INTER_LINEAR
    alpha = cv2.resize(np.ascontiguousarray(shape.light[..., 3]), (width, height), interpolation=how)
    name = f"patch {shape.name}"
    return Cutout(name, premultiplied(np.concatenate([window, alpha[..., None]], 2)), shape.source)
