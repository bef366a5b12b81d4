"""Small copies of photos and masks that a page carries inside."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ambiguous_wild.core import View
from ambiguous_wild.io.images import read_gray, read_png_rgb

WIDTHS = (640, 480, 360, 240, 160, 96, 64)  # px, tried from the largest
_QUALITY = 78
_MASK_WIDTH = 480  # px, at most


def photo_uris(views: Sequence[View], most_bytes: int) -> list[str]:
    """A data: address for each photo, JPEG, as wide as lets all of them stay below `most_bytes` of text.

    1000 photos or more can exceed it at the smallest width. One photo is held at a time.
    """
    return _as_wide_as_fits(_photo, [view.image_path for view in views], WIDTHS, most_bytes)


def mask_uris(folder: Path, views: Sequence[View], most_bytes: int) -> dict[str, str]:
    """A data: address for each keep map that `folder` holds, PNG with two grey levels, by view name.

    As wide as lets all of them stay below `most_bytes` of text.
    """
    paths = {view.name: folder / Path(view.name).with_suffix(".png") for view in views}
    found = {name: path for name, path in paths.items() if path.is_file()}
    widths = [width for width in WIDTHS if width <= _MASK_WIDTH]
    return dict(zip(found, _as_wide_as_fits(_mask, list(found.values()), widths, most_bytes)))


def _as_wide_as_fits(
    uri: Callable[[Path, int], str], paths: Sequence[Path], widths: Sequence[int], most_bytes: int
) -> list[str]:
    """The addresses at the first width at which they fit; else at the last one."""
    uris: list[str] = []
    for width in widths:
        uris, size = [], 0
        for path in paths:
            uris.append(uri(path, width))
            size += len(uris[-1])
            if size > most_bytes and width != widths[-1]:
                break
        else:
            return uris
    return uris


def _photo(path: Path, width: int) -> str:
    import cv2

    small = _narrowed(np.ascontiguousarray(read_png_rgb(path)[:, :, ::-1]), width)
    return _uri("jpeg", bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]))


def _mask(path: Path, width: int) -> str:
    import cv2

    black_and_white = ((_narrowed(read_gray(path), width) > 127) * 255).astype(np.uint8)
    options = [cv2.IMWRITE_PNG_BILEVEL, 1]
    return _uri("png", bytes(cv2.imencode(".png", black_and_white, options)[1]))


def _narrowed(image: np.ndarray, width: int) -> np.ndarray:
    import cv2

    if image.shape[1] <= width:
        return image
    height = max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}"
