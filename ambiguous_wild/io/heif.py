"""HEIC and HEIF photos, as phones make them, through libheif (extra [heic])."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from ambiguous_wild.core.extras import install_command
from ambiguous_wild.io.exif import Exif, exif_from_spec
from ambiguous_wild.io.image_header import MAX_PIXELS

# pi_heif decodes only; pillow_heif has the same calls and also an encoder under the GPL.
MODULES = ("pi_heif", "pillow_heif")
BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_CODES = {"EXIF": 34665, "GPS": 34853}
# OpenImageIO's name -> (directory, tag) of EXIF 2.32
_TAGS = {
    "Make": ("", 271),
    "Model": ("", 272),
    "DateTime": ("", 306),
    "ExposureTime": ("EXIF", 33434),
    "FNumber": ("EXIF", 33437),
    "Exif:PhotographicSensitivity": ("EXIF", 34855),
    "Exif:DateTimeOriginal": ("EXIF", 36867),
    "Exif:FocalLength": ("EXIF", 37386),
    "Exif:WhiteBalance": ("EXIF", 41987),
    "Exif:FocalLengthIn35mmFilm": ("EXIF", 41989),
    "GPS:LatitudeRef": ("GPS", 1),
    "GPS:Latitude": ("GPS", 2),
    "GPS:LongitudeRef": ("GPS", 3),
    "GPS:Longitude": ("GPS", 4),
    "GPS:AltitudeRef": ("GPS", 5),
    "GPS:Altitude": ("GPS", 6),
}


class UnreadableHeif(Exception):
    """The reason why a file cannot be used, without its name."""


def is_heif(head: bytes) -> bool:
    """Whether a file's first 16 bytes are those of HEIC or HEIF."""
    return head[4:8] == b"ftyp" and head[8:12] in BRANDS


@cache
def _module() -> ModuleType | None:
    for name in MODULES:
        try:
            return importlib.import_module(name)
        except ImportError:
            continue
    return None


def read_heif(path: Path) -> tuple[np.ndarray, Exif, list[str]]:
    """The primary picture [H, W, 3] uint8, upright, its EXIF, and notes on what was converted.

    libheif applies the file's own rotation; by the standard EXIF's orientation is then not applied again.

    Raises:
        UnreadableHeif: the decoder is not installed, or the file is damaged or too large.
    """
    module = _module()
    if module is None:
        raise UnreadableHeif(f"HEIC photos need the extra [heic]: {install_command('heic')}")
    try:
        picture = module.open_heif(str(path), convert_hdr_to_8bit=True)
        width, height = picture.size
        if width * height > MAX_PIXELS:
            raise UnreadableHeif(
                f"{width}x{height} is {width * height / 1e6:.0f} megapixels, more than the limit of "
                f"{MAX_PIXELS // 1_000_000}; reduce it"
            )
        # A copy, as libheif's memory goes with `picture`; its rows may be longer than the picture is wide.
        pixels = np.array(picture)[:, :width]
        depth = int(picture.info.get("bit_depth", 8) or 8)
        raw = picture.info.get("exif")
        others = len(picture) - 1
    except UnreadableHeif:
        raise
    except Exception as error:  # libheif's errors come as several classes
        reason = " ".join(str(error).split())[-120:] or type(error).__name__
        raise UnreadableHeif(f"damaged or cut HEIC ({reason})") from error
    notes = [f"{depth} bits reduced to 8"] if depth > 8 else []
    notes += [f"{others} more pictures in the file are left out"] if others else []
    return _as_rgb(pixels, notes), _exif(raw), notes


def _as_rgb(pixels: np.ndarray, notes: list[str]) -> np.ndarray:
    if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3):
        raise UnreadableHeif(f"pixels of type {pixels.dtype} {list(pixels.shape)} are not supported")
    grey = pixels.ndim == 2 or pixels.shape[2] == 1
    if grey:
        notes.append("grey repeated as RGB")
        return np.repeat(pixels.reshape(*pixels.shape[:2], 1), 3, axis=2)
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:].astype(np.uint16)
        opaque = int(alpha.min()) == 255
        notes.append("opaque alpha channel dropped" if opaque else "transparency composited over black")
        return (pixels[..., :3].astype(np.uint16) * alpha // 255).astype(np.uint8)
    return np.ascontiguousarray(pixels)


class _Tags:
    """EXIF of Pillow under the names of OpenImageIO."""

    def __init__(self, folders: Mapping[str, Mapping[int, Any]]) -> None:
        self.folders = folders

    def getattribute(self, name: str) -> Any:
        folder, code = _TAGS.get(name, ("", -1))
        value = self.folders[folder].get(code)
        if isinstance(value, (tuple, list)):
            return tuple(_plain(v) for v in value)
        return _plain(value)


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, (str, int, float)):
        return value
    if isinstance(value, bytes):
        return value[0] if len(value) == 1 else None
    try:
        return float(value)  # a fraction
    except (TypeError, ValueError, ZeroDivisionError):
        return None


def _exif(raw: Any) -> Exif:
    """EXIF from the file's block; damaged blocks count as absent."""
    if not isinstance(raw, bytes):
        return Exif()
    from PIL import Image

    try:
        exif = Image.Exif()
        exif.load(raw)
        folders = {"": dict(exif), **{name: dict(exif.get_ifd(code)) for name, code in _CODES.items()}}
    except Exception:  # Pillow's parser raises many kinds on damaged blocks
        return Exif()
    return exif_from_spec(_Tags(folders))
