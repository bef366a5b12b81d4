"""Photos of captures: JPEG, with EXIF of the simulated exposure or of the source photo."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild import __version__
from ambiguous_wild.core.camera import Camera
from ambiguous_wild.io.photos import Exif
from ambiguous_wild.simulate.camera_path import focal_px
from ambiguous_wild.simulate.records import DrawnEffects
from ambiguous_wild.simulate.spec import CaptureSpec

_LENS_MM = 4.2  # focal length without zoom
_ISO = 64
_DATE = "2025:06:14 15:{:02d}:{:02d}"


def write_png(path: Path, pixels: np.ndarray) -> None:
    """[H, W] or [H, W, 3] uint8 or uint16."""
    from PIL import Image

    Image.fromarray(pixels).save(path, compress_level=3)


def write_photo(
    path: Path, pixels: np.ndarray, spec: CaptureSpec, camera: Camera, number: int, drawn: DrawnEffects
) -> None:
    """JPEG at quality 95 without chroma subsampling, with the EXIF of a phone.

    Args:
        path: the file.
        pixels: [H, W, 3] uint8.
        spec: of the capture.
        camera: of this photo; gives the focal length.
        number: of the photo; gives the time, one photo every four seconds.
        drawn: of this photo; gives exposure, ISO and white balance.
    """
    from PIL import Image

    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=_exif(spec, camera, number, drawn))


def _exif(spec: CaptureSpec, camera: Camera, number: int, drawn: DrawnEffects) -> Any:
    from PIL import Image, TiffImagePlugin

    def rational(value: float) -> Any:
        return TiffImagePlugin.IFDRational(round(value * 10000), 10000)

    zoom = camera.fx / focal_px(spec)
    taken = _DATE.format(number * 4 // 60 % 60, number * 4 % 60)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "ambiguous_wild", "simulated phone"
    exif[0x0131], exif[0x0132] = f"ambiguous_wild {__version__}", taken
    fields = exif.get_ifd(0x8769)
    fields[0x829A] = _exposure(drawn, TiffImagePlugin.IFDRational)  # ExposureTime, s
    fields[0x829D] = rational(1.6)  # FNumber
    fields[0x8827] = round(drawn["iso_noise"]["iso"]) if "iso_noise" in drawn else _ISO
    fields[0x9003] = fields[0x9004] = taken
    fields[0x920A] = rational(_LENS_MM * zoom)
    fields[0xA402] = 0 if "exposure_drift" in drawn else 1  # exposure: automatic or manual
    fields[0xA403] = 0 if "white_balance" in drawn else 1  # white balance: automatic or manual
    fields[0xA002], fields[0xA003] = spec.width, spec.height
    per_inch = 25.4 * focal_px(spec) / _LENS_MM
    fields[0xA20E] = fields[0xA20F] = rational(per_inch)  # FocalPlaneX/YResolution
    fields[0xA210] = 2  # in inches
    fields[0xA405] = round(spec.focal_35mm * zoom)  # FocalLengthIn35mmFilm
    return exif


def _exposure(drawn: DrawnEffects, rational: Any) -> Any:
    """Exposure time, s: that of the motion blur, else 1/250; longer by the stops of the exposure drift."""
    blur, drift = drawn.get("motion_blur"), drawn.get("exposure_drift")
    seconds = 1 / 250 if blur is None else blur["exposure_s"]
    seconds *= 2.0 ** (0.0 if drift is None else drift["stops"])
    whole = round(1 / seconds)
    if abs(1 / seconds - whole) < 1e-9 * whole:
        return rational(1, whole)
    return rational(round(seconds * 10**6), 10**6)


def write_jpeg(path: Path, pixels: np.ndarray, exif: Exif) -> None:
    """JPEG at quality 95 without chroma subsampling, with the camera settings of a source photo.

    Args:
        path: the file.
        pixels: [H, W, 3] uint8, upright.
        exif: of the source photo; its orientation and position are left out.
    """
    from PIL import Image, TiffImagePlugin

    def rational(value: float) -> Any:
        fraction = Fraction(value).limit_denominator(100_000)
        return TiffImagePlugin.IFDRational(fraction.numerator, fraction.denominator)

    tags = Image.Exif()
    fields = tags.get_ifd(0x8769)
    texts = {0x010F: exif.make, 0x0110: exif.model, 0x0132: exif.taken_at}
    tags.update({tag: value for tag, value in texts.items() if value is not None})
    rationals = {0x829A: exif.exposure_s, 0x829D: exif.f_number, 0x920A: exif.focal_mm}
    whole = {0x8827: exif.iso, 0xA403: exif.white_balance, 0xA405: exif.focal_35mm}
    fields.update({tag: rational(value) for tag, value in rationals.items() if value is not None})
    fields.update({tag: round(value) for tag, value in whole.items() if value is not None})
    if exif.taken_at is not None:
        fields[0x9003] = exif.taken_at
    Image.fromarray(pixels).save(path, quality=95, subsampling=0, exif=tags)
