"""Niantic's SPZ: writes version 3, reads 2 to 4: 24-bit positions, 8-bit everything else, one gzip stream.

Layout and quantisation as in Niantic's reference (load-spz.cc). The file's axes are x right, y up, z back
(RUB); a splat PLY's are x right, y down, z forward, so y and z change sign on the way.
"""

from __future__ import annotations

import gzip
import json
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.core.errors import install_command
from ambiguous_wild.io.splat_arrays import (
    Arrays,
    SplatFile,
    from_largest,
    largest_first,
    logit,
    rounded,
    sigmoid,
    transform_from,
    transform_record,
)

_MAGIC = 0x5053474E  # "NGSP"
_HEADER = struct.Struct("<IIIBBBB")  # magic, version, count, SH degree, fractional bits, flags, reserved
_FOURTH = b"NGSP"  # first bytes of version 4; earlier versions are one gzip stream
_VERSION, _ANTIALIASED, _EXTENDED = 3, 1, 2  # extensions, which are not read, follow the Gaussians
_TOO_LONG = "goes on after the Gaussians that its header announces: damaged, or two files; export it again"
_FINEST = 18  # fractional bits: 4 micrometres where a unit is a metre
_COLOUR = 0.15  # codes cover coefficients of +-3.3
_REST = (0, 3, 8, 15)  # coefficients beyond the constant one, by degree
FLIP = np.array([1.0, -1.0, -1.0], np.float32)  # signs that turn positions from a PLY's axes to the file's
# Sign that each harmonic takes when y and z change sign.
SH_FLIP = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)


def encode_spz(
    gaussians: Arrays, transform: SceneTransform = UNMOVED, antialias: bool = False
) -> list[bytes]:
    """Return the parts of the file; the transform is the comment of the gzip stream, `antialias` a flag.

    Raises:
        AwError: positions of more than 8 million units.
    """
    n, rest = gaussians["sh_rest"].shape[:2]
    furthest = float(np.abs(gaussians["means"]).max(initial=1e-6))
    bits = min(_FINEST, int(np.floor(23 - np.log2(furthest) - 1e-9)))
    if bits < 0:
        raise AwError(f"SPZ holds positions of at most 8 388 607 units; one lies at {furthest:.3g}")
    fixed = np.rint(gaussians["means"].astype(np.float64) * FLIP * (1 << bits)).astype(np.int64)
    fixed = np.clip(fixed, -(1 << 23), (1 << 23) - 1).astype("<i4")
    head = _HEADER.pack(_MAGIC, _VERSION, n, _REST.index(rest), bits, _ANTIALIASED if antialias else 0, 0)
    parts = [
        head,
        np.ascontiguousarray(fixed.view(np.uint8).reshape(n, 3, 4)[:, :, :3]).tobytes(),
        rounded(sigmoid(gaussians["opacity_logits"]) * 255, 255).astype(np.uint8).tobytes(),
        rounded(gaussians["sh0"] * (_COLOUR * 255) + 0.5 * 255, 255).astype(np.uint8).tobytes(),
        rounded((gaussians["log_scales"] + 10) * 16, 255).astype(np.uint8).tobytes(),
        _pack_quats(gaussians["quats"]).tobytes(),
        _pack_harmonics(gaussians["sh_rest"]).tobytes(),
    ]
    packed = gzip.compress(b"".join(parts), 6, mtime=0)  # 9: seven times the time, 2 % smaller
    if transform == UNMOVED:
        return [packed]
    comment = json.dumps(transform_record(transform)).encode("ascii")
    # Set the flag of a comment, which follows the 10 bytes of a gzip header.
    return [packed[:3], b"\x10", packed[4:10], comment, b"\0", packed[10:]]


