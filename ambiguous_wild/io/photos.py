"""Read the photos of a capture, of any format and orientation, through OpenImageIO.

The result is upright 8-bit RGB, with the EXIF values that structure from motion and capture checks use; a
photo that cannot be read is refused with the reason.
"""

from __future__ import annotations

import contextlib
import importlib
import math
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Rational
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core.errors import AwError, install_command
from ambiguous_wild.io.colmap_records import SPLIT_PANORAMAS
from ambiguous_wild.io.colour_profile import Colours, colours_of
from ambiguous_wild.io.images import MAX_PIXELS, file_colours, pillow, upright

PHOTO_SUFFIXES = (
    ".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".webp", ".jp2", ".heic", ".heif",
    ".hif", ".avif", ".dng",
)  # fmt: skip
UNREAD_SUFFIXES = (  # of pictures that are not read, most of them raw
    ".3fr", ".arw", ".cr2", ".cr3", ".erf", ".exr", ".gif", ".hdr", ".insp", ".jxl", ".mef", ".nef", ".nrw",
    ".orf", ".pef", ".pgm", ".ppm", ".psd", ".raf", ".raw", ".rw2", ".srw", ".tga", ".x3f",
)  # fmt: skip
TRANSPARENT = "transparency composited over black"  # its alpha may be a keep mask, see `images.read_alpha`
GREY = "grey repeated as RGB"
FROM_PROFILE = "colours converted to sRGB from"
Named = Callable[[str], Any]  # OpenImageIO's name of a value -> the value; None if it is absent
MIN_SIDE = 16  # px; smaller photos have no features

_NO_REASON = "OpenImageIO gives no reason"
_HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
_FORMAT_OF_SUFFIX = {
    ".jpg": "jpeg", ".jpe": "jpeg", ".jfif": "jpeg", ".tif": "tiff", ".jp2": "jpeg2000", ".heif": "heic",
    ".hif": "heic",
}  # fmt: skip


@dataclass(frozen=True)
class Exif:
    """Camera settings of one photo; None = not recorded."""

    make: str | None = None
    model: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None  # mm, 35 mm equivalent
    exposure_s: float | None = None
    f_number: float | None = None
    iso: float | None = None
    white_balance: int | None = None  # EXIF: 0 automatic, 1 manual
    orientation: int = 1  # EXIF 1..8; 1 = as stored
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    taken_at: str | None = None  # "YYYY:MM:DD HH:MM:SS", camera's clock

    @property
    def camera(self) -> str | None:
        """Make and model, joined."""
        parts = [p for p in (self.make, self.model) if p]
        return " ".join(parts) or None


class UnreadablePhoto(AwError):
    """A photo that cannot be used; `reason` is the message without the name."""

    def __init__(self, path: Path | str, reason: str) -> None:
        super().__init__(f"{path}: {reason}")
        self.reason = reason


@dataclass(frozen=True)
class Photo:
    """One photo file, upright."""

    path: Path
    format: str  # by content: "jpeg", "png", ...
    width: int  # px, after EXIF orientation
    height: int  # px, after EXIF orientation
    exif: Exif
    plain: bool  # 8-bit upright RGB with the right suffix: other tools read the same pixels
    notes: tuple[str, ...]  # what was converted, e.g. "16 bits reduced to 8"
    sphere: bool = False  # a 360 degree photo, as its metadata say
    orientation: int = 1  # EXIF orientation that was applied to the pixels in the file; 1 = none


