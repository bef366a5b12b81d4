"""Read any splat file: its first bytes tell the format, whatever its name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.io import compressed_ply, gltf, sog, spz
from ambiguous_wild.io.ply import read_place, read_splat_ply
from ambiguous_wild.io.splat_arrays import finite, read_bytes

_HEADER = 64 * 1024
_MOST_BYTES = 1 << 33


@dataclass(frozen=True)
class SplatFile:
    """The Gaussians of a file whose values are all finite, at least one."""

    gaussians: dict[str, np.ndarray]  # raw parameters, see `io.ply.read_splat_ply`
    place: SceneTransform  # place of the scene in whose coordinates they are
    antialias: bool  # whether the file says that it is drawn with Mip-Splatting's filter
    left_out: int  # number of Gaussians with values that are not finite


def read_splats(path: Path) -> SplatFile:
    """Read a splat PLY, a compressed PLY, SPZ, SOG, or a glTF of 'aw export'.

    Raises:
        AwError: no such file, another format, damaged, or no Gaussian is finite.
    """
    try:
        with open(path, "rb") as f:
            head = f.read(_HEADER)
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror or error}") from None
    antialias, place = False, UNMOVED
    if head[:3] == b"ply":
        chunks = b"element chunk" in head.partition(b"end_header")[0]
        arrays = compressed_ply.read_compressed_ply(path) if chunks else read_splat_ply(path)
        place = read_place(path)
    elif head[:4] == b"NGSP" or head[:2] == b"\x1f\x8b":
        data = read_bytes(path, _MOST_BYTES)
        arrays = spz.spz_arrays(data, path)
        antialias, place = spz.spz_facts(data)
    elif head[:2] == b"PK":
        arrays, place = sog.read_sog(path), sog.sog_place(path)
    elif head[:4] == b"glTF":
        arrays, place = gltf.read_gltf(path), gltf.gltf_place(path)
    else:
        raise AwError(f"{path} is no splat file: PLY (compressed too), SPZ, SOG and .glb are read")
    kept = finite(arrays)
    if not len(kept["means"]):
        raise AwError(f"{path} holds no Gaussian that is finite")
    return SplatFile(kept, place, antialias, len(arrays["means"]) - len(kept["means"]))
