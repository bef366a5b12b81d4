"""Undistort photos, masks and truth to pinhole cameras, and downsample them, each file read once.

Photos are downsampled antialiased and in linear light: averaging sRGB values darkens fine bright detail (a
black and white grid becomes 128 instead of 188), so pixels are decoded (IEC 61966-2-1), resampled by Pillow
and encoded again. Away from the border the result equals OpenImageIO's to one level, six times as fast.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from PIL import Image

from ambiguous_wild.builder.known_poses import name_in_truth
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ResampleResult, ScreenedPhoto
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.srgb import linear_to_srgb, srgb_to_linear
from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, ModelImage
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.keep_resize import smaller_keep
from ambiguous_wild.io.lens import Lens, make_lens
from ambiguous_wild.io.photos import MIN_SIDE

NUMBERED = ("instances", "objects")  # parts of the truth whose pixels are numbers
TRUTH_PARTS = ("distractor", "shadow", *NUMBERED, "clean")
MAX_LOST = 0.9  # share of the photo that is kept, below which a message says so
FACTORS = (1, 2, 4, 8)
TARGET_SIDE = 480  # px; literature trains at about 504 x 378
FILTER = Image.Resampling.BICUBIC  # antialiased: that of gsplat and NerfBaselines


def _decode_table() -> np.ndarray:
    return srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)


def _encode_table() -> np.ndarray:
    return np.round(255 * linear_to_srgb(np.arange(65536) / 65535.0)).astype(np.uint8)


# 65536 steps of linear light are finer than the narrowest step of 8-bit sRGB (1 / 3294).
_TO_LINEAR, _TO_SRGB = _decode_table(), _encode_table()


def auto_factor(sizes: list[tuple[int, int]]) -> int:
    """Return the largest of 1, 2, 4, 8 that leaves a median longer side of 480 px or more; else 1."""
    side = float(np.median([max(size) for size in sizes]))
    return max((f for f in FACTORS if side / f >= TARGET_SIDE), default=1)


def downsampled_size(width: int, height: int, factor: int) -> tuple[int, int]:
    """Return (width, height) / factor, rounded; the scene's intrinsics follow this size."""
    return max(1, round(width / factor)), max(1, round(height / factor))


def check_factor(factor: int, photos: Iterable[tuple[int, str]]) -> None:
    """Raise AwError where a factor leaves a photo (shorter side in px, name) too small to train on."""
    small = [f"{name} ({side / factor:.0f})" for side, name in photos if side / factor < MIN_SIDE]
    if factor > 1 and small:
        raise AwError(
            f"--factor {factor} leaves less than {MIN_SIDE} px a side, too small to train on, of "
            f"{shortlist(small, 3)}; choose a smaller factor, or take these photos away"
        )


def downsample_photo(
    image: np.ndarray,  # [H, W, 3] uint8, sRGB
    width: int,  # px
    height: int,  # px
) -> np.ndarray:  # [height, width, 3] uint8, sRGB
    """Resample in linear light; the edges of both images coincide, so intrinsics scale exactly."""
    linear = cv2.LUT(image, _TO_LINEAR)
    bands = [Image.fromarray(linear[..., k]).resize((width, height), FILTER) for k in range(3)]
    light = np.stack([np.asarray(band) for band in bands], axis=-1)
    return _TO_SRGB[np.clip(light * 65535 + 0.5, 0, 65535).astype(np.uint16)]


def downsample_mask(
    mask: np.ndarray,  # [H, W] uint8
    width: int,  # px
    height: int,  # px
) -> np.ndarray:  # [height, width] uint8 in {0, 255}
    """Reduce a mask: a pixel is white where at least half of its area is."""
    keep = smaller_keep((mask >= 128).astype(np.float32), (height, width), "majority")
    return np.where(keep > 0, 255, 0).astype(np.uint8)


