"""Read and write the images of a scene through OpenCV, which is imported with the first image.

For photos of any kind (EXIF, CMYK, damaged files) see `io/photos.py`.
"""

from __future__ import annotations

import functools
import importlib.metadata
import warnings
from io import BytesIO
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.colour_profile import Colours, colours_of
from ambiguous_wild.io.files import write_bytes

# Above the largest sensors in use (108 Mpx phones, 102 Mpx cameras).
MAX_PIXELS = 120_000_000
OPENCV = "opencv-contrib-python-headless"
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
_WHITE = 192  # least grey of a mask that keeps all
_SLACK = {"JPEG": 8}  # tolerance of black and white; 2 in lossless formats


def read_png_rgb(
    path: Path | str,
) -> np.ndarray:  # [H, W, 3] uint8, sRGB
    """Read an image file as 8-bit RGB; grey is repeated, alpha dropped, 16 bits rounded to 8.

    Colours of an ICC profile become sRGB, here and in the functions below.

    Raises:
        AwError: the file is missing or does not decode.
    """
    return _decode(path, "rgb")


def read_gray(
    path: Path | str,
) -> np.ndarray:  # [H, W] uint8
    """Read a mask or any single-channel image as 8 bits.

    Raises:
        AwError: the file is missing or does not decode.
    """
    return _decode(path, "grey")


def load_image_float(
    path: Path | str,
) -> np.ndarray:  # [H, W, 3] float32 in [0, 1], sRGB
    """Read an image as float32; 16-bit files keep their precision.

    Raises:
        AwError: the file is missing or does not decode.
    """
    return as_float(load_image_codes(path))


def load_image_codes(
    path: Path | str,
) -> np.ndarray:  # [H, W, 3] sRGB, uint8 or uint16 codes, or float32 in [0, 1], as in the file
    """Read an image at the file's depth, or 8 bits if it has a profile; `as_float` converts it for training.

    Raises:
        AwError: the file is missing or does not decode, or its pixels are of another type.
    """
    image = _decode(path, "deep")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise AwError(
            f"{path}: pixels of type {image.dtype} are not supported; save it as an 8 or 16-bit PNG"
        )
    return image


def as_float(codes: np.ndarray) -> np.ndarray:
    """Convert codes of `load_image_codes` to float32 in [0, 1]."""
    if codes.dtype == np.float32:
        return codes
    return codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Convert [H, W, 3] floats to 8 bits, clipped to [0, 1] and rounded to nearest."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)


def read_keep_map(
    path: Path | str,
) -> np.ndarray:  # [H, W] float32 in {0, 1}, 1 = static
    """Read a keep mask, see `read_mask`.

    Raises:
        AwError: the file is missing or does not decode, or is no mask.
    """
    return (read_mask(path) > 0).astype(np.float32)


