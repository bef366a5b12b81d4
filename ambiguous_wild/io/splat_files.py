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
from ambiguous_wild.io.sog import decode_sog, encode_sog
from ambiguous_wild.io.splat_arrays import Arrays, SplatFile, finite, morton_order
from ambiguous_wild.io.spz import decode_spz, encode_spz
from ambiguous_wild.io.untrusted import read_bytes


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
    """Read the Gaussians of a file in one of `FORMATS` whose values are all finite, at least one.

    Raises:
        AwError: no such file, another format, damaged, no Gaussian is finite, or one is too far for float32.
    """
    data = read_bytes(path)
    form = next((form for form in FORMATS.values() if form.starts(data)), None)
    if form is None:
        raise AwError(f"{path} is no splat file: {', '.join(f.suffix for f in FORMATS.values())} are read")
    splats = form.decode(data, path)
    kept = finite(splats.gaussians)
    if not len(kept["means"]):
        raise AwError(f"{path} holds no Gaussian that is finite")
    if not (np.abs(kept["means"]) < LARGEST_COORDINATE).all():
        raise AwError(f"{path} holds a Gaussian with a coordinate above {LARGEST_COORDINATE:g}; remove it")
    return replace(splats, gaussians=kept, left_out=len(splats.gaussians["means"]) - len(kept["means"]))


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
