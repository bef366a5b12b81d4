"""PlayCanvas's SOG, version 2: WebP textures, codebooks and a palette of harmonics in one zip file.

Layout as in PlayCanvas's specification and its splat-transform (write-sog.ts). The palette is made by halving
the set of harmonics at medians, because k-means over 60 000 rows takes half an hour without a GPU.
"""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.io.images import decode
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
from ambiguous_wild.io.untrusted import read_bytes

_CODES = 256  # entries of a codebook
_MAX_PALETTE = 65536
_ROUNDS = 20  # rounds of Lloyd's algorithm
_BINS = 1 << 14
_EPOCH = (1980, 1, 1, 0, 0, 0)  # fixed time of files in the archive: the same model gives the same bytes
_ROW = 64  # palette entries in a row of their texture
_MAX_TEXTURE = 1 << 28
_LOSSLESS = 101  # WebP quality above 100


def encode_sog(
    gaussians: Arrays, transform: SceneTransform = UNMOVED, antialias: bool = False
) -> list[bytes]:
    """Return the file; transform and `antialias` stand in meta.json.

    Raises:
        AwError: more Gaussians than a texture holds.
    """
    n, rest = gaussians["sh_rest"].shape[:2]
    shape = _texture_shape(n)
    log_means = np.sign(gaussians["means"]) * np.log1p(np.abs(gaussians["means"].astype(np.float64)))
    low, high = log_means.min(axis=0), log_means.max(axis=0)
    fixed = rounded((log_means - low) / np.where(high > low, high - low, 1.0) * 65535, 65535)
    scales, scale_codes = _codebook(gaussians["log_scales"])
    tints, tint_codes = _codebook(gaussians["sh0"])
    largest, others = largest_first(gaussians["quats"])
    turned = rounded((others * 2.0**0.5 * 0.5 + 0.5) * 255, 255)
    alpha = rounded(sigmoid(gaussians["opacity_logits"]) * 255, 255)
    textures = {
        "means_l.webp": _texture(fixed & 255, shape),
        "means_u.webp": _texture(fixed >> 8, shape),
        "scales.webp": _texture(scale_codes, shape),
        "quats.webp": _texture(np.column_stack([turned, 252 + largest]), shape),
        "sh0.webp": _texture(np.column_stack([tint_codes, alpha]), shape),
    }
    meta: dict[str, object] = {
        "version": 2,
        "asset": {"generator": "ambiguous_wild", **transform_record(transform)},
        "count": n,
        "antialias": antialias,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": tints.tolist(), "files": ["sh0.webp"]},
    }
    if rest:
        palette, labels = _palette(gaussians["sh_rest"].reshape(n, 3 * rest))
        values, codes = _codebook(palette)
        rows = -(-len(palette) // _ROW)
        pixels = codes.reshape(len(palette) * rest, 3)
        textures["shN_centroids.webp"] = _texture(pixels, (rows, _ROW * rest))
        both = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)])
        textures["shN_labels.webp"] = _texture(both, shape)
        meta["shN"] = {
            "count": len(palette),
            "bands": round((rest + 1) ** 0.5) - 1,
            "codebook": values.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, texture in textures.items():
            archive.writestr(zipfile.ZipInfo(name, _EPOCH), _webp(texture))
        archive.writestr(zipfile.ZipInfo("meta.json", _EPOCH), json.dumps(meta, allow_nan=False))
    return [file.getvalue()]


def decode_sog(data: bytes, path: Path | str) -> SplatFile:
    """Read a SOG file of version 2.

    Raises:
        AwError: no SOG of version 2, or damaged.
    """

    def read(name: str) -> bytes:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if archive.getinfo(name).file_size > _MAX_TEXTURE:
                raise ValueError(f"{name} is larger than a texture can be")
            return archive.read(name)

    return _decoded(read, path)


def read_unpacked_sog(meta: Path) -> SplatFile:
    """Read an unpacked SOG by its meta.json; errors as of `decode_sog`, or a file cannot be read."""

    def read(name: str) -> bytes:
        if Path(name).name != name:
            raise ValueError(f"{name!r} is no file beside it")
        return read_bytes(meta.with_name(name), _MAX_TEXTURE)

    return _decoded(read, meta)


def _decoded(read: Callable[[str], bytes], path: Path | str) -> SplatFile:
    try:
        meta = json.loads(read("meta.json"))
        if meta["version"] != 2:
            raise AwError(f"{path} is SOG of version {meta['version']!r}; this reads version 2")
        flag = meta.get("antialias") is True
        return SplatFile(_decode(read, meta), transform_from(meta.get("asset")), flag)
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        LookupError,
        TypeError,
        ValueError,
        RuntimeError,
    ) as error:
        raise AwError(f"{path} is no SOG of version 2, or damaged: {error}") from None


