"""Cut-outs: images whose alpha is the mask, or shapes filled with a window of a photo.

The cut-outs of one photo are drawn as one transparent layer, which serves all image sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.srgb import linear_to_srgb, srgb_to_linear
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import read_png_rgb

SMALLEST_PX = 8  # shorter side
LARGEST_PX = 1200  # longer side; larger files are reduced
_BLOB_PX = 200
_BLOBS = 3
_WINDOW = 0.6  # largest window of a patch, relative to the photo's sides
TRUTH_COVER = 0.25  # share of a pixel that must be covered to mark it as distractor in the truth
_SHADOW_BLUR = 0.03  # of the cut-out's height
_LYING_SHADOW = (0.07, 0.05)  # of the cut-out's height, to the right and down


@dataclass(frozen=True)
class Cutout:
    """One distractor image."""

    name: str
    # [h, w, 4] float32: linear RGB times alpha, and alpha in [0, 1]; transparent rim of 1 px
    light: np.ndarray
    source: str = ""  # sha256 of its file; "" without a file

    @property
    def aspect(self) -> float:
        """Width over height."""
        return self.light.shape[1] / self.light.shape[0]

    @property
    def filled(self) -> float:
        """Share of the image that alpha covers."""
        return float(self.light[..., 3].mean())

    def reduced(self, height: int) -> Cutout:
        """Reduce the cut-out to at most `height` px by area averaging."""
        h, w = self.light.shape[:2]
        if h <= height:
            return self
        size = (max(SMALLEST_PX, round(w * height / h)), height)
        return Cutout(self.name, cv2.resize(self.light, size, interpolation=cv2.INTER_AREA), self.source)


def read_cutouts(folder: Path | str) -> list[Cutout]:
    """Read all PNG files of the folder, ordered by name.

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
    """Convert sRGB with alpha to linear light times alpha, with a transparent rim for soft edges.

    Args:
        rgba: [H, W, 4] float32 in [0, 1], not premultiplied.
    """
    alpha = rgba[..., 3:]
    light = np.concatenate([srgb_to_linear(rgba[..., :3]) * alpha, alpha], axis=2).astype(np.float32)
    return np.pad(light, ((1, 1), (1, 1), (0, 0)))


def _read_rgba(path: Path) -> np.ndarray | None:
    """Read [H, W, 4] float32 in [0, 1], cropped to the visible part; None if alpha holds no shape."""
    read_png_rgb(path)  # for its errors, which name the file and what to do
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
    """Draw rounded shapes, to be filled with texture."""
    cutouts = []
    grid = (np.arange(_BLOB_PX) + 0.5) / _BLOB_PX * 2 - 1
    angle, radius = np.arctan2(grid[:, None], grid[None]), np.hypot(grid[:, None], grid[None])
    for k in range(_BLOBS):
        edge = np.full_like(angle, 0.72)
        for wave in (2, 3, 5):
            edge += rng.uniform(0.02, 0.24 / wave) * np.cos(wave * angle + rng.uniform(0, 2 * np.pi))
        alpha = np.clip((edge - radius) * _BLOB_PX / 4 + 0.5, 0, 1).astype(np.float32)
        cutouts.append(Cutout(f"blob {k + 1}", np.repeat(alpha[..., None], 4, 2)))
    return cutouts


def cut_patch(
    shape: Cutout,
    photo: np.ndarray,  # [H, W, 3] uint8, sRGB
    area: float,  # px of the photo that the patch covers, if the photo is large enough
    rng: np.random.Generator,
) -> tuple[Cutout, tuple[slice, slice]]:
    """Fill the shape with a random window of a photo; returns rows and columns of the window, too."""
    tall = np.sqrt(area / (shape.aspect * shape.filled))
    tall = min(tall, _WINDOW * photo.shape[0], _WINDOW * photo.shape[1] / shape.aspect)
    sides = (max(SMALLEST_PX, round(side)) for side in (tall, tall * shape.aspect))
    height, width = (min(side, limit) for side, limit in zip(sides, photo.shape))
    top, left = (int(rng.integers(0, n - s + 1)) for n, s in zip(photo.shape, (height, width)))
    rows, columns = slice(top, top + height), slice(left, left + width)
    # Area averaging keeps the mean of alpha when reducing; linear interpolation keeps edges smooth.
    how = cv2.INTER_AREA if height < shape.light.shape[0] else cv2.INTER_LINEAR
    alpha = cv2.resize(np.ascontiguousarray(shape.light[..., 3]), (width, height), interpolation=how)
    window = photo[rows, columns].astype(np.float32) / 255
    rgba = np.concatenate([window, alpha[..., None]], 2)
    return Cutout(f"patch {shape.name}", premultiplied(rgba), shape.source), (rows, columns)


