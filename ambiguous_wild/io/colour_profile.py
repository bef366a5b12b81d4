"""Convert photos in other colours than sRGB: ICC profiles (Display P3), Adobe RGB by EXIF, PNG's gamma."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO
from typing import Any

import numpy as np

from ambiguous_wild.core.srgb import linear_to_srgb

LATTICE = np.arange(0, 256, 51).astype(np.uint8)  # codes at which a profile is compared with sRGB
SAME_CODES = 3  # largest difference of a profile that is sRGB under another name
INTEROP, R03 = 0xA005, "R03"  # EXIF's tag of interoperability, and its index for Adobe RGB (DCF 2.0)
ADOBE_GAMMA = 563 / 256
# Linear sRGB from linear Adobe RGB (1998), both with white D65.
ADOBE = np.array([[1.3983557, -0.3983557, 0.0], [0.0, 1.0, 0.0], [0.0, -0.0429290, 1.0429290]])
SRGB_GAMMA, SAME_GAMMA = 1 / 2.2, 0.02  # of PNG's chunk gAMA in sRGB files, and its tolerance


@dataclass(frozen=True)
class Colours:
    """In which colours the codes of a file are."""

    icc: bytes | None = None
    adobe: bool = False  # as EXIF says, without a profile
    gamma: float = SRGB_GAMMA  # codes are light to this power

    @property
    def name(self) -> str:
        """Name of the colours; "" for those of sRGB, and for a damaged profile."""
        if self.icc is not None:
            return _transform(self.icc)[0]
        if self.adobe:
            return "Adobe RGB (EXIF)"
        return "" if abs(self.gamma - SRGB_GAMMA) < SAME_GAMMA else f"gamma {self.gamma:.3g}"

    def to_srgb(
        self,
        pixels: np.ndarray,  # [H, W, 3] uint8 or uint16
    ) -> np.ndarray:  # [H, W, 3] uint8, sRGB
        """Convert, ICC profiles by relative colorimetry; colours that have no `name` stay."""
        if not self.name:
            return pixels
        if self.icc is not None:
            _, transform, mode = _transform(self.icc)
            small = pixels if pixels.dtype == np.uint8 else (pixels // 257).astype(np.uint8)
            if transform is None or (mode == "L" and np.ptp(small, axis=2).any()):
                return pixels  # a damaged profile, or one of grey in a photo of colours
            return _applied(transform, small, mode)
        top = np.iinfo(pixels.dtype).max
        power = ADOBE_GAMMA if self.adobe else 1 / self.gamma
        light = (np.arange(top + 1) / top) ** power  # of every code
        if not self.adobe:
            return (linear_to_srgb(light) * 255 + 0.5).astype(np.uint8)[pixels]
        result = np.empty(pixels.shape, np.uint8)
        for row, codes in enumerate(pixels):  # row by row, because floats of a whole photo are large
            result[row] = (linear_to_srgb(light[codes] @ ADOBE.T) * 255 + 0.5).astype(np.uint8)
        return result


def colours_of(image: Any) -> Colours:
    """Return the colours of an image that Pillow has opened."""
    profile = image.info.get("icc_profile")
    if isinstance(profile, bytes) and profile:
        return Colours(profile)
    # Pillow would decode all of a PNG to look for EXIF at its end.
    stated = image.format != "PNG" or "exif" in image.info
    try:
        adobe = stated and image.getexif().get_ifd(INTEROP).get(1) == R03
    except Exception:  # damaged EXIF raises many kinds
        adobe = False
    gamma = image.info.get("gamma")
    plain = "srgb" in image.info or not isinstance(gamma, float) or not 0.1 < gamma <= 1.5
    return Colours(adobe=adobe, gamma=SRGB_GAMMA if plain else gamma)


@lru_cache(maxsize=16)
def _transform(profile: bytes) -> tuple[str, Any, str]:
    """Return name, transform and mode of a profile; the name is "" where it changes nothing."""
    from PIL import ImageCms

    try:
        source = ImageCms.getOpenProfile(BytesIO(profile))
        mode = {"RGB": "RGB", "GRAY": "L"}.get(source.profile.xcolor_space.strip())
        if mode is None:
            return "", None, ""  # of CMYK pixels, which are converted without it, and said so
        intent = ImageCms.Intent.RELATIVE_COLORIMETRIC
        srgb = ImageCms.createProfile("sRGB")
        transform = ImageCms.buildTransform(source, srgb, mode, "RGB", renderingIntent=intent)
        name = ImageCms.getProfileDescription(source).strip() or "an unnamed profile"
    except (ImageCms.PyCMSError, OSError, ValueError, AttributeError):
        return "", None, ""
    codes = np.stack(np.meshgrid(LATTICE, LATTICE, LATTICE), axis=-1).reshape(-1, len(LATTICE), 3)
    codes = codes if mode == "RGB" else np.repeat(codes[..., :1], 3, axis=2)
    change = np.abs(_applied(transform, codes, mode).astype(int) - codes).max()
    return (name, transform, mode) if change > SAME_CODES else ("", None, "")


def _applied(transform: Any, pixels: np.ndarray, mode: str) -> np.ndarray:
    from PIL import Image, ImageCms

    channels = pixels if mode == "RGB" else pixels[..., 0]
    converted = ImageCms.applyTransform(Image.fromarray(np.ascontiguousarray(channels)), transform)
    return np.asarray(converted)
