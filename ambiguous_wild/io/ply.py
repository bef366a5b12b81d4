"""Read and write PLY: point clouds, and the splat PLY of every 3DGS viewer, one vertex a Gaussian."""

from __future__ import annotations

import io
import itertools
import re
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ambiguous_wild.core import UNMOVED, AwError, SceneTransform
from ambiguous_wild.io.colmap_records import LARGEST_COORDINATE
from ambiguous_wild.io.files import write_bytes
from ambiguous_wild.io.splat_arrays import SH_C0, Arrays, SplatFile, checked_transform, logit, sigmoid
from ambiguous_wild.io.untrusted import read_bytes

_SPLAT_COLOUR = ("f_dc_0", "f_dc_1", "f_dc_2")
RENDER_MODE = "SplatRenderMode"  # a comment of splat PLYs
_MAX_HEADER = 64 * 1024  # bytes; a splat header has under 2 kB
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "<i2", "int16": "<i2",
    "ushort": "<u2", "uint16": "<u2", "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8",
}  # fmt: skip
_FORMS = ("binary_little_endian", "binary_big_endian", "ascii")
_COLOURS = ("red", "green", "blue")
_SPELLINGS = (_COLOURS, tuple(f"diffuse_{c}" for c in _COLOURS), tuple("rgb"), ("Red", "Green", "Blue"))
_DISK = np.log(1e-6)  # third log scale of 2DGS's disks, which have two; as SuperSplat reads them
_SHAPES = {"means": (3,), "quats": (4,), "log_scales": (3,), "opacity_logits": (), "sh0": (3,)}


