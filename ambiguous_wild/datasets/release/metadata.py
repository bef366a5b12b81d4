"""Take EXIF, XMP, IPTC, comments and embedded previews out of photos; the pixels stay bit for bit.

GPS positions and serial numbers stand in several of these blocks, some in forms that only the maker knows,
so whole blocks go. Colour profiles stay.
"""

from __future__ import annotations

import struct
import zlib

from ambiguous_wild.core.errors import AwError

_PNG = b"\x89PNG\r\n\x1a\n"
# Chunks that decide the pixels or their colours; the others are metadata.
_PNG_KEPT = frozenset(
    {
        b"IHDR",
        b"PLTE",
        b"IDAT",
        b"IEND",
        b"tRNS",
        b"gAMA",
        b"cHRM",
        b"sRGB",
        b"iCCP",
        b"sBIT",
        b"bKGD",
        b"pHYs",
        b"cICP",
    }
)
_WEBP_DROPPED = (b"EXIF", b"XMP ")


def strip_metadata(data: bytes, name: str) -> tuple[bytes, list[str]]:
    """The file without metadata, and the names of the blocks that were taken out.

    Args:
        data: of a JPEG, PNG or WebP file.
        name: for messages.

    Raises:
        AwError: damaged, or a format whose metadata is not known here.
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
    """Segments of ITU T.81 B.1; whatever follows the end of the picture is dropped too."""
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
    """Name of a metadata segment; None for one that the picture needs."""
    if marker == 0xFE:
        return "comment"
    if not 0xE0 <= marker <= 0xEF:
        return None
    # JFIF, colour profile, Adobe's colour transform
    if marker == 0xE0 and body.startswith(b"JFIF\0") and not body[12:14].strip(b"\0"):
        return None
    if (marker == 0xE2 and body.startswith(b"ICC_PROFILE\0")) or (
        marker == 0xEE and body.startswith(b"Adobe")
    ):
        return None
    known = {b"Exif": "EXIF", b"http://ns.adobe.com": "XMP", b"Photoshop": "IPTC", b"MPF": "previews"}
    return next((n for k, n in known.items() if body.startswith(k)), f"APP{marker - 0xE0}")


def _scan_end(data: bytes, at: int) -> int:
    """Where the entropy-coded data ends: the next marker that is neither stuffed nor a restart."""
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