def _decode(read: Callable[[str], bytes], meta: Mapping[str, Any]) -> dict[str, np.ndarray]:
    n = int(meta["count"])

    def pixels(part: str, index: int = 0) -> np.ndarray:
        return _read_webp(read(str(meta[part]["files"][index]))).reshape(-1, 4)

    low, high = (np.asarray(meta["means"][end], np.float64) for end in ("mins", "maxs"))
    fixed = pixels("means")[:n, :3].astype(np.int64) | (pixels("means", 1)[:n, :3].astype(np.int64) << 8)
    log_means = low + fixed / 65535.0 * (high - low)
    quats, tints = pixels("quats")[:n], pixels("sh0")[:n]
    books = {part: np.asarray(meta[part]["codebook"], np.float32) for part in ("scales", "sh0")}
    harmonics = np.zeros((n, 0, 3), np.float32)
    if "shN" in meta:
        part = meta["shN"]
        rest = (0, 3, 8, 15)[int(part["bands"])]
        labels = pixels("shN", 1)[:n].astype(np.int64)
        entries = pixels("shN")[: int(part["count"]) * rest, :3].reshape(-1, rest, 3)
        channels = np.asarray(part["codebook"], np.float32)[entries[labels[:, 0] | (labels[:, 1] << 8)]]
        harmonics = np.ascontiguousarray(channels)
    return {
        "means": (np.sign(log_means) * np.expm1(np.abs(log_means))).astype(np.float32),
        "quats": from_largest(
            quats[:, 3].astype(np.int64) - 252, (quats[:, :3] / 255.0 - 0.5) * 2.0**0.5
        ).astype(np.float32),
        "log_scales": books["scales"][pixels("scales")[:n, :3]],
        "opacity_logits": logit(tints[:, 3] / 255.0),
        "sh0": books["sh0"][tints[:, :3]],
        "sh_rest": harmonics,
    }


def _texture_shape(count: int) -> tuple[int, int]:
    """Return rows and columns, multiples of four, as the reference chooses them."""
    width = int(np.ceil(np.sqrt(count) / 4) * 4)
    return int(np.ceil(count / width / 4) * 4), width


def _texture(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Lay out rows of three or four codes as RGBA, opaque where there are three."""
    image = np.zeros((shape[0] * shape[1], 4), np.uint8)
    image[:, 3] = 255
    image[: len(values), : values.shape[1]] = values
    return image.reshape(*shape, 4)


def _codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Choose at most 256 values by Lloyd's algorithm on a histogram; return them and each value's nearest."""
    flat = values.astype(np.float64).ravel()
    low, high = flat.min(), flat.max()
    if high <= low:
        return np.full(_CODES, low), np.zeros(values.shape, np.int64)
    weight, edges = np.histogram(flat, _BINS, (low, high))
    middle = (edges[:-1] + edges[1:]) / 2
    # Half of the first values lie evenly, so that rare large values keep a code, half where most values are.
    half, total = _CODES // 2, np.cumsum(weight)
    book = np.interp((np.arange(half) + 0.5) / half * total[-1], total, middle)
    book = np.sort(np.concatenate([np.linspace(low, high, half), book]))
    for _ in range(_ROUNDS):
        nearest = np.searchsorted((book[1:] + book[:-1]) / 2, middle)
        mass = np.bincount(nearest, weight, _CODES)
        moved = np.bincount(nearest, weight * middle, _CODES) / np.where(mass > 0, mass, 1.0)
        book = np.sort(np.where(mass > 0, moved, book))
    return book, np.searchsorted((book[1:] + book[:-1]) / 2, flat).reshape(values.shape)


def _palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cluster rows: return the means [K, D] and the cluster of each row [N].

    The set is halved at the median of its widest dimension until there are K parts; the reference sets K.
    """
    n = len(rows)
    halvings = int(np.log2(min(_MAX_PALETTE, n)))
    order, starts = np.arange(n), np.zeros(1, np.int64)
    for _ in range(halvings):
        ordered = rows[order].astype(np.float64)
        sizes = np.diff(np.append(starts, n))
        mean = np.add.reduceat(ordered, starts) / sizes[:, None]
        spread = np.add.reduceat(ordered**2, starts) / sizes[:, None] - mean**2
        part = np.repeat(np.arange(len(starts)), sizes)
        key = ordered[np.arange(n), spread.argmax(axis=1)[part]]
        order = order[np.lexsort((key, part))]
        starts = np.column_stack([starts, starts + (sizes + 1) // 2]).ravel()
    sizes = np.diff(np.append(starts, n))
    labels = np.empty(n, np.int64)
    labels[order] = np.repeat(np.arange(len(starts)), sizes)
    return np.add.reduceat(rows[order].astype(np.float64), starts) / sizes[:, None], labels


def _webp(image: np.ndarray) -> bytes:
    import cv2

    if max(image.shape[:2]) > 16383:
        raise AwError(f"SOG cannot hold {image.shape[0] * image.shape[1]:,} texels in a WebP; export as spz")
    done, data = cv2.imencode(".webp", image[:, :, [2, 1, 0, 3]], [cv2.IMWRITE_WEBP_QUALITY, _LOSSLESS])
    if not done:
        raise AwError("this OpenCV cannot write WebP; export as spz")
    return bytes(data)


def _read_webp(data: bytes) -> np.ndarray:
    import cv2

    image = decode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED, "a texture")
    if image is None or image.ndim != 3:
        raise ValueError("a texture is no WebP image in colour")
    if image.shape[2] == 3:
        image = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
    return image[:, :, [2, 1, 0, 3]]
