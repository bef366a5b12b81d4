"""The formats of splat files, one record each; read any of them by its first bytes, write one by its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.io.colmap_records import LARGEST_COORDINATE
from ambiguous_wild.io.compressed_ply import decode_compressed_ply, encode_compressed_ply
from ambiguous_wild.io.files import write_bytes
from ambiguous_wild.io.gltf import decode_gltf, encode_gltf
from ambiguous_wild.io.ply import decode_ply, encode_ply, has_chunks
from ambiguous_wild.io.sog import decode_sog, encode_sog, read_unpacked_sog
from ambiguous_wild.io.splat_arrays import SH_C0, Arrays, SplatFile, finite, logit, morton_order
from ambiguous_wild.io.spz import decode_spz, encode_spz
from ambiguous_wild.io.untrusted import read_bytes

_DOT_SPLAT = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]  # quats w, x, y, z
)


@dataclass(frozen=True)
class SplatFormat:
    """One format of splat files, and what its files cannot hold."""

    name: str  # of `aw export --format`
    suffix: str
    starts: Callable[[bytes], bool]  # whether a file with these bytes is of this format
    # bytes and name of a file -> its content; AwError with the name if it is damaged
    decode: Callable[[bytes, Path], SplatFile]
    # finite Gaussians, their scene's transform, whether Mip-Splatting's filter draws them -> parts of a file
    encode: Callable[[Arrays, SceneTransform, bool], Sequence[bytes | memoryview]]
    ordered: bool = True  # Gaussians are written in the order of a Morton curve
    # whether it holds the sizes of a scene whose unit is 1/x of the unit of training
    holds_units: Callable[[float], bool] = lambda scale: True
    antialias: bool = False  # whether viewers find in it that Mip-Splatting's 2D filter draws the Gaussians
    y_up: bool = False  # y points up in every file, and a node of it states the transform


def _magic(*magic: bytes) -> Callable[[bytes], bool]:
    return lambda data: data.startswith(magic)


_ALL = (
    SplatFormat(
        "compressed-ply", ".compressed.ply", has_chunks, decode_compressed_ply, encode_compressed_ply
    ),
    # SPZ's scales have a fixed range; SOG's positions are logarithms
    SplatFormat(
        "spz",
        ".spz",
        _magic(b"NGSP", b"\x1f\x8b"),
        decode_spz,
        encode_spz,
        holds_units=lambda scale: False,
        antialias=True,
    ),
    SplatFormat(
        "sog",
        ".sog",
        _magic(b"PK"),
        decode_sog,
        encode_sog,
        holds_units=lambda scale: scale >= 1,
        antialias=True,
    ),
    SplatFormat("gltf", ".glb", _magic(b"glTF"), decode_gltf, encode_gltf, ordered=False, y_up=True),
    SplatFormat("ply", ".ply", _magic(b"ply"), decode_ply, encode_ply, ordered=False, antialias=True),
)
FORMATS = {form.name: form for form in _ALL}


def read_splats(path: Path) -> SplatFile:
    """Read those Gaussians of a file whose values are all finite.

    It is in one of `FORMATS`, a `.splat`, or the meta.json of an unpacked SOG.

    Raises:
        AwError: no such file, another format, damaged, no Gaussian is finite, or one is too far for float32.
    """
    unpacked = path.name == "meta.json"
    data = b"" if unpacked else read_bytes(path)
    form = next((form for form in FORMATS.values() if form.starts(data)), None)
    if unpacked:
        splats = read_unpacked_sog(path)
    elif form is not None:
        splats = form.decode(data, path)
    elif path.suffix.lower() == ".splat":  # without a magic number
        splats = _decode_dot_splat(data, path)
    else:
        suffixes = (*(f.suffix for f in FORMATS.values()), ".splat")
        raise AwError(f"{path} is no splat file: {', '.join(suffixes)} are read")
    kept = finite(splats.gaussians)
    if not len(kept["means"]):
        raise AwError(f"{path} holds no Gaussian that is finite")
    if not (np.abs(kept["means"]) < LARGEST_COORDINATE).all():
        raise AwError(f"{path} holds a Gaussian with a coordinate above {LARGEST_COORDINATE:g}; remove it")
    return replace(splats, gaussians=kept, left_out=len(splats.gaussians["means"]) - len(kept["means"]))


def _decode_dot_splat(data: bytes, path: Path) -> SplatFile:
    """Read antimatter15's `.splat`, degree 0 (github.com/antimatter15/splat, convert.py)."""
    if not data or len(data) % _DOT_SPLAT.itemsize:
        size = _DOT_SPLAT.itemsize
        raise AwError(f"{path}: {len(data)} bytes, not a multiple of {size} as in a .splat file: cut short?")
    rows = np.frombuffer(data, _DOT_SPLAT)
    with np.errstate(divide="ignore", invalid="ignore"):  # such rows are left out
        log_scales = np.log(rows["scales"])
    gaussians = {
        "means": rows["means"].copy(),
        "quats": (rows["quats"].astype(np.float32) - 128) / 128,
        "log_scales": log_scales,
        "opacity_logits": logit(rows["rgba"][:, 3] / 255),
        "sh0": ((rows["rgba"][:, :3] / 255 - 0.5) / SH_C0).astype(np.float32),
        "sh_rest": np.zeros((len(rows), 0, 3), np.float32),
    }
    return SplatFile(gaussians)


def drawable(form: SplatFormat, gaussians: Arrays) -> dict[str, np.ndarray]:
    """Return the Gaussians that are finite, in the order in which the format writes them."""
    kept = finite(gaussians)
    if not form.ordered:
        return kept
    order = morton_order(kept["means"])
    return {name: value[order] for name, value in kept.items()}


def write_splats(
    form: SplatFormat,
    path: Path | str,
    gaussians: Arrays,
    transform: SceneTransform = UNMOVED,
    antialias: bool = False,
) -> int:
    """Write the Gaussians that are finite atomically, and return their number.

    Args:
        form: one of `FORMATS`.
        path: the file.
        gaussians: raw parameters, see `io.ply.write_splat_ply`.
        transform: transform of their scene, which the file records.
        antialias: Mip-Splatting's 2D filter draws them; recorded where the format can.

    Raises:
        AwError: no Gaussian is finite, or the format cannot hold them.
    """
    kept = drawable(form, gaussians)
    if not len(kept["means"]):
        raise AwError(f"cannot write {path}: no Gaussian is finite")
    write_bytes(path, form.encode(kept, transform, antialias))
    return len(kept["means"])