def _columns(rest: int) -> list[str]:
    names = ["x", "y", "z", "nx", "ny", "nz"]
    names += [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(3 * rest)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def write_splat_ply(
    path: Path | str, gaussians: Arrays, transform: SceneTransform = UNMOVED, antialias: bool = False
) -> None:
    """Write Gaussians atomically.

    If the scene was moved, the file has the units of the scene's files, and a comment in the header gives the
    offset to add to its positions for their coordinates, which float32 cannot hold.

    Args:
        path: the file.
        gaussians: raw parameters as `splat.Gaussians` holds them: means [N, 3], quats [N, 4] (w, x, y,
            z), log_scales [N, 3], opacity_logits [N], sh0 [N, 3], sh_rest [N, K, 3] with K of 0, 3, 8, 15.
        transform: transform of the scene that they were trained on, in whose inner coordinates they are.
        antialias: Mip-Splatting's 2D filter draws them; said in the comment that nerfstudio, gsplat and Brush
            read.

    Raises:
        AwError: an array is missing or has another shape.
    """
    missing = [name for name in (*_SHAPES, "sh_rest") if name not in gaussians]
    if missing:
        raise AwError(f"cannot write {path}: no {', '.join(missing)}")
    n = len(gaussians["means"])
    for name, shape in _SHAPES.items():
        if gaussians[name].shape != (n, *shape):
            raise AwError(f"cannot write {path}: {name} is {list(gaussians[name].shape)}, not {[n, *shape]}")
    rest = gaussians["sh_rest"]
    if rest.ndim != 3 or rest.shape[0] != n or rest.shape[1] not in (0, 3, 8, 15) or rest.shape[2] != 3:
        raise AwError(f"cannot write {path}: sh_rest is {list(rest.shape)}, not [{n}, 0|3|8|15, 3]")
    write_bytes(path, encode_ply(gaussians, transform, antialias))


def encode_ply(
    gaussians: Arrays, transform: SceneTransform = UNMOVED, antialias: bool = False
) -> list[bytes | memoryview]:
    """Return the parts of a splat PLY, see `write_splat_ply`."""
    gaussians = rescaled(gaussians, 1 / transform.scale)
    n, rest = gaussians["sh_rest"].shape[:2]
    table = np.empty((n, 17 + 3 * rest), "<f4")  # filled in place, as a file may have gigabytes
    table[:, :3], table[:, 3:6], table[:, 6:9] = gaussians["means"], 0.0, gaussians["sh0"]
    for channel in range(3):
        table[:, 9 + channel * rest : 9 + (channel + 1) * rest] = gaussians["sh_rest"][:, :, channel]
    table[:, -8], table[:, -7:-4] = gaussians["opacity_logits"], gaussians["log_scales"]
    table[:, -4:] = gaussians["quats"]
    header = ["ply", "format binary_little_endian 1.0", *splat_comments(transform, antialias)]
    header += [f"element vertex {n}"]
    header += [f"property float {name}" for name in _columns(rest)] + ["end_header", ""]
    return ["\n".join(header).encode("ascii"), table.data]


def rescaled(gaussians: Arrays, factor: float) -> Arrays:
    """Return the Gaussians in other units: means and scales times `factor`."""
    if factor == 1.0:
        return gaussians
    means, log_scales = gaussians["means"], gaussians["log_scales"]
    sizes = {"log_scales": (log_scales + np.log(factor)).astype(log_scales.dtype)}
    return {**gaussians, "means": (means * factor).astype(means.dtype), **sizes}


def splat_comments(transform: SceneTransform, antialias: bool) -> list[str]:
    """Return header lines of a PLY that record its scene's transform and how its Gaussians are drawn."""
    values = {"offset": transform.centre, "training_scale": (transform.scale,), "rotation": transform.quat}
    if transform.quat == UNMOVED.quat:
        del values["rotation"]
    lines = [f"comment {name} {' '.join(map(repr, numbers))}" for name, numbers in values.items()]
    lines = [] if transform == UNMOVED else lines
    return [*lines, f"comment {RENDER_MODE}: mip"] if antialias else lines


def header_antialias(data: bytes) -> bool:
    """Whether a PLY says that Mip-Splatting's 2D filter (opacity compensation) draws its Gaussians."""
    head = data[:_MAX_HEADER].partition(b"\nend_header")[0]
    mode = re.search(rb"^comment " + RENDER_MODE.encode() + rb": *(\w+)", head, re.MULTILINE)
    return mode is not None and mode[1].lower() in (b"mip", b"antialiased")


def read_transform(path: Path | str) -> SceneTransform:
    """Return the transform of the scene of a splat PLY; `UNMOVED` if another tool wrote it.

    Raises:
        AwError: the numbers in its comments are invalid.
    """
    return header_transform(_head(path), path)


def header_transform(data: bytes, path: Path | str) -> SceneTransform:
    """Return the transform as `read_transform` does, from the file's bytes."""
    head = data[:_MAX_HEADER].partition(b"\nend_header")[0]
    words = dict(re.findall(rb"^comment (offset|training_scale|rotation) (.+)$", head, re.MULTILINE))
    if not {b"offset", b"training_scale"} <= words.keys():
        return UNMOVED
    try:
        offset, (scale,), quat = (
            [float(v) for v in words.get(name, b"1 0 0 0").split()]
            for name in (b"offset", b"training_scale", b"rotation")
        )
        return checked_transform(offset, scale, quat)
    except ValueError:
        raise AwError(f"{path}: its comments offset and training_scale are damaged; train again") from None


def stated_up(path: Path) -> str:
    """Return the axis that nerfstudio's header calls vertical; "" where it states none, or y."""
    found = re.search(rb"^comment Vertical Axis: *([xz])\b", _head(path), re.MULTILINE | re.IGNORECASE)
    return found[1].decode().lower() if found else ""


def read_splat_ply(path: Path | str) -> dict[str, np.ndarray]:
    """Read a splat PLY, ours or another tool's; arrays as `write_splat_ply` takes them, float32.

    A model of a scene that was moved is returned in the scene's inner coordinates. Columns may have any order
    and precision; unknown ones are ignored. Disks of 2DGS become flat Gaussians.

    Raises:
        AwError: no splat PLY, cut short, columns that are missing or whole numbers, or harmonics of a degree
            above 3.
    """
    return decode_ply(read_bytes(path), path).gaussians


def decode_ply(data: bytes, path: Path | str) -> SplatFile:
    """Read a splat PLY from its bytes, see `read_splat_ply`."""
    table, transform = _vertices(data, path), header_transform(data, path)
    count = len(table)
    present = set(table.dtype.names or ())
    rest = sum(name.startswith("f_rest_") for name in present)
    if rest not in (0, 9, 24, 45):
        raise AwError(f"{path} has {rest} f_rest columns; degree 0 to 3 have 0, 9, 24 or 45")
    disks = {"scale_0", "scale_1"} <= present and "scale_2" not in present
    unneeded = {"nx", "ny", "nz"} | ({"scale_2"} if disks else set())
    missing = [c for c in _columns(rest // 3) if c not in present | unneeded]
    if missing:
        points = {"x", "y", "z"} <= present and "opacity" not in present
        hint = "; to train from its points: aw bench --start" if points else ""
        raise AwError(f"{path} is no splat PLY: it lacks {', '.join(missing[:6])}{hint}")

    def columns(names: list[str]) -> np.ndarray:
        return _floats(table, names, path, np.float32)

    higher = np.empty((count, rest // 3, 3), np.float32)
    for number in range(rest):  # channel by channel
        channel, coefficient = divmod(number, rest // 3)
        higher[:, coefficient, channel] = columns([f"f_rest_{number}"])[:, 0]
    arrays = {
        "means": columns(["x", "y", "z"]),
        "quats": columns([f"rot_{i}" for i in range(4)]),
        "log_scales": columns([f"scale_{i}" for i in range(2 if disks else 3)]),
        "opacity_logits": columns(["opacity"])[:, 0],
        "sh0": columns([f"f_dc_{i}" for i in range(3)]),
        "sh_rest": higher,
    }
    if disks:
        arrays["log_scales"] = np.pad(arrays["log_scales"], ((0, 0), (0, 1)), constant_values=_DISK)
    if "filter_3D" in present:
        arrays |= _fused(arrays, columns(["filter_3D"]))
    return SplatFile(dict(rescaled(arrays, transform.scale)), transform, header_antialias(data))


def _fused(arrays: Arrays, size: np.ndarray) -> dict[str, np.ndarray]:
    """Return log_scales and opacity_logits after the 3D filter [N, 1] of Mip-Splatting's own files."""
    squares = np.exp(2 * arrays["log_scales"].astype(np.float64))
    filtered = squares + size.astype(np.float64) ** 2
    share = np.sqrt(np.prod(squares / filtered, axis=1))
    logits = logit(sigmoid(arrays["opacity_logits"]) * share)
    return {
        "log_scales": (0.5 * np.log(filtered)).astype(np.float32),
        "opacity_logits": logits.astype(np.float32),
    }


def _floats(
    table: np.ndarray, names: Sequence[str], path: Path | str, dtype: type[np.floating] = np.float64
) -> np.ndarray:
    """Return these properties, [M, len(names)]; whole numbers, which they cannot be, are refused."""
    values = np.empty((len(table), len(names)), dtype)
    for column, name in enumerate(names):
        if table.dtype[name].kind != "f":
            kind = table.dtype[name].name
            raise AwError(f"{path}: its property {name} is {kind}, not float or double; export it again")
        values[:, column] = table[name]
    return values


def has_chunks(data: bytes) -> bool:
    """Tell whether these are the bytes of a compressed PLY."""
    return data.startswith(b"ply") and b"element chunk" in data[:_MAX_HEADER].partition(b"end_header")[0]


def has_splats(path: Path) -> bool:
    """Tell whether a file may hold splats, unlike a PLY of plain points.

    Raises:
        AwError: it cannot be read.
    """
    head = _head(path).partition(b"\nend_header")[0]
    splats = re.search(rb"^(property \w+ opacity|element chunk)\b", head, re.MULTILINE)
    return not head.startswith(b"ply") or splats is not None


def read_point_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions [M, 3] float64 and colours [M, 3] uint8 of a point cloud.

    Raises:
        AwError: unreadable, damaged, or without x, y, z.
    """
    table = _vertices(read_bytes(path), path)
    names = table.dtype.names or ()
    if not all(axis in names for axis in "xyz"):
        raise AwError(f"{path} has no x, y and z")
    xyz = _floats(table, "xyz", path)
    if not (np.abs(xyz) < LARGEST_COORDINATE).all():
        raise AwError(f"{path} holds positions that are not finite or above {LARGEST_COORDINATE:g}")
    spelt = [of for of in _SPELLINGS if all(c in names for c in of)]
    if not spelt and all(name in names for name in _SPLAT_COLOUR):
        tint = np.stack([table[name].astype(np.float64) for name in _SPLAT_COLOUR], axis=1)
        return xyz, np.rint(np.clip(255 * (SH_C0 * tint + 0.5), 0, 255)).astype(np.uint8)
    if not spelt:
        warnings.warn(f"{path} has no colours: its points are grey", stacklevel=2)
        return xyz, np.full(xyz.shape, 128, np.uint8)
    rgb = np.nan_to_num(np.stack([table[c] for c in spelt[0]], axis=1))
    most = rgb.max(initial=0)  # 16 bits, 8 bits (some write them as floats), or shares
    white = 65535 if most > 256 else 1 if rgb.dtype.kind == "f" and most <= 1 else 255
    return xyz, np.rint(np.clip(rgb * (255.0 / white), 0, 255)).astype(np.uint8)


def write_point_ply(
    path: Path,
    xyz: np.ndarray,  # [M, 3]
    rgb: np.ndarray,  # [M, 3] uint8
) -> None:
    """Write a point cloud, binary."""
    # Coordinates of maps have more digits than float32, so these are written as doubles.
    middle = np.median(xyz, axis=0) if len(xyz) else np.zeros(3)
    far = len(xyz) and np.abs(middle).max() > 100 * np.median(np.abs(xyz - middle))
    form, kind = ("<f8", "double") if far else ("<f4", "float")
    table = np.empty(len(xyz), [*((axis, form) for axis in "xyz"), *((c, "u1") for c in _COLOURS)])
    for names, values in (("xyz", xyz), (_COLOURS, rgb)):
        for index, name in enumerate(names):
            table[name] = values[:, index]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    head += [f"property {kind} {axis}" for axis in "xyz"] + [f"property uchar {c}" for c in _COLOURS]
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + table.tobytes())


def splat_count(path: Path | str) -> int:
    """Return the number of Gaussians, from the file's header.

    Raises:
        AwError: no such file, or no splat PLY.
    """
    return _header(path, _head(path))[0]


def _head(path: Path | str) -> bytes:
    try:
        with open(path, "rb") as f:
            return f.read(_MAX_HEADER)
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror or error}") from None


def _vertices(data: bytes, path: Path | str) -> np.ndarray:
    """Read the rows of the first element: [M], with a field for each property.

    Raises:
        AwError: no PLY file, or cut short.
    """
    count, dtype, start, form = _header(path, data[:_MAX_HEADER])
    if form == "ascii":
        return _ascii_rows(path, data[start:], count, dtype)
    if count * dtype.itemsize > len(data) - start:
        raise AwError(
            f"{path} is cut short: {count} vertices of {dtype.itemsize} bytes announced, "
            f"{len(data) - start} bytes present; copy or export it again"
        )
    return np.frombuffer(data, dtype, count, start)


def _ascii_rows(path: Path | str, lines: bytes, count: int, dtype: np.dtype) -> np.ndarray:
    width = len(dtype.names or ())
    try:
        rows = [
            [float(v) for v in line.split()[:width]] for line in itertools.islice(io.BytesIO(lines), count)
        ]
        values = np.array(rows).reshape(count, width)
    except ValueError as error:
        raise AwError(f"{path} is cut short or damaged; copy it again") from error
    # Numbers in text may have more digits than float32.
    table = np.empty(count, [(n, "<f8" if dtype[n].kind == "f" else dtype[n]) for n in dtype.names or ()])
    for index, name in enumerate(dtype.names or ()):
        column = values[:, index]
        if dtype[name].kind != "f":
            column = np.clip(column, np.iinfo(dtype[name]).min, np.iinfo(dtype[name]).max)
        table[name] = column
    return table


def _header(path: Path | str, head: bytes) -> tuple[int, np.dtype, int, str]:
    """Parse the header: number of vertices, their dtype, offset of the data, and format."""
    if not head.startswith(b"ply"):
        raise AwError(f"{path} is no PLY file: it does not start with 'ply'")
    end = head.find(b"\nend_header")  # a comment may hold the word
    newline = head.find(b"\n", end + 1)
    if end < 0 or newline < 0:
        raise AwError(f"{path}: no end of the PLY header within its first {_MAX_HEADER} bytes")
    count, fields, element, form = -1, [], "", ""
    for line in head[:end].decode("latin-1").splitlines():
        words = line.split()
        if not words or words[0] in ("ply", "comment", "obj_info"):
            continue
        if words[0] == "format":
            form = " ".join(words[1:2])
        elif words[0] == "element" and len(words) == 3:
            element = words[1] if count < 0 else "later"
            if count < 0:
                if element != "vertex" or not words[2].isdecimal() or len(words[2]) > 12:
                    raise AwError(f"{path}: expected 'element vertex <count>' first, found {line[:60]!r}")
                count = int(words[2])
        elif words[0] == "property" and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise AwError(f"{path}: cannot use vertex property {line[:60]!r}")
            fields.append((words[2], _TYPES[words[1]]))
        elif not (words[0] == "property" and element == "later"):
            raise AwError(f"{path}: cannot use header line {line[:60]!r}")
    if form not in _FORMS:
        raise AwError(f"{path} is of format {form[:30]!r}, not {', '.join(_FORMS)}; export it again")
    if count < 0 or not fields:
        raise AwError(f"{path}: its header names no vertices")
    names = [name for name, _ in fields]
    if len(set(names)) != len(names):
        raise AwError(f"{path}: its header names a vertex property twice")
    row = np.dtype(fields)
    return count, row.newbyteorder(">") if form == "binary_big_endian" else row, newline + 1, form