def resample(
    folder: Path,
    model: ColmapModel,
    photos: Sequence[ScreenedPhoto],
    pixels: Path,
    masks: Path | None,
    truth: Path | None,
    factor: int,
    *,
    jobs: int,
    bar: Bar,
) -> ResampleResult:
    """Write the registered photos and `sparse/0`, undistorted, with masks and truth at the size of training.

    Args:
        folder: folder of the stage, empty; gets images/, with a factor images_FACTOR/, masks/ and truth/.
        model: the chosen model.
        photos: of the capture.
        pixels: folder of the photos as structure from motion got them.
        masks: folder of `<name>.png`, or None.
        truth: the capture's truth folder, or None.
        factor: of downsampling.
        jobs: threads; each holds one photo.
        bar: progress.
    """
    by_name = {photo.name: photo for photo in photos}
    lenses: dict[int, Lens] = {}
    shared = len(model.cameras) < len(model.images)
    if shared:
        lenses = {number: make_lens(camera) for number, camera in model.cameras.items()}
    bar.start("undistorting", len(model.images))

    def one(image: ModelImage) -> tuple[ModelImage, ModelCamera, list[str]]:
        photo, name = by_name[image.name], image.name
        lens = lenses[image.camera_id] if shared else make_lens(model.cameras[image.camera_id])
        flat = lens.remap(read_png_rgb(pixels / name), nearest=False)
        write_png(folder / "images" / name, flat)
        if factor > 1:
            write_png(folder / f"images_{factor}" / name, _reduced(flat, factor))
        if masks is not None:
            mask = lens.remap(read_gray(masks / f"{name}.png"), nearest=True)
            write_png(folder / "masks" / name, _reduced(mask, factor))
        parts = _truth(folder, lens, photo, truth, factor) if truth is not None else []
        bar.step()
        return dataclasses.replace(image, xys=lens.undistort_points(image.xys)), lens.pinhole, parts

    with ThreadPoolExecutor(jobs) as pool:
        done = list(pool.map(one, model.images.values()))
    bar.finish()
    if lenses and (least := min(lens.share for lens in lenses.values())) < MAX_LOST:
        bar.say(f"undistortion leaves {least:.0%} of the photos, the middle of what the lens sees")
    cameras, images = {c.camera_id: c for _, c, _ in done}, {image.image_id: image for image, _, _ in done}
    write_model(folder / "sparse" / "0", ColmapModel(cameras, images, model.points))
    photos_with = {part: sum(part in parts for _, _, parts in done) for part in TRUTH_PARTS}
    return {"factor": factor, "truth": photos_with if truth is not None else None}


def _reduced(image: np.ndarray, factor: int) -> np.ndarray:
    """Downsample a photo [H, W, 3] or a mask [H, W] by a factor."""
    if factor == 1:
        return image
    size = downsampled_size(image.shape[1], image.shape[0], factor)
    return downsample_photo(image, *size) if image.ndim == 3 else downsample_mask(image, *size)


def _reduced_numbers(numbers: np.ndarray, factor: int) -> np.ndarray:
    """Downsample numbers of objects [H, W] by a factor: the nearest, as a mean of numbers is none."""
    size = downsampled_size(numbers.shape[1], numbers.shape[0], factor)
    return numbers if factor == 1 else cv2.resize(numbers, size, interpolation=cv2.INTER_NEAREST)


def _truth(folder: Path, lens: Lens, photo: ScreenedPhoto, truth: Path, factor: int) -> list[str]:
    """Resample the truth of one photo: the clean one like the photo, numbers by the nearest, the others
    like masks.
    """
    original = PurePosixPath(name_in_truth(photo.source)).with_suffix("")
    written = []
    for part in TRUTH_PARTS:
        path = truth / part / f"{original}.png"
        if not path.is_file():
            continue
        pixels = read_png_rgb(path) if part == "clean" else read_gray(path)
        if pixels.shape[:2] != (photo.height, photo.width):
            raise AwError(
                f"{path} is {pixels.shape[1]}x{pixels.shape[0]} but its photo "
                f"{photo.width}x{photo.height}: the truth belongs to another capture; remove truth/ "
                "or make the capture again"
            )
        flat = lens.remap(pixels, nearest=part != "clean")
        reduced = _reduced_numbers(flat, factor) if part in NUMBERED else _reduced(flat, factor)
        write_png(folder / "truth" / part / photo.name, reduced)
        written.append(part)
    return written