def read_photo(
    path: Path | str,
    *,
    panoramas: bool = False,  # also read 360 degree photos
) -> tuple[Photo, np.ndarray]:  # pixels [H, W, 3] uint8, sRGB, upright
    """Read a photo as upright 8-bit RGB; converts 16 bits, grey, CMYK and alpha.

    Raises:
        UnreadablePhoto: empty, cut short, no image, too large or too small, with the reason.
    """
    import OpenImageIO as oiio

    source = Path(path)
    form = _sniff(source)
    if form in ("heic", "avif"):
        return _read_by_pillow(source, form)
    _check_whole(source, form)
    reader = oiio.ImageInput.open(str(source))
    if reader is None:
        raise UnreadablePhoto(source, f"damaged {form} ({_one_line(oiio.geterror()) or _NO_REASON})")
    try:
        spec = reader.spec()
        _check_size(source, spec.width, spec.height)
        sphere = spec.getattribute("GPano:ProjectionType") == "equirectangular"
        if sphere and not panoramas:
            raise UnreadablePhoto(source, f"a 360 degree photo; {SPLIT_PANORAMAS}")
        if str(spec.format) not in ("uint8", "uint16"):
            raise UnreadablePhoto(
                source, f"pixels of type {spec.format} are not supported; export 8 or 16 bits"
            )
        pixels = reader.read_image(0, 0, 0, spec.nchannels, "uint8")
        error = reader.geterror()
    finally:
        reader.close()
    if pixels is None or error:
        raise UnreadablePhoto(source, f"damaged or cut {form} ({_one_line(error) or _NO_REASON})")
    rgb, notes = _to_rgb(source, np.asarray(pixels), spec)
    rgb = _in_srgb(rgb, file_colours(source), notes)
    exif = read_exif(spec.getattribute)
    if exif.orientation != 1:
        notes.append(f"turned upright (EXIF orientation {exif.orientation})")
        rgb = upright(rgb, exif.orientation)
    notes += _misnamed(source, form)
    height, width = rgb.shape[:2]
    plain = not notes and form in ("jpeg", "png")
    photo = Photo(source, form, width, height, exif, plain, tuple(notes), sphere, exif.orientation)
    return photo, np.ascontiguousarray(rgb)


def is_photo(path: Path) -> bool:
    """Whether a file is taken for a photo: by its suffix, or without one as a JPEG."""
    suffix = path.suffix.lower()
    if suffix:
        return suffix in PHOTO_SUFFIXES
    try:
        with open(path, "rb") as f:
            return f.read(3) == b"\xff\xd8\xff"
    except OSError:
        return False


