"""Protect people in photos: take out metadata, and list photos that may show a person.

GPS positions and serial numbers stand in EXIF, XMP, IPTC, comments and embedded previews, some in forms that
only the maker knows, so whole blocks are dropped; pixels stay bit for bit, and colour profiles stay. Persons
are found by weak classical detectors: the list helps to look through the photos, but guarantees nothing.
"""

from __future__ import annotations

import struct
import warnings
import zlib
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.images import read_png_rgb

_PNG = b"\x89PNG\r\n\x1a\n"
# Chunks that pixels or their colours depend on; the others are metadata.
_PNG_KEPT = frozenset(b"IHDR PLTE IDAT IEND tRNS gAMA cHRM sRGB iCCP sBIT bKGD pHYs cICP".split())
_WEBP_DROPPED = (b"EXIF", b"XMP ")
SIDE = 800  # px, longer side
HOW_WEAK = (
    "OpenCV's HOG detector finds upright people of at least 128 px from head to foot, and the LBP cascade "
    "frontal faces of at least 24 px, in photos reduced to 800 px. Both miss people who sit, turn away, are "
    "cut off or far, and both find people in trees and windows. Number plates are not looked for. A photo "
    "that is not listed may show people: look at every photo before release."
)
_MIN_WEIGHT = 0.5  # smallest weight of the SVM; below, most detections are wrong


def strip_metadata(data: bytes, name: str) -> tuple[bytes, list[str]]:
    """Return the file without metadata, and the names of the blocks that were taken out.

    Args:
        data: bytes of a JPEG, PNG or WebP file.
        name: for messages.

    Raises:
        AwError: damaged, or another format.
    """
    try:
        if data.startswith(b"\xff\xd8\xff"):
            return _jpeg(data)
        if data.startswith(_PNG):
            return _png(data)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp(data)
    except (struct.error, IndexError) as error:
        raise AwError(f"{name} is damaged: {error}") from error
    raise AwError(
        f"{name}: metadata can be taken out of JPEG, PNG and WebP alone; convert it to PNG, or pass "
        "--keep-metadata"
    )


def _jpeg(data: bytes) -> tuple[bytes, list[str]]:
    """Copy the segments (ITU T.81 B.1) but metadata; bytes after the end of the picture are dropped too."""
    out, dropped, at = [data[:2]], [], 2
    while at < len(data):
        if data[at] != 0xFF:
            raise IndexError(f"no marker at byte {at}")
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0xD9:
            out.append(data[at : at + 2])
            if len(data) > at + 2:
                dropped.append(f"{len(data) - at - 2} bytes after the picture")
            return b"".join(out), dropped
        end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if end > len(data):
            raise IndexError("a segment ends behind the file")
        segment = data[at:end]
        name = _jpeg_block(marker, segment[4:])
        if name is None:
            out.append(segment)
        else:
            dropped.append(name)
        at = end
        if marker == 0xDA:
            stop = _scan_end(data, at)
            out.append(data[at:stop])
            at = stop
    raise IndexError("the picture has no end")


def _jpeg_block(marker: int, body: bytes) -> str | None:
    """Return the name of a metadata segment; None for one that the picture needs."""
    if marker == 0xFE:
        return "comment"
    if not 0xE0 <= marker <= 0xEF:
        return None
    # The picture needs JFIF without a preview, the colour profile, and Adobe's colour transform.
    if marker == 0xE0 and body.startswith(b"JFIF\0") and not body[12:14].strip(b"\0"):
        return None
    if (marker == 0xE2 and body.startswith(b"ICC_PROFILE\0")) or (
        marker == 0xEE and body.startswith(b"Adobe")
    ):
        return None
    names = {b"Exif": "EXIF", b"http://ns.adobe.com": "XMP", b"Photoshop": "IPTC", b"MPF": "previews"}
    return next((n for k, n in names.items() if body.startswith(k)), f"APP{marker - 0xE0}")


def _scan_end(data: bytes, at: int) -> int:
    """Return where the entropy-coded data ends: at the next marker that is neither stuffed nor a restart."""
    while True:
        at = data.find(b"\xff", at)
        if at < 0 or at + 1 >= len(data):
            raise IndexError("the picture has no end")
        following = data[at + 1]
        if following != 0 and not 0xD0 <= following <= 0xD7 and following != 0xFF:
            return at
        at += 1 if following == 0xFF else 2


def _png(data: bytes) -> tuple[bytes, list[str]]:
    out, dropped, at = [_PNG], [], len(_PNG)
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 12 + length
        if end > len(data):
            raise IndexError("a chunk ends behind the file")
        if zlib.crc32(data[at + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise IndexError(f"the checksum of {kind!r} is wrong")
        if kind in _PNG_KEPT:
            out.append(data[at:end])
        else:
            dropped.append(kind.decode("latin-1"))
        at = end
        if kind == b"IEND":
            if at < len(data):
                dropped.append(f"{len(data) - at} bytes after the picture")
            return b"".join(out), dropped
    raise IndexError("the picture has no end")


def _webp(data: bytes) -> tuple[bytes, list[str]]:
    out, dropped, at = [], [], 12
    while at + 8 <= len(data):
        kind, (length,) = data[at : at + 4], struct.unpack_from("<I", data, at + 4)
        end = at + 8 + length + length % 2
        if end > len(data):
            raise IndexError("a chunk ends behind the file")
        chunk = data[at:end]
        if kind in _WEBP_DROPPED:
            dropped.append(kind.decode().strip())
        elif kind == b"VP8X":  # clear the flags that announce EXIF and XMP
            out.append(chunk[:8] + bytes([chunk[8] & ~0x0C]) + chunk[9:])
        else:
            out.append(chunk)
        at = end
    body = b"".join(out)
    return b"RIFF" + struct.pack("<I", 4 + len(body)) + b"WEBP" + body, dropped


@cache
def _detectors() -> tuple[Any, Any]:
    from skimage import data
    from skimage.feature import Cascade

    hog = cv2.HOGDescriptor()
    hog.setSVMDetector(np.asarray(cv2.HOGDescriptor.getDefaultPeopleDetector(), np.float32))
    return hog, Cascade(data.lbp_frontal_face_cascade_filename())


def may_show_person(path: Path) -> str:
    """Run the detectors on a photo: "person", "face", "person and face", or "" for nothing."""
    rgb = read_png_rgb(path)
    scale = SIDE / max(rgb.shape[:2])
    if scale < 1:
        rgb = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    hog, cascade = _detectors()
    detected = []
    if gray.shape[0] >= 128 and gray.shape[1] >= 64:
        _, weights = hog.detectMultiScale(gray, winStride=(8, 8), scale=1.1)
        if np.size(weights) and float(np.max(weights)) >= _MIN_WEIGHT:
            detected.append("person")
    if min(gray.shape) >= 24:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            faces = cascade.detect_multi_scale(
                img=gray, scale_factor=1.3, step_ratio=2, min_size=(24, 24), max_size=(400, 400)
            )
        detected += ["face"] if len(faces) else []
    return " and ".join(detected)
