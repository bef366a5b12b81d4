"""The simulated phone's files: photos as JPEG with EXIF that states what was done."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate.spec import CaptureSpec
from ambiguous_wild.simulate.walk import focal_px

_LENS_MM = 4.2  # what the simulated phone states as its focal length without zoom
_ISO = 64
_DATE = "2025:06:14 15:{:02d}:{:02d}"


def write_png(path: Path, pixels: np.ndarray) -> None:
    """[H, W] or [H, W, 3] uint8 or uint16."""
    from PIL import Image

    Image.fromarray(pixels).save(path, compress_level=3)


def write_photo(
    path: Path, pixels: np.ndarray, spec: CaptureSpec, camera: Camera, number: int, done: dict[str, Any]
) -> None:
    """JPEG at quality 95 without chroma subsampling, with the EXIF of a phone.

    Args:
        path: to write.
        pixels: [H, W, 3] uint8.
        spec: of the capture.
        camera: of this photo: its focal length is stated.
        number: of the photo; one every four seconds.
        done: what the effects did to it (``Developed.effects``).
    """
    from PIL import Image

    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=_exif(spec, camera, number, done))


def _exif(spec: CaptureSpec, camera: Camera, number: int, done: dict[str, Any]) -> Any:
    from PIL import Image, TiffImagePlugin

    def rational(value: float) -> Any:
        return TiffImagePlugin.IFDRational(round(value * 10000), 10000)

    zoom = camera.fx / focal_px(spec)
    taken = _DATE.format(number * 4 // 60 % 60, number * 4 % 60)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "ambiguous_wild", "simulated phone"
    exif[0x0131], exif[0x0132] = f"ambiguous_wild {__version__}", taken
    fields = exif.get_ifd(0x8769)
    fields[0x829A] = _exposure(done, TiffImagePlugin.IFDRational)  # ExposureTime, s
    fields[0x829D] = rational(1.6)  # FNumber
    fields[0x8827] = round(done["iso_noise"]["iso"]) if "iso_noise" in done else _ISO
    fields[0x9003] = fields[0x9004] = taken
    fields[0x920A] = rational(_LENS_MM * zoom)
    fields[0xA402] = 0 if "exposure_drift" in done else 1  # exposure: automatic or manual
    fields[0xA403] = 0 if "white_balance" in done else 1  # white balance: automatic or manual
    fields[0xA002], fields[0xA003] = spec.width, spec.height
    per_inch = 25.4 * focal_px(spec) / _LENS_MM
    fields[0xA20E] = fields[0xA20F] = rational(per_inch)  # FocalPlaneX/YResolution
    fields[0xA210] = 2  # in inches
    fields[0xA405] = round(spec.focal_35mm * zoom)  # FocalLengthIn35mmFilm
    return exif


def _exposure(done: dict[str, Any], rational: Any) -> Any:
    """Seconds: what the blur says, else 1/250; what the automatic made brighter, it exposed longer."""
    seconds = done.get("motion_blur", {}).get("exposure_s", 1 / 250)
    seconds *= 2.0 ** done.get("exposure_drift", {}).get("stops", 0.0)
    whole = round(1 / seconds)
    if abs(1 / seconds - whole) < 1e-9 * whole:
        return rational(1, whole)
    return rational(round(seconds * 10**6), 10**6)
