"""Convert photos with an ICC profile, as of phones (Display P3) and cameras (Adobe RGB), to sRGB."""

from __future__ import annotations

from functools import lru_cache
from io import BytesIO
from typing import Any

import numpy as np

LATTICE = np.arange(0, 256, 51).astype(np.uint8)  # codes at which a profile is compared with sRGB
SAME_CODES = 3  # largest difference of a profile that is sRGB under another name
DAMAGED = "a profile that cannot be read"


def profile_name(profile: bytes | None) -> str:
    """Return the name of a profile whose colours are not those of sRGB; "" for sRGB and without a profile."""
    return "" if profile is None else _transform(profile)[0]


def to_srgb(
    pixels: np.ndarray,  # [H, W, 3] uint8, in the profile's colours
    profile: bytes | None,
) -> np.ndarray:  # [H, W, 3] uint8, sRGB
    """Convert by relative colorimetry; unchanged where `profile_name` is empty or the profile is damaged."""
    name, transform = ("", None) if profile is None else _transform(profile)
    return _applied(transform, pixels) if name and transform is not None else pixels


@lru_cache(maxsize=16)
def _transform(profile: bytes) -> tuple[str, Any]:
    from PIL import ImageCms

    try:
        source = ImageCms.getOpenProfile(BytesIO(profile))
        if source.profile.xcolor_space.strip() != "RGB":
            return "", None  # of grey or CMYK pixels, which are converted without it
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        srgb = ImageCms.createProfile("sRGB")
        transform = ImageCms.buildTransform(source, srgb, "RGB", "RGB", renderingIntent=intent)
        name = ImageCms.getProfileDescription(source).strip() or "an unnamed profile"
    except (ImageCms.PyCMSError, OSError, ValueError, AttributeError):
        return DAMAGED, None
    codes = np.stack(np.meshgrid(LATTICE, LATTICE, LATTICE), axis=-1).reshape(-1, len(LATTICE), 3)
    change = np.abs(_applied(transform, codes).astype(int) - codes).max()
    return (name, transform) if change > SAME_CODES else ("", None)


def _applied(transform: Any, pixels: np.ndarray) -> np.ndarray:
    from PIL import Image, ImageCms

    converted = ImageCms.applyTransform(Image.fromarray(np.ascontiguousarray(pixels)), transform)
    return np.asarray(converted)
