"""Pixels for training and measuring, through OpenCV alone: a packaged scene needs nothing more.

Photos as people take them (EXIF, CMYK, cut files) are the business of `io/photos.py`.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.io.image_header import MAX_PIXELS, READ, header_size


def read_png_rgb(
    path: Path | str,
) -> np.ndarray:  # [H, W, 3] uint8, sRGB
    """Read an image file as 8-bit RGB; grey is repeated, alpha dropped, 16 bits rounded to 8.

    Raises:
        AwError: the file is missing or does not decode.
    """
    return _decode(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)


def read_gray(
    path: Path | str,
) -> np.ndarray:  # [H, W] uint8
    """Read a mask or any single-channel image as 8 bits.

    Raises:
        AwError: the file is missing or does not decode.
    """
    return _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)


def load_image_float(
    path: Path | str,
) -> np.ndarray:  # [H, W, 3] float32 in [0, 1], sRGB
    """Read an image as float32; 16-bit files keep their precision.

    Raises:
        AwError: the file is missing or does not decode.
    """
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    image = _decode(path, flags)
    if image.dtype == np.uint8:
        return image.astype(np.float32) / np.float32(255)
    if image.dtype == np.uint16:
        return image.astype(np.float32) / np.float32(65535)
    if image.dtype == np.float32:
        return image
    raise AwError(f"{path}: pixels of type {image.dtype} are not read; save it as an 8 or 16-bit PNG")


def read_keep_map(
    path: Path | str,
) -> np.ndarray:  # [H, W] float32 in {0, 1}, 1 = static
    """Read a keep mask: white (128 and above) is kept.

    Raises:
        AwError: the file is missing or does not decode.
    """
    return (read_gray(path) >= 128).astype(np.float32)


def image_size(path: Path | str) -> tuple[int, int]:
    """(width, height) in px; of a PNG from its header alone, of anything else by decoding.

    Raises:
        AwError: the file is missing or does not decode.
    """
    try:
        with open(path, "rb") as f:
            head = f.read(24)
    except OSError as error:
        raise AwError(f"cannot read image {path}: {error.strerror}") from error
    if head.startswith(b"\x89PNG") and (size := header_size(head)) is not None:
        return size
    height, width = _decode(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION).shape
    return width, height


def write_png(
    path: Path | str,
    image: np.ndarray,  # [H, W] or [H, W, 3], uint8 (uint16 allowed), RGB
) -> None:
    """Write a PNG atomically; the same pixels give the same bytes.

    Raises:
        AwError: shape or type that a PNG of ours does not hold.
    """
    if image.dtype not in (np.uint8, np.uint16) or image.size == 0:
        raise AwError(f"{path}: a PNG takes uint8 or uint16 pixels, got {image.dtype} {list(image.shape)}")
    if image.ndim == 3 and image.shape[2] == 3:
        pixels = image[:, :, ::-1]
    elif image.ndim == 2:
        pixels = image
    else:
        raise AwError(f"{path}: a PNG of ours is [H, W] or [H, W, 3], got {list(image.shape)}")
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise AwError(f"{path}: OpenCV could not encode {list(image.shape)} {image.dtype} as PNG")
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.tobytes())


def decode(
    data: np.ndarray,  # [bytes] uint8
    flags: int,  # of cv2.imdecode
    where: str,  # the file's name, for the message
) -> np.ndarray | None:
    """What `cv2.imdecode` makes of the bytes, None where they are damaged; nothing is allocated for a lie.

    Raises:
        AwError: the header announces more pixels than are read.
    """
    size = header_size(data.tobytes())
    if size is None:  # of no kind that is read: OpenCV has decoders for a dozen more, none of them needed
        return None
    if size[0] * size[1] > MAX_PIXELS:
        raise AwError(
            f"{where} announces {size[0]}x{size[1]} px, more than the {MAX_PIXELS // 1_000_000} megapixels "
            "that are read; reduce it"
        )
    try:
        return cv2.imdecode(data, flags)
    except cv2.error:
        return None


def _decode(path: Path | str, flags: int) -> np.ndarray:
    # Through bytes rather than cv2.imread: non-ASCII names on every platform, and a reason that is ours.
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise AwError(f"cannot read image {path}: {error.strerror}") from error
    image = decode(data, flags, str(path))
    if image is None:
        raise AwError(
            f"cannot read image {path}: it is empty, cut short or no {READ}; restore it and try again"
        )
    return image
