"""Small copies of photos and masks that a page carries inside."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ambiguous_wild.core import View
from ambiguous_wild.io.images import read_gray, read_png_rgb

WIDTHS = (640, 480, 360, 240, 160, 96)  # px, tried from the largest
_QUALITY = 78


def photo_uris(views: Sequence[View], most_bytes: int) -> list[str]:
    """A data: address for each photo, JPEG, as wide as lets all of them stay below `most_bytes` of text."""
    import cv2

    photos = [np.ascontiguousarray(read_png_rgb(view.image_path)[:, :, ::-1]) for view in views]
    uris: list[str] = []
    for width in WIDTHS:
        small = [_narrowed(photo, width) for photo in photos]
        options = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        uris = [_uri("jpeg", bytes(cv2.imencode(".jpg", photo, options)[1])) for photo in small]
        if sum(map(len, uris)) <= most_bytes:
            break
    return uris


def mask_uris(folder: Path, views: Sequence[View], most_wide: int = 480) -> dict[str, str]:
    """A data: address for each keep map that `folder` holds, PNG with two grey levels, by view name."""
    import cv2

    found = {}
    for view in views:
        path = folder / Path(view.name).with_suffix(".png")
        if path.is_file():
            keep = _narrowed(read_gray(path), most_wide)
            black_and_white = ((keep > 127) * 255).astype(np.uint8)
            options = [cv2.IMWRITE_PNG_BILEVEL, 1]
            found[view.name] = _uri("png", bytes(cv2.imencode(".png", black_and_white, options)[1]))
    return found


def _narrowed(image: np.ndarray, width: int) -> np.ndarray:
    import cv2

    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