def read_mask(
    path: Path | str,
) -> np.ndarray:  # [H, W] uint8 in {0, 255}
    """Read a mask of black and white, perhaps with the grey edges of smoothing and JPEG, or of 0 and 1.

    Alpha is the mask where it varies and the colours are not another mask; else it is left out.

    Raises:
        AwError: the file does not decode, or holds other values: a label map, a photo.
    """
    image = _decode(path, "whole")
    if image.dtype == np.float32 and np.isfinite(image).all():
        image = np.clip(image * (255 if image.max(initial=0) <= 1 else 1), 0, 255).astype(np.uint8)
    if image.dtype == np.uint16:
        image = (image // 257 if image.max(initial=0) > 255 else image).astype(np.uint8)
    if image.dtype != np.uint8:
        raise AwError(f"{path}: pixels of type {image.dtype} are no mask; save it as an 8-bit PNG")
    colour = image[..., :3] if image.ndim == 3 else image[..., None]
    grey = colour[..., 0]
    alike = bool((np.ptp(colour, axis=2) <= _SLACK["JPEG"]).all())
    shown = _black_and_white(grey, _SLACK.get(_form(path), 2)) if alike else None
    alpha = _varying_alpha(image)
    if alpha is not None and not alpha.any() and shown is not None and shown.any() and not shown.all():
        alpha = None  # written by tools that leave alpha at 0
    if alpha is not None:
        if shown is None or shown.min() == shown.max() or np.array_equal(shown, alpha):
            return alpha
        raise AwError(f"{path}: its colours and its alpha are two different masks; save the right one alone")
    if shown is None:
        values, counts = np.unique(
            grey.ravel() if alike else colour.reshape(-1, 3), axis=0, return_counts=True
        )
        most = [
            (values[k].tolist(), 100 * counts[k] / counts.sum())
            for k in np.argsort(-counts, kind="stable")[:5]
        ]
        shares = ", ".join(f"{value} ({share:.2g} %)" for value, share in most)
        raise AwError(
            f"{path} is no mask of black and white, or of 0 and 1: it holds {len(values)} values, {shares}; "
            "write 255 where the photo is kept and 0 elsewhere, or leave the masks out"
        )
    return shown


def _black_and_white(grey: np.ndarray, slack: int) -> np.ndarray | None:
    """Convert [H, W] uint8 to {0, 255}; None if it holds more than black, white and edges between them."""
    import cv2

    top = grey.max(initial=0)
    if top <= 1:
        return grey * np.uint8(255)
    # A single light grey stands for white; without black beside it, it must be lighter.
    if top >= 128 and (top >= _WHITE or grey.min() <= slack) and not ((grey > slack) & (grey < top)).any():
        return np.where(grey == top, 255, 0).astype(np.uint8)
    between = (grey > slack) & (grey < 255 - slack)
    # The grey of edges is thin and uneven; labels are areas of one value.
    ring = np.ones((3, 3), np.uint8)
    areas = between & (cv2.erode(grey, ring) == cv2.dilate(grey, ring))
    if top < 255 - slack or between.mean() > 0.5 or areas.mean() > 0.001:
        return None
    return np.where(grey >= 128, 255, 0).astype(np.uint8)


def _varying_alpha(image: np.ndarray) -> np.ndarray | None:
    if image.ndim != 3 or image.shape[2] != 4:
        return None
    kept = np.where(image[..., 3] >= 128, 255, 0).astype(np.uint8)
    return None if kept.all() else kept


def read_alpha(
    path: Path | str,
) -> np.ndarray | None:  # [H, W] uint8 in {0, 255}
    """Read a photo's alpha as a keep mask; None without alpha, or where it is opaque everywhere.

    Raises:
        AwError: the file is missing or does not decode.
    """
    try:
        with pillow().open(path, formats=_FORMATS) as image:
            if "A" not in image.getbands() and "transparency" not in image.info:
                return None
    except Exception:  # as in `header_size`; reading the pixels reports what is wrong
        return None
    pixels = _decode(path, "whole")
    return _varying_alpha(pixels // 257 if pixels.dtype == np.uint16 else pixels)


def _form(path: Path | str) -> str:
    with open(path, "rb") as f:
        return "JPEG" if f.read(2) == b"\xff\xd8" else ""


def image_size(path: Path | str) -> tuple[int, int]:
    """Return (width, height) in px; of a PNG from the header, of other formats by decoding.

    Raises:
        AwError: the file is missing or does not decode.
    """
    if Path(path).suffix.lower() == ".png" and (size := header_size(path)) is not None:
        return size
    height, width = _decode(path, "grey").shape
    return width, height


def header_size(source: Path | str | bytes) -> tuple[int, int] | None:
    """Return (width, height) in px from the header of a file or its bytes; None if it is absent or no image.

    A decoder allocates as much as the header says, so the size is checked first.
    """
    opened = BytesIO(source) if isinstance(source, bytes) else source
    try:
        with pillow().open(opened, formats=_FORMATS) as image:
            return image.size
    except Exception:  # Pillow's parsers raise many kinds on damaged headers
        return None


def orientation(path: Path | str) -> int:
    """Return the EXIF orientation of a photo, 1 to 8; 1 = as stored, also where it is absent or invalid."""
    try:
        with pillow().open(path, formats=_FORMATS) as image:
            value = image.getexif().get(0x0112, 1)
    except Exception:  # as in `header_size`
        return 1
    return value if value in range(1, 9) else 1


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """Apply EXIF orientation 1..8 (EXIF 2.32, tag 274)."""
    if orientation in (5, 6, 7, 8):
        image = image.swapaxes(0, 1)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return image


@functools.cache
def pillow() -> Any:
    """Return Pillow's Image without its limit of pixels: `MAX_PIXELS` is checked before decoding."""
    from PIL import Image

    Image.MAX_IMAGE_PIXELS = None
    warnings.filterwarnings("ignore", module=r"PIL\.")  # about damaged headers: our errors say it in one line
    return Image


def ximgproc() -> Any:
    """Return OpenCV's extended image processing.

    Raises:
        AwError: another OpenCV package has replaced the one that has it.
    """
    import cv2

    if hasattr(cv2, "ximgproc") and hasattr(cv2.ximgproc, "guidedFilter"):
        return cv2.ximgproc
    installed = {d.metadata["Name"] for d in importlib.metadata.distributions()}
    others = sorted(name for name in installed if name and name.startswith("opencv-") and name != OPENCV)
    removed = f"pip uninstall -y {' '.join(others)} && " if others else ""
    cause = f", as {' and '.join(others)} overwrote it" if others else ""
    raise AwError(
        f"this OpenCV has no ximgproc{cause}: {removed}pip install --force-reinstall --no-deps {OPENCV}"
    )


def write_png(
    path: Path | str,
    image: np.ndarray,  # [H, W] or [H, W, 3], uint8 (uint16 allowed), RGB
    compressed: bool = True,
) -> None:
    """Write a PNG atomically; the same pixels give the same bytes.

    A file that is soon written again takes a third of the time if it is not compressed.

    Raises:
        AwError: another shape or type.
    """
    if image.dtype not in (np.uint8, np.uint16) or image.size == 0:
        raise AwError(f"{path}: a PNG takes uint8 or uint16 pixels, got {image.dtype} {list(image.shape)}")
    if image.ndim != 2 and not (image.ndim == 3 and image.shape[2] == 3):
        raise AwError(f"{path}: a PNG takes [H, W] or [H, W, 3], got {list(image.shape)}")
    import cv2

    pixels = image[:, :, ::-1] if image.ndim == 3 else image
    # One filter for all rows is faster than choosing it by row, and the file is about as small.
    row_filter = cv2.IMWRITE_PNG_FILTER_PAETH if compressed else cv2.IMWRITE_PNG_FILTER_NONE
    options = [cv2.IMWRITE_PNG_COMPRESSION, int(compressed), cv2.IMWRITE_PNG_FILTER, row_filter]
    done, data = cv2.imencode(".png", np.ascontiguousarray(pixels), options)
    if not done:
        raise AwError(f"{path}: OpenCV could not encode {list(image.shape)} {image.dtype} as PNG")
    write_bytes(path, [data.tobytes()])


def decode(
    data: np.ndarray,  # [bytes] uint8
    flags: int,  # of cv2.imdecode
    where: str,  # the file's name, for the message
) -> np.ndarray | None:
    """Decode with `cv2.imdecode`; None where the bytes are damaged. The header's size is checked first.

    Raises:
        AwError: the header announces too many pixels.
    """
    import cv2

    size = header_size(data.tobytes())
    if size is None:  # OpenCV decodes a dozen more formats, which are not needed
        return None
    if size[0] * size[1] > MAX_PIXELS:
        raise AwError(
            f"{where} announces {size[0]}x{size[1]} px, more than the limit of {MAX_PIXELS // 1_000_000} "
            "megapixels; reduce it"
        )
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the caller's error is one line
    try:
        return cv2.imdecode(data, flags)
    except cv2.error:
        return None


def _decode(
    path: Path | str,
    # 8-bit colour, 8-bit grey, colour at the file's depth, all channels at the file's depth
    kind: Literal["rgb", "grey", "deep", "whole"],
) -> np.ndarray:
    import cv2

    # cv2.imread cannot open non-ASCII names on every platform, and does not say why a file is not read.
    try:
        data = np.fromfile(path, dtype=np.uint8)
    except OSError as error:
        raise AwError(f"cannot read image {path}: {error.strerror}") from error
    flags = {
        "rgb": cv2.IMREAD_COLOR_RGB,
        "grey": cv2.IMREAD_GRAYSCALE,
        "deep": cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH,
        "whole": cv2.IMREAD_UNCHANGED,
    }
    image = decode(data, flags[kind] | cv2.IMREAD_IGNORE_ORIENTATION, str(path))
    if image is None:
        raise AwError(
            f"cannot read image {path}: it is empty, cut short or no PNG, JPEG, "
            "TIFF, BMP or WebP; restore it and try again"
        )
    if kind in ("rgb", "deep") and image.dtype in (np.uint8, np.uint16):
        colours = file_colours(data.tobytes())
        if colours.name and kind == "rgb" and _is_deep(data):
            deep = decode(data, flags["deep"] | cv2.IMREAD_IGNORE_ORIENTATION, str(path))
            image = image if deep is None else deep
        image = colours.to_srgb(image) if colours.name else image
    return image


def file_colours(source: Path | str | bytes) -> Colours:
    """Return in which colours the codes of an image file are; those of sRGB where it cannot be opened."""
    opened = BytesIO(source) if isinstance(source, bytes) else source
    try:
        with pillow().open(opened, formats=_FORMATS) as image:
            return colours_of(image)
    except Exception:  # as in `header_size`
        return Colours()


def _is_deep(data: np.ndarray) -> bool:
    """Whether a PNG has 16 bits, whose dark codes a conversion needs."""
    return bytes(data[:4]) == b"\x89PNG" and len(data) > 24 and int(data[24]) == 16