def decode_spz(packed: bytes, path: Path | str) -> SplatFile:
    """Read an SPZ file of version 2 to 4, in a PLY's axes.

    Raises:
        AwError: no SPZ, another version, damaged, or version 4 without the package zstandard.
    """
    inflater = zlib.decompressobj(wbits=31)
    zipped = packed[:4] != _FOURTH
    try:
        head = inflater.decompress(packed, _HEADER.size) if zipped else packed[: _HEADER.size]
        magic, version, n, degree, bits, flags, streams = _HEADER.unpack(head)
        if magic != _MAGIC or version not in ((2, 3) if zipped else (4,)) or degree > 3 or bits > 24:
            raise AwError(f"{path} is no SPZ of version 2, 3 or 4 with harmonics of degree 0 to 3")
        rest = _REST[degree]
        turned = 3 if version == 2 else 4
        widths = (9, 1, 3, 3, turned, 3 * rest)
        size = n * sum(widths)
        # No more than the header announces is unpacked, whatever the stream holds.
        if zipped:
            data = inflater.decompress(inflater.unconsumed_tail, size) if size else b""
            more = inflater.decompress(inflater.unconsumed_tail, 1) and not flags & _EXTENDED
            if len(data) == size and (more or inflater.unused_data):
                raise AwError(f"{path} {_TOO_LONG}")
        else:
            data = _unpacked(packed, streams, [n * width for width in widths], path)
    except (zlib.error, struct.error) as error:
        raise AwError(f"{path} is no SPZ, or damaged: {error}") from None
    if len(data) < size:
        raise AwError(f"{path} is cut short: {size} bytes announced, {len(data)} present")
    raw, at = np.frombuffer(data, np.uint8), 0

    def take(width: int) -> np.ndarray:
        nonlocal at
        at += n * width
        return raw[at - n * width : at].reshape(n, width)

    low = np.zeros((n, 3, 4), np.uint8)
    low[:, :, 1:] = take(9).reshape(n, 3, 3)
    fixed = low.reshape(n, 12).view("<i4") >> 8  # the sign is that of the highest byte
    alpha, colour, scale = take(1)[:, 0], take(3), take(3)
    quats, harmonics = take(turned), take(3 * rest).reshape(n, rest, 3)
    arrays = {
        "means": (fixed / float(1 << bits) * FLIP).astype(np.float32),
        "quats": _unpack_quats(quats.copy().view("<u4")[:, 0].astype(np.int64))
        if turned == 4
        else _second_quats(quats),
        "log_scales": (scale / 16.0 - 10.0).astype(np.float32),
        "opacity_logits": logit(alpha / 255.0),
        "sh0": ((colour / 255.0 - 0.5) / _COLOUR).astype(np.float32),
        "sh_rest": ((harmonics - 128.0) / 128.0 * SH_FLIP[:rest, None]).astype(np.float32),
    }
    comment = packed[10 : packed.find(b"\0", 10)] if zipped and packed[3] == 0x10 else b"0"
    try:
        transform = transform_from(json.loads(comment))
    except (ValueError, RecursionError):  # another program wrote the comment
        transform = UNMOVED
    return SplatFile(arrays, transform, bool(flags & _ANTIALIASED))


def _unpacked(packed: bytes, streams: int, sizes: Sequence[int], path: Path | str) -> bytes:
    """Unpack the attributes of version 4: a table of sizes, then a Zstandard frame each."""
    try:
        import zstandard  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        install = install_command("view")
        raise AwError(f"{path} is SPZ of version 4, which needs the package zstandard: {install}") from None
    table = struct.unpack_from("<I", packed, 16)[0]
    at, parts = table + 16 * streams, []
    for number, size in enumerate(sizes[:streams]):
        length, whole = struct.unpack_from("<QQ", packed, table + 16 * number)
        if whole != size:
            raise AwError(f"{path} is damaged: a part of {whole} bytes, not {size}")
        try:
            with zstandard.ZstdDecompressor().stream_reader(packed[at : at + length]) as reader:
                parts.append(reader.read(size))
        except zstandard.ZstdError as error:
            raise AwError(f"{path} is damaged: {error}") from None
        at += length
    if streams <= len(sizes) and at < len(packed):
        raise AwError(f"{path} {_TOO_LONG}")
    return b"".join(parts)


def _second_quats(codes: np.ndarray) -> np.ndarray:
    """Unpack the quaternions of version 2: x, y, z with 8 bits, w positive."""
    xyz = codes / 127.5 - 1.0
    w = np.sqrt(np.clip(1.0 - (xyz**2).sum(axis=1), 0.0, None))
    return np.column_stack([w, xyz * FLIP]).astype(np.float32)


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Pack quaternions, [N] uint32: index of the largest component, then sign and 9 bits of each other."""
    xyzw = quats[:, [1, 2, 3, 0]] * np.append(FLIP, 1.0)
    largest, others = largest_first(xyzw)
    packed = largest.astype(np.int64)
    for component in others.T:
        size = rounded(np.abs(component) * (511 * 2.0**0.5), 511)
        packed = (packed << 10) | ((component < 0).astype(np.int64) << 9) | size
    return packed.astype("<u4")


def _unpack_quats(packed: np.ndarray) -> np.ndarray:
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    others = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / (511 * 2.0**0.5)
    xyzw = from_largest(packed >> 30, others) * np.append(FLIP, 1.0)
    return xyzw[:, [3, 0, 1, 2]].astype(np.float32)


def _pack_harmonics(rest: np.ndarray) -> np.ndarray:
    """Quantise harmonics to 8-bit codes, of which degree 1 uses all bits and the others 7.

    Niantic's default of 5 and 4 bits took 1.3 dB from a model of RefineSplat; these take 0.01 dB, in a file
    1.6 times as large. Readers accept any code.
    """
    step = np.where(np.arange(rest.shape[1]) < 3, 1, 2)[:, None]
    codes = np.rint(rest * SH_FLIP[: rest.shape[1], None] * (128.0 / step)).astype(np.int64) * step + 128
    return np.clip(codes, 0, 255).astype(np.uint8)