def _read_by_pillow(source: Path, form: str) -> tuple[Photo, np.ndarray]:
    """Read HEIC and HEIF photos through libheif (extra [heic]), a plugin of Pillow, and AVIF by Pillow.

    libheif applies the rotation in the file, so by the standard EXIF's orientation is not applied again;
    Pillow writes AVIF's rotation into it.
    """
    if form == "heic" and not _register_heif():
        raise UnreadablePhoto(source, f"HEIC photos need the extra [heic]: {install_command('heic')}")
    try:
        with pillow().open(source, formats=("AVIF" if form == "avif" else "HEIF",)) as picture:
            width, height = picture.size
            _check_size(source, width, height)
            depth, others = int(picture.info.get("bit_depth") or 8), getattr(picture, "n_frames", 1) - 1
            notes = [f"{depth} bits reduced to 8"] if depth > 8 else []
            notes += [f"{others} more pictures in the file are left out"] if others else []
            names = tuple(picture.getbands())
            pixels = np.array(picture).reshape(height, width, len(names))
            raw, colours = picture.info.get("exif"), colours_of(picture)
    except UnreadablePhoto:
        raise
    except Exception as error:  # libheif's errors come as several classes
        reason = _one_line(error) or type(error).__name__
        raise UnreadablePhoto(source, f"damaged or cut {form.upper()} ({reason})") from error
    if "A" in names:
        alpha = pixels[..., -1:].astype(np.uint16)
        notes.append(_alpha_note(pixels[..., -1]))
        pixels = (pixels[..., :-1] * alpha // 255).astype(np.uint8)
    rgb, more = _three_channels(source, pixels, names, "")
    rgb = _in_srgb(rgb, colours, notes)
    exif = _block_exif(raw)
    orientation = exif.orientation if form == "avif" else 1
    if orientation != 1:
        more.append(f"turned upright (EXIF orientation {orientation})")
        rgb = np.ascontiguousarray(upright(rgb, orientation))
    notes += [*more, *_misnamed(source, form)]
    height, width = rgb.shape[:2]
    return Photo(source, form, width, height, exif, False, tuple(notes), orientation=orientation), rgb


def _register_heif() -> bool:
    # pi_heif decodes only; pillow_heif has the same calls and also an encoder under the GPL.
    for name in ("pi_heif", "pillow_heif"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name).register_heif_opener()
            return True
    return False


def _block_exif(raw: object) -> Exif:
    """Read a bare EXIF block; a damaged block gives an empty Exif."""
    from PIL.ExifTags import GPSTAGS, IFD, TAGS

    if not isinstance(raw, bytes):
        return Exif()
    block = pillow().Exif()
    try:
        block.load(raw)
        tags = {TAGS.get(tag): value for tag, value in {**block, **block.get_ifd(IFD.Exif)}.items()}
        tags |= {GPSTAGS.get(tag): value for tag, value in block.get_ifd(IFD.GPSInfo).items()}
    except Exception:  # as in `images.header_size`
        return Exif()

    def named(name: str) -> Any:
        """Return a value by OpenImageIO's name, in its types."""
        value = tags.get(name.removeprefix("Exif:").replace("GPS:", "GPS"))
        if isinstance(value, tuple):
            return tuple(float(np.float32(part)) for part in value)
        if isinstance(value, bytes):
            return value[0] if len(value) == 1 else None
        return (
            float(np.float32(value)) if isinstance(value, Rational) and not isinstance(value, int) else value
        )

    return read_exif(named)


def _misnamed(source: Path, form: str) -> list[str]:
    suffix = source.suffix.lower()
    if _FORMAT_OF_SUFFIX.get(suffix, suffix.lstrip(".")) == form:
        return []
    return [f"{form} data under the name {source.suffix or 'without a suffix'}"]


def _sniff(path: Path) -> str:
    try:
        with open(path, "rb") as f:
            head = f.read(16)
    except OSError as error:
        raise UnreadablePhoto(path, f"cannot be opened ({error.strerror})") from error
    if not head:
        raise UnreadablePhoto(path, "empty file (0 bytes)")
    signatures = {
        b"\xff\xd8\xff": "jpeg",
        b"\x89PNG\r\n\x1a\n": "png",
        b"II*\0": "tiff",
        b"MM\0*": "tiff",
        b"II+\0": "tiff",  # BigTIFF
        b"MM\0+": "tiff",
        b"BM": "bmp",
        b"\0\0\0\x0cjP  ": "jpeg2000",
    }
    for signature, form in signatures.items():
        if head.startswith(signature):
            return _raw(path) if path.suffix.lower() == ".dng" else form
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "webp"
    if head[4:8] == b"ftyp" and head[8:12] in _HEIF_BRANDS:
        return "heic"
    if head[4:8] == b"ftyp" and head[8:12] in (b"avif", b"avis"):
        return "avif"
    raise UnreadablePhoto(path, "no image (the content is of no photo format)")


def _raw(path: Path) -> str:
    """Refuse raw photos unless OpenImageIO has LibRaw: its TIFF reader returns a DNG's small preview."""
    import OpenImageIO as oiio

    if "raw" not in str(oiio.get_string_attribute("format_list")).split(","):
        raise UnreadablePhoto(
            path, "this OpenImageIO reads no raw photos (it has no LibRaw); export it as JPEG or 16-bit TIFF"
        )
    return "dng"


def _check_whole(path: Path, form: str) -> None:
    """Refuse a file that is cut short: decoders fill the rest with grey and report no error."""
    if form == "jpeg":
        data = path.read_bytes()
        scan = _first_scan(data)
        if scan < 0 or data.find(b"\xff\xd9", scan) < 0:
            raise UnreadablePhoto(path, "cut JPEG (its end is missing)")
    elif form == "png":
        size = path.stat().st_size
        with open(path, "rb") as f:
            f.seek(max(0, size - 65536))
            if b"IEND" not in f.read():
                raise UnreadablePhoto(path, "cut PNG (its end is missing)")


def _first_scan(data: bytes) -> int:
    """Return the offset of the first start-of-scan marker outside header thumbnails; -1 without one."""
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return -1
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0xDA:
            return at
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return -1


def _check_size(path: Path, width: int, height: int) -> None:
    if width * height > MAX_PIXELS:
        raise UnreadablePhoto(
            path,
            f"{width}x{height} is {width * height / 1e6:.0f} megapixels, more than the "
            f"limit of {MAX_PIXELS // 1_000_000}; reduce it",
        )
    if min(width, height) < MIN_SIDE:
        raise UnreadablePhoto(path, f"{width}x{height} px is too small to match (at least {MIN_SIDE} a side)")


def _to_rgb(path: Path, pixels: np.ndarray, spec: Any) -> tuple[np.ndarray, list[str]]:
    """Convert [H, W, C] uint8 to [H, W, 3], with notes on the conversion."""
    notes = []
    if str(spec.format) == "uint16":
        notes.append("16 bits reduced to 8")
    names = tuple(n.upper() for n in spec.channelnames)
    space = next((spec.getattribute(f"{f}:ColorSpace") for f in ("jpeg", "tiff", "psd")), None)
    if spec.alpha_channel >= 0:
        # OpenImageIO returns colours multiplied by alpha: a composite over black.
        notes.append(_alpha_note(pixels[..., spec.alpha_channel]))
        pixels = np.delete(pixels, spec.alpha_channel, axis=2)
    rgb, more = _three_channels(path, pixels, names, str(space))
    return rgb, notes + more


def _in_srgb(rgb: np.ndarray, colours: Colours, notes: list[str]) -> np.ndarray:
    if colours.name:
        notes.append(f"{FROM_PROFILE} {colours.name}")
    return colours.to_srgb(rgb)


def _alpha_note(alpha: np.ndarray) -> str:
    return TRANSPARENT if alpha.min() < 255 else "opaque alpha channel dropped"


def _three_channels(
    path: Path, pixels: np.ndarray, names: tuple[str, ...], space: str
) -> tuple[np.ndarray, list[str]]:
    """Convert [H, W, C] without alpha to [H, W, 3], by the file's channel names and colour space."""
    channels = pixels.shape[2]
    if channels == 1:
        return np.repeat(pixels, 3, axis=2), [GREY]
    if channels == 4 and names[:4] in (("C", "M", "Y", "K"), ("CYAN", "MAGENTA", "YELLOW", "BLACK")):
        ink = pixels.astype(np.uint16)
        rgb = ((255 - ink[..., :3]) * (255 - ink[..., 3:]) // 255).astype(np.uint8)
        return rgb, ["CMYK converted to RGB without its profile"]
    if channels != 3:
        raise UnreadablePhoto(path, f"{channels} channels ({', '.join(names)}) are not a photo; export RGB")
    return pixels, ["CMYK converted to RGB without its profile"] if space == "CMYK" else []


def _one_line(text: object) -> str:
    """Return the end of a library's message as one line."""
    return " ".join(str(text).split())[-120:]


def read_exif(named: Named) -> Exif:
    """Read EXIF from values by OpenImageIO's names; damaged values count as absent."""
    orientation = _number(named, "Orientation")
    balance = _number(named, "Exif:WhiteBalance")
    return Exif(
        make=_text(named, "Make"),
        model=_text(named, "Model"),
        focal_mm=_positive(named, "Exif:FocalLength"),
        focal_35mm=_positive(named, "Exif:FocalLengthIn35mmFilm"),
        exposure_s=_positive(named, "ExposureTime"),
        f_number=_positive(named, "FNumber"),
        iso=_positive(named, "Exif:PhotographicSensitivity") or _positive(named, "Exif:ISOSpeedRatings"),
        white_balance=None if balance is None else int(balance),
        orientation=int(orientation) if orientation is not None and orientation in range(1, 9) else 1,
        latitude_deg=_degrees(named, "Latitude", "S", 90.0),
        longitude_deg=_degrees(named, "Longitude", "W", 180.0),
        altitude_m=_altitude(named),
        taken_at=_text(named, "Exif:DateTimeOriginal") or _text(named, "DateTime"),
    )


def _text(named: Named, name: str) -> str | None:
    value = named(name)
    if not isinstance(value, str):
        return None
    return "".join(c for c in value if c.isprintable()).strip() or None


def _number(named: Named, name: str) -> float | None:
    value = named(name)
    if isinstance(value, (int, float)) and math.isfinite(value):
        return float(value)
    return None


def _positive(named: Named, name: str) -> float | None:
    value = _number(named, name)
    return value if value is not None and value > 0 else None


def _degrees(named: Named, name: str, negative: str, limit: float) -> float | None:
    parts = named(f"GPS:{name}")
    if not isinstance(parts, tuple) or len(parts) != 3 or not all(math.isfinite(v) for v in parts):
        return None
    value = parts[0] + parts[1] / 60 + parts[2] / 3600
    if abs(value) > limit or value == 0.0:  # cameras without a GPS fix write 0, 0, 0
        return None
    return -value if _text(named, f"GPS:{name}Ref") == negative else value


def _altitude(named: Named) -> float | None:
    value = _number(named, "GPS:Altitude")
    if value is None:
        return None
    return -value if _number(named, "GPS:AltitudeRef") == 1 else value
