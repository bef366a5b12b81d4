"""Pictures in a grid with a caption above each: strips, sheets, contact sheets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.io.atomic import atomic_path

GAP, BAR = 6, 20  # px between cells; height of a caption
FONT, SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.42


def cell(caption: str, image: np.ndarray, width: int | None = None) -> np.ndarray:
    """The image [H, W, 3] uint8 under its caption, at another width where one is given.

    A caption that is wider than its picture is set smaller, and cut where even that does not do.
    """
    if width is not None and image.shape[1] != width:
        size = (width, max(round(image.shape[0] * width / image.shape[1]), 1))
        smaller = width < image.shape[1]
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_NEAREST)
    frame = np.full((image.shape[0] + BAR + GAP, image.shape[1] + GAP, 3), 255, np.uint8)
    frame[BAR : BAR + image.shape[0], : image.shape[1]] = image
    # OpenCV's fonts are ASCII; anything else would be drawn as question marks
    text = caption.encode("ascii", "replace").decode()
    scale = min(SCALE, SCALE * (image.shape[1] - 4) / max(_width(text, SCALE), 1))
    scale = max(scale, 0.3)
    while len(text) > 1 and _width(text, scale) > image.shape[1] - 2:
        text = text[:-1]
    cv2.putText(frame, text, (2, 14), FONT, scale, (20, 20, 20), 1, cv2.LINE_AA)
    return frame


def _width(text: str, scale: float) -> int:
    return int(cv2.getTextSize(text, FONT, scale, 1)[0][0])


def stack(images: Sequence[np.ndarray], axis: int) -> np.ndarray:
    """Images below (axis 0) or beside (axis 1) each other, padded with white to a common size."""
    other = 1 - axis
    most = max(image.shape[other] for image in images)
    padded = []
    for image in images:
        pad = [(0, 0), (0, 0), (0, 0)]
        pad[other] = (0, most - image.shape[other])
        padded.append(np.pad(image, pad, constant_values=255))
    return np.concatenate(padded, axis=axis)


def write_jpeg(path: Path, image: np.ndarray, quality: int = 90) -> None:
    """Write [H, W, 3] uint8 RGB atomically."""
    done, data = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise OSError(f"{path}: the picture could not be encoded")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())