@dataclass(frozen=True)
class CutoutPlacement:
    """One cut-out in one photo: a billboard that faces the camera."""

    which: int  # index into the cut-outs
    position: tuple[float, float, float]  # world position of its foot if standing, of its centre if lying
    turn_deg: float  # clockwise in the picture
    standing: bool


def draw_layer(
    cutouts: Sequence[Cutout],
    heights: Sequence[float],
    placements: Sequence[CutoutPlacement],
    camera: Camera,
    shadow: float = 0.0,
) -> np.ndarray:  # [H, W, 4] float32: linear RGB times alpha, alpha
    """Draw the cut-outs of one photo as a layer, nearer ones over farther ones.

    Args:
        cutouts: all cut-outs.
        heights: height of each, scene units.
        placements: cut-outs in this photo.
        camera: the photo's camera, which gives the size of the layer.
        shadow: darkness of the shadow's centre, 0 (none) to 1 (black).
    """
    out = np.zeros((camera.height, camera.width, 4), np.float32)
    pixels, depths = camera.project(np.array([s.position for s in placements], float).reshape(-1, 3))
    for k in np.argsort(-depths, kind="stable"):
        at, depth, placement = pixels[k], depths[k], placements[k]
        source, tall = cutouts[placement.which].light, camera.fy * heights[placement.which] / depth
        if shadow > 0:
            dark = _warped(source[..., 3], tall, at, placement, out.shape[:2], shadow=True)
            dark = cv2.GaussianBlur(dark, (0, 0), max(_SHADOW_BLUR * tall, 0.5)) * np.float32(shadow)
            out *= 1 - dark[..., None]
            out[..., 3] += dark
        over = _warped(source, tall, at, placement, out.shape[:2], shadow=False)
        out = over + (1 - over[..., 3:]) * out
    return out


def _warped(
    source: np.ndarray,
    tall: float,
    at: np.ndarray,  # [2] px
    placement: CutoutPlacement,
    shape: tuple[int, ...],
    shadow: bool,
) -> np.ndarray:
    """Draw the source, scaled to `tall` px height, into an image of `shape`, antialiased; 0 outside."""
    h, w = source.shape[:2]
    if tall < h:  # reduce by area averaging first, because sampling alone would alias
        w, h = max(1, round(w * tall / h)), max(1, round(tall))
        source = cv2.resize(source, (w, h), interpolation=cv2.INTER_AREA)
    scale = np.array([tall * (source.shape[1] / source.shape[0]) / w, tall / h])
    angle = np.deg2rad(placement.turn_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    place = np.asarray(at, float)
    if shadow and placement.standing:  # the shadow lies on the ground to the right, flat and slanted
        turn = np.array([[1.0, -0.55], [0.0, 0.22]]) @ turn
    elif shadow:
        place = place + tall * np.array(_LYING_SHADOW)
    matrix = turn * scale
    anchor = np.array([w / 2, h if placement.standing else h / 2])
    # Pixel centres are at +0.5 in our cameras and at whole numbers in OpenCV.
    shift = place - matrix @ anchor + matrix @ [0.5, 0.5] - 0.5
    size = (shape[1], shape[0])
    return cv2.warpAffine(source, np.column_stack([matrix, shift]), size, flags=cv2.INTER_LINEAR)


def resized(over: np.ndarray, width: int, height: int) -> np.ndarray:
    """Reduce the layer for a smaller image of the same camera, by area averaging of premultiplied light."""
    if over.shape[:2] == (height, width):
        return over
    return cv2.resize(over, (width, height), interpolation=cv2.INTER_AREA)


def blend_layer(
    photo: np.ndarray,  # [H, W, 3] uint8, sRGB
    over: np.ndarray,  # [H, W, 4] float32
) -> np.ndarray:  # [H, W, 3] uint8, sRGB
    """Blend the layer over the photo in linear light; pixels that it does not cover keep their bytes."""
    touched = over[..., 3] > 0
    below = srgb_to_linear(photo[touched].astype(np.float32) / 255)
    mixed = over[touched, :3] + (1 - over[touched, 3:]) * below
    out = photo.copy()
    out[touched] = np.round(255 * linear_to_srgb(mixed)).astype(np.uint8)
    return out


def layer_mask(over: np.ndarray) -> np.ndarray:
    """Return 255 where the layer covers at least a quarter of a pixel, else 0: [H, W] uint8."""
    return np.where(over[..., 3] >= TRUTH_COVER, 255, 0).astype(np.uint8)
