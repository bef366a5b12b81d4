"""PlayCanvas's compressed PLY: chunks of 256 Gaussians, 16 bytes a Gaussian and 8 bits a harmonic.

Layout and quantisation as in PlayCanvas's splat-transform (compressed-chunk.ts, write-compressed-ply.ts).
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.io.ply import header_antialias, header_transform, splat_comments
from ambiguous_wild.io.splat_arrays import (
    SH_C0,
    Arrays,
    SplatFile,
    from_largest,
    largest_first,
    logit,
    rounded,
    sigmoid,
)

_CHUNK = 256
_BOUNDS = [
    f"{end}_{kind}{axis}"
    for kind, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb"))
    for end in ("min", "max")
    for axis in axes
]
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_POSITION_BITS = ((11, 21), (10, 11), (11, 0))  # (bits, shift) of x, y, z
_COLOUR_BITS = ((8, 24), (8, 16), (8, 8), (8, 0))
_SQRT_2 = 2.0**0.5


def encode_compressed_ply(
    gaussians: Arrays, transform: SceneTransform = UNMOVED, antialias: bool = False
) -> list[bytes]:
    """Return the parts of the file; transform and `antialias` stand in comments."""
    n, rest = gaussians["sh_rest"].shape[:2]
    colour = gaussians["sh0"] * SH_C0 + 0.5
    position, position_bounds = _in_chunks(gaussians["means"])
    scale, scale_bounds = _in_chunks(np.clip(gaussians["log_scales"], -20.0, 20.0))
    tint, tint_bounds = _in_chunks(colour)
    largest, others = largest_first(gaussians["quats"])
    rotation = largest.astype(np.int64)
    for component in rounded((others * _SQRT_2 * 0.5 + 0.5) * 1023, 1023).T:
        rotation = (rotation << 10) | component
    with_alpha = np.column_stack([tint, sigmoid(gaussians["opacity_logits"])])
    words = [_pack(position, _POSITION_BITS), rotation, _pack(scale, _POSITION_BITS)]
    packed = np.column_stack([*words, _pack(with_alpha, _COLOUR_BITS)]).astype("<u4")
    header = ["ply", "format binary_little_endian 1.0", *splat_comments(transform, antialias)]
    header += [f"element chunk {-(-n // _CHUNK)}"]
    header += [f"property float {name}" for name in _BOUNDS] + [f"element vertex {n}"]
    header += [f"property uint {name}" for name in _PACKED]
    if rest:
        header += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(3 * rest))]
    channels = gaussians["sh_rest"].transpose(0, 2, 1).reshape(n, 3 * rest)
    codes = np.clip(np.trunc((channels / 8.0 + 0.5) * 256.0), 0, 255).astype(np.uint8)
    bounds = np.hstack([position_bounds, scale_bounds, tint_bounds]).astype("<f4")
    head = "\n".join([*header, "end_header", ""]).encode("ascii")
    return [head, bounds.tobytes(), packed.tobytes(), codes.tobytes()]


def decode_compressed_ply(data: bytes, path: Path | str) -> SplatFile:
    """Read a compressed PLY.

    Raises:
        AwError: no compressed PLY, or cut short.
    """
    end = data.find(b"end_header\n", 0, 64 * 1024)
    lines = [] if end < 0 else [line for line in data[:end].decode("latin-1").splitlines() if line]
    lines = [line for line in lines if not line.startswith("comment")]
    text = "\n".join(lines)
    header = re.fullmatch(
        r"ply\nformat binary_little_endian 1.0\nelement chunk (\d{1,9})\n"
        + "".join(f"property float {name}\n" for name in _BOUNDS[:12])
        + "("
        + "".join(f"property float {name}\n" for name in _BOUNDS[12:])
        + ")?"
        + r"element vertex (\d{1,9})\n"
        + "\n".join(f"property uint {name}" for name in _PACKED)
        + r"(?:\nelement sh \d{1,9}((?:\nproperty uchar f_rest_\d+)*))?",
        text,
    )
    if header is None:
        raise AwError(f"{path} is no compressed PLY as 'aw export' and splat-transform write it")
    n, rest = int(header[3]), (header[4] or "").count("\n") // 3
    if rest not in (0, 3, 8, 15):
        raise AwError(f"{path} has {3 * rest} f_rest columns; degree 0 to 3 have 0, 9, 24 or 45")
    chunks, start = -(-n // _CHUNK), end + len(b"end_header\n")
    ends = 6 if header[2] else 4  # SuperSplat's first files have no bounds of colours
    size = chunks * 12 * ends + n * (16 + 3 * rest)
    if int(header[1]) != chunks or len(data) - start < size:
        raise AwError(f"{path} is cut short: {size} bytes announced, {len(data) - start} present")
    bounds = np.frombuffer(data, "<f4", chunks * 3 * ends, start).reshape(chunks, ends, 3)
    start += bounds.nbytes
    if ends == 4:
        bounds = np.concatenate([bounds, np.zeros((chunks, 1, 3)), np.ones((chunks, 1, 3))], axis=1)
    packed = np.frombuffer(data, "<u4", 4 * n, start).reshape(n, 4).astype(np.int64)
    codes = np.frombuffer(data, np.uint8, 3 * rest * n, start + 16 * n).reshape(n, 3, rest)
    of = np.arange(n) // _CHUNK
    position, scale = _unpack(packed[:, 0], _POSITION_BITS), _unpack(packed[:, 2], _POSITION_BITS)
    tint = _unpack(packed[:, 3], _COLOUR_BITS)
    others = np.stack([(packed[:, 1] >> shift) & 1023 for shift in (20, 10, 0)], axis=1) / 1023.0
    colour = _between(tint[:, :3], bounds[of, 4], bounds[of, 5])
    arrays = {
        "means": _between(position, bounds[of, 0], bounds[of, 1]),
        "quats": from_largest(packed[:, 1] >> 30, (others - 0.5) * _SQRT_2).astype(np.float32),
        "log_scales": _between(scale, bounds[of, 2], bounds[of, 3]),
        "opacity_logits": logit(tint[:, 3]),
        "sh0": ((colour - 0.5) / SH_C0).astype(np.float32),
        "sh_rest": (((codes.transpose(0, 2, 1) + 0.5) / 256.0 - 0.5) * 8.0).astype(np.float32),
    }
    return SplatFile(arrays, header_transform(data, path), header_antialias(data))


def _in_chunks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scale values [N, 3] to [0, 1] in the range of their chunk; return them and the ranges [chunks, 6]."""
    n = len(values)
    starts = np.arange(0, n, _CHUNK)
    if not n:
        return values, np.zeros((0, 6), np.float32)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    of = np.arange(n) // _CHUNK
    span = (high - low)[of].astype(np.float64)
    share = np.where(span < 1e-5, 0.0, (values - low[of]) / np.where(span < 1e-5, 1.0, span))
    return share, np.hstack([low, high])


def _pack(shares: np.ndarray, places: tuple[tuple[int, int], ...]) -> np.ndarray:
    total = np.zeros(len(shares), np.int64)
    for column, (bits, shift) in enumerate(places):
        most = (1 << bits) - 1
        total |= rounded(shares[:, column] * most, most) << shift
    return total


def _unpack(codes: np.ndarray, places: tuple[tuple[int, int], ...]) -> np.ndarray:
    return np.stack(
        [((codes >> shift) & ((1 << bits) - 1)) / ((1 << bits) - 1) for bits, shift in places], axis=1
    )


def _between(share: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    return (low + share * (high - low)).astype(np.float32)
