"""Sheets of pictures with captions in a grid: of a capture, and of masks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NotRequired, TypedDict, TypeVar

import cv2
import numpy as np

from ambiguous_wild.core import Scene, View
from ambiguous_wild.core.names import ascii_text
from ambiguous_wild.harness.regions import exact_distractor
from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.page_parts import jpeg_bytes
from ambiguous_wild.io.palette import ADDED, MASKED, tint

Item = TypeVar("Item")
QUALITY = 90  # of JPEG
GAP, BAR = 6, 20  # px between cells; height of a caption
FONT, SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.42
NAME = "sheet.jpg"
WIDTH = 320  # px of a photo on the sheets of a capture and of masks
CAPTURE_COLUMNS, MASK_COLUMNS = 4, 5  # photos in a row
MAX_MASKS = 20  # photos on a sheet of masks


def cell(caption: str, image: np.ndarray, width: int | None = None) -> np.ndarray:
    """Draw the image [H, W, 3] uint8 under its caption, resized to `width` px if that is given.

    A caption wider than its picture is set smaller, and cut if it is still too wide.
    """
    if width is not None and image.shape[1] != width:
        size = (width, max(round(image.shape[0] * width / image.shape[1]), 1))
        smaller = width < image.shape[1]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
    frame = np.full((image.shape[0] + BAR + GAP, image.shape[1] + GAP, 3), 255, np.uint8)
    frame[BAR : BAR + image.shape[0], : image.shape[1]] = image
    text = ascii_text(caption)
    scale = min(SCALE, SCALE * (image.shape[1] - 4) / max(_width(text, SCALE), 1))
    scale = max(scale, 0.3)
    while len(text) > 1 and _width(text, scale) > image.shape[1] - 2:
        text = text[:-1]
    cv2.putText(frame, text, (2, 14), FONT, scale, (20, 20, 20), 1, cv2.LINE_AA)
    return frame


def _width(text: str, scale: float) -> int:
    return int(cv2.getTextSize(text, FONT, scale, 1)[0][0])


def stack(images: Sequence[np.ndarray], axis: int) -> np.ndarray:
    """Join images below (axis 0) or beside (axis 1) each other, padded with white to a common size."""
    other = 1 - axis
    most = max(image.shape[other] for image in images)
    padded = []
    for image in images:
        pad = [(0, 0), (0, 0), (0, 0)]
        pad[other] = (0, most - image.shape[other])
        padded.append(np.pad(image, pad, constant_values=255))
    return np.concatenate(padded, axis=axis)


def grid(cells: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Join cells row by row."""
    return stack([stack(cells[k : k + columns], 1) for k in range(0, len(cells), columns)], 0)


def evenly_spaced(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most `count` of the items, evenly spaced, with the first and the last."""
    if not items:
        return []
    index = np.unique(np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int))
    return [items[i] for i in index]


def write_jpeg(path: Path, image: np.ndarray) -> None:
    """Write [H, W, 3] uint8 RGB atomically."""
    data = jpeg_bytes(image, QUALITY)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_capture_sheet(raw: Path) -> None:
    """Write a JPEG of eight train photos, two with their truth, and four test photos.

    Args:
        raw: folder of a capture of `aw simulate`; the sheet is truth/sheet.jpg in it, where no builder takes
            it for a photo.

    Raises:
        AwError: a photo of the capture is missing.
    """
    photos = json.loads((raw / "truth" / "capture.json").read_text(encoding="utf-8"))["photos"]
    train = sorted(photos)
    test = sorted(p.name for p in (raw / "test").iterdir())
    cells = [
        cell(_caption(name, photos[name]), read_png_rgb(raw / "train" / name), WIDTH)
        for name in evenly_spaced(train, 2 * CAPTURE_COLUMNS)
    ]
    for name in evenly_spaced(train, 2):
        cells += _truth(raw, name)
    cells += [
        cell(f"test {name}", read_png_rgb(raw / "test" / name), WIDTH)
        for name in evenly_spaced(test, CAPTURE_COLUMNS)
    ]
    write_jpeg(raw / "truth" / NAME, grid(cells, CAPTURE_COLUMNS))


class PhotoFacts(TypedDict):
    """What capture.json says of a photo."""

    occlusion: float  # share of the pixels
    effects: NotRequired[dict[str, dict[str, object]]]


def _caption(name: str, photo: PhotoFacts) -> str:
    words = [f"{Path(name).stem} {100 * photo['occlusion']:.0f} %"]
    for drawn in photo.get("effects", {}).values():
        words += [f"{key} {value:.2g}" for key, value in drawn.items() if isinstance(value, float)]
    return ", ".join(words)


def _truth(raw: Path, name: str) -> list[np.ndarray]:
    stem = Path(name).stem
    mask = read_gray(raw / "truth" / "distractor" / f"{stem}.png") >= 128
    shown = tint(read_png_rgb(raw / "train" / name), mask, MASKED)
    shadow = raw / "truth" / "shadow" / f"{stem}.png"
    if shadow.is_file():
        shown = tint(shown, read_gray(shadow) >= 128, ADDED)
    return [
        cell(f"{stem} mask, shadow" if shadow.is_file() else f"{stem} mask", shown, WIDTH),
        cell(f"{stem} clean", read_png_rgb(raw / "truth" / "clean" / f"{stem}.png"), WIDTH),
    ]


def write_contact(scene: Scene, masks: Path, path: Path) -> list[Path]:
    """Write a JPEG of train photos, the masked region tinted, each with its masked share.

    Args:
        scene: the scene with the train photos.
        masks: RUN/masks, keep maps by the photo's name, white = keep.
        path: JPEG to write; it shows up to `MAX_MASKS` photos, evenly spaced among those with a mask.

    Returns:
        The path written; empty if no photo has a mask.
    """
    views = [view for view in scene.train if _mask(masks, view).is_file()]
    if not views:
        return []
    path.parent.mkdir(parents=True, exist_ok=True)
    write_jpeg(
        path, grid([_tinted(scene, view, masks) for view in evenly_spaced(views, MAX_MASKS)], MASK_COLUMNS)
    )
    return [path]


def _mask(folder: Path, view: View) -> Path:
    return folder / Path(view.name).with_suffix(".png")


def _tinted(scene: Scene, view: View, masks: Path) -> np.ndarray:
    photo, masked = read_png_rgb(view.image_path), read_gray(_mask(masks, view)) < 128
    caption = f"{view.name}: {100 * masked.mean():.0f} % masked"
    truth = exact_distractor(scene, view)
    if truth is not None:
        caption += f", {100 * truth.mean():.0f} % true"
    return cell(caption, tint(photo, masked, MASKED), WIDTH)
