"""Images for the page: limited in size, encoded alike, without metadata."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import read_gray, read_png_rgb

OUTLINE = (255, 220, 0)  # sRGB; drawn over a black edge, to be visible on any background


def data_uri(
    image: np.ndarray,  # [H, W, 3] uint8
    *,
    side: int,  # px, most of the longer side
    quality: int,  # of JPEG
) -> str:
    """The image as a JPEG data URI, encoded from pixels, so without EXIF or file name."""
    longest = max(image.shape[:2])
    if longest > side:
        size = tuple(max(1, round(n * side / longest)) for n in image.shape[1::-1])
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    # 4:4:4, since chroma subsampling would blur details that raters compare.
    settings = [cv2.IMWRITE_JPEG_QUALITY, quality,
                cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]  # fmt: skip
    done, data = cv2.imencode(".jpg", image[:, :, ::-1], settings)
    if not done:
        raise AwError(f"OpenCV could not encode an image of {list(image.shape)} as JPEG")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def outlined(photo: Path, mask: Path) -> np.ndarray:  # [H, W, 3] uint8
    """The photo with the distractor's outline."""
    image = read_png_rgb(photo).copy()
    height, width = image.shape[:2]
    inside = cv2.resize(read_gray(mask), (width, height), interpolation=cv2.INTER_NEAREST) >= 128
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    thick = max(2, round(max(height, width) / 300))
    cv2.drawContours(image, contours, -1, (0, 0, 0), 2 * thick)
    cv2.drawContours(image, contours, -1, OUTLINE, thick)
    return image


def same_size(paths: tuple[Path, ...]) -> list[np.ndarray]:
    """The images of one question; their sizes must be equal, or size would reveal the method.

    Raises:
        AwError: unreadable, or of different sizes.
    """
    images = [read_png_rgb(p) for p in paths]
    sizes = {f"{i.shape[1]}x{i.shape[0]}" for i in images}
    if len(sizes) > 1:
        listed = ", ".join(f"{p} ({i.shape[1]}x{i.shape[0]})" for p, i in zip(paths, images))
        raise AwError(
            f"images of one question differ in size: {listed}; run all methods with the same --factor"
        )
    return images
