"""Image decoding and encoding of `images.py` through Pillow, for machines without OpenCV.

8-bit colour, 8-bit grey and 16-bit grey give the same pixels as OpenCV (a test compares). 16-bit colour is
refused: Pillow would cut it to 8 bits. Colour read as grey may differ by one code.
"""

from __future__ import annotations

import io
import warnings
from typing import Literal

import numpy as np

from ambiguous_wild.core.errors import AwError

Kind = Literal["rgb", "grey", "deep"]  # 8-bit colour, 8-bit grey, colour at the file's own depth
_SIXTEEN = ("I;16", "I;16B", "I;16L", "I")  # Pillow's modes of 16-bit grey


def decode(
    data: bytes,
    kind: Kind,
    where: str,  # the file's name, for the message
) -> np.ndarray | None:  # [H, W, 3] or [H, W], uint8; uint16 of a deep file where `kind` is "deep"
    """The image; None where the bytes are damaged.

    Raises:
        AwError: Pillow is missing too, or `kind` is "deep" and the file 16-bit colour.
    """
    image_module = _pillow(where)
    # PNG: bit depth and colour type (2 and 6 are colour) have fixed offsets in the first chunk.
    if kind == "deep" and data.startswith(b"\x89PNG") and data[24:26] in (b"\x10\x02", b"\x10\x06"):
        raise AwError(f"{where} is 16-bit colour, which Pillow cuts to 8: python -m pip install {_OPENCV}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of its size, which the header was checked for
            picture = image_module.open(io.BytesIO(data))
            if picture.mode in _SIXTEEN:
                return _sixteen(np.asarray(picture).astype(np.uint16), kind)
            return np.array(picture.convert("L" if kind == "grey" else "RGB"))
    except (OSError, SyntaxError, ValueError, image_module.DecompressionBombError):
        return None


def encode_png(
    image: np.ndarray,  # [H, W] or [H, W, 3], uint8 or uint16, RGB
) -> bytes:
    """The image as a PNG file.

    Raises:
        AwError: Pillow is missing too, or the image is 16-bit colour.
    """
    image_module = _pillow("a PNG")
    if image.ndim == 3 and image.dtype != np.uint8:
        raise AwError(f"Pillow writes no 16-bit colour: python -m pip install {_OPENCV}")
    file = io.BytesIO()
    image_module.fromarray(np.ascontiguousarray(image)).save(file, "PNG", compress_level=1)
    return file.getvalue()


_OPENCV = "opencv-contrib-python-headless"


def _pillow(what: str):
    try:
        from PIL import Image
    except ImportError:
        raise AwError(
            f"neither OpenCV nor Pillow is installed to read or write {what}: "
            f"python -m pip install {_OPENCV}, or pillow"
        ) from None
    return Image


def _sixteen(codes: np.ndarray, kind: Kind) -> np.ndarray:
    """16-bit grey as `kind`; 8 bits are the upper byte, as in OpenCV."""
    if kind != "deep":
        codes = (codes >> 8).astype(np.uint8)
    return codes if kind == "grey" else np.repeat(codes[..., None], 3, axis=2)
