"""COLMAP sparse models in numpy, binary and text, without pycolmap.

Layouts: COLMAP documentation, "Output Format". Sizes in a binary file are checked against its length before
memory is allocated: pycolmap takes cut files for whole ones, and allocates whatever a damaged one announces.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath
from typing import TypeVar

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.scene import SparsePoints, View
from ambiguous_wild.io.colmap_records import (
    FOCAL_RANGE,
    LARGEST_COORDINATE,
    LARGEST_SIDE,
    MODELS,
    ONE_FOCAL,
    SPLIT_PANORAMAS,
    ColmapModel,
    ModelCamera,
    ModelImage,
    ModelPoints,
    model_of_id,
    points_without_tracks,
)
from ambiguous_wild.io.files import write_bytes
from ambiguous_wild.io.ply import read_point_ply

POINT_CLOUD = "points3D.ply"
_AGAIN = "the model is damaged; build it again"
_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
# An image's line has id, seven numbers, camera id and a name that is no number; observations are numbers.
_IMAGE_LINE = re.compile(r"\s*\d+(\s+\S+){7}\s+\d+\s+(?![-+.\d]+(\s|$))\S")
_POINT_ROW = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")]
)


def read_model(folder: Path | str) -> ColmapModel:
    """Read cameras, images and, if present, points3D of a model folder: .bin files if it has them, else .txt.

    A model without points3D may have a point cloud in its place, as MASt3R and DUSt3R write it.

    Raises:
        AwError: files are missing, damaged or contradictory.
    """
    root = Path(folder)
    for suffix in (".bin", ".txt"):
        paths = [root / (stem + suffix) for stem in ("cameras", "images", "points3D")]
        if all(p.is_file() for p in paths[:2]):
            break
    else:
        raise AwError(f"{root} holds no COLMAP model: cameras and images (.bin or .txt) are needed")
    cameras, images, points = _BINARY if suffix == ".bin" else _TEXT
    if paths[2].is_file():
        found = points(paths[2])
    elif (cloud := root / POINT_CLOUD).is_file():
        found = points_without_tracks(*read_point_ply(cloud))
    else:
        found = points_without_tracks()
    model = ColmapModel(cameras(paths[0]), images(paths[1]), found)
    for camera in model.cameras.values():
        check_camera(root, camera)
    names: set[str] = set()
    for image in model.images.values():
        if not PurePosixPath(image.name).name or "\0" in image.name:
            raise AwError(f"{root}: image {image.image_id} has no name: {_AGAIN}")
        where = f"{root}: image {image.name!r}"
        if image.camera_id not in model.cameras:
            raise AwError(f"{where} has camera {image.camera_id}, which the model lacks: {_AGAIN}")
        if not (np.abs(image.tvec) < LARGEST_COORDINATE).all():
            raise AwError(f"{where} has the translation {image.tvec.tolist()}: {_AGAIN}")
        if image.name in names:
            raise AwError(f"{where} is listed twice: {_AGAIN}")
        names.add(image.name)
    ids, counts = np.unique(model.points.ids, return_counts=True)
    if (counts > 1).any():
        raise AwError(f"{paths[2]} has the id {ids[counts > 1][0]} twice: keep one, or build the model again")
    odd = np.flatnonzero(~(np.abs(model.points.xyz) < LARGEST_COORDINATE).all(axis=1))
    if len(odd):
        raise AwError(
            f"{root}: {len(odd)} points have no valid position, the first is {model.points.ids[odd[0]]} at "
            f"{model.points.xyz[odd[0]].tolist()}: {_AGAIN} or remove them"
        )
    return model


def check_camera(root: Path, camera: ModelCamera) -> None:
    """Raise AwError for an impossible size or focal length, before it is used.

    Args:
        root: file or folder of the camera, for the message.
        camera: camera of a model.
    """
    size = (camera.width, camera.height)
    whole = all(0 < side <= LARGEST_SIDE for side in size) and bool(np.isfinite(camera.params).all())
    if camera.model == "EQUIRECTANGULAR":
        raise AwError(f"{root}: camera {camera.camera_id} is EQUIRECTANGULAR; {SPLIT_PANORAMAS}")
    focal = camera.params[:1] if camera.model in ONE_FOCAL else camera.params[:2]
    if not whole or not all(FOCAL_RANGE[0] <= f / max(size) <= FOCAL_RANGE[1] for f in focal):
        raise AwError(
            f"{root}: camera {camera.camera_id} is {size[0]}x{size[1]} px with the parameters "
            f"{list(camera.params)}: the model is damaged; copy or build it again"
        )


class _Reader:
    """A cursor over a file's bytes that never reads past the end."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, path.read_bytes(), 0

    def take(self, count: int) -> bytes:
        if count < 0 or self.at + count > len(self.data):
            raise AwError(
                f"{self.path} is cut short or damaged: {count} bytes wanted at {self.at} of "
                f"{len(self.data)}; copy or build the model again"
            )
        self.at += count
        return self.data[self.at - count : self.at]

    def unpack(self, layout: str) -> tuple:
        return struct.unpack(layout, self.take(struct.calcsize(layout)))

    def count(self, least_bytes: int) -> int:
        """Read a uint64 count of records; refuse one that the rest of the file cannot hold."""
        (number,) = self.unpack("<Q")
        if number * least_bytes > len(self.data) - self.at:
            raise AwError(
                f"{self.path} is damaged: it announces {number} records, "
                f"but {len(self.data) - self.at} bytes are left; copy or build the model again"
            )
        return number

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise AwError(f"{self.path} is damaged: a name without an end at byte {self.at}")
        raw, self.at = self.data[self.at : end], end + 1
        return raw.decode("utf-8", errors="surrogateescape")


def _binary_cameras(path: Path) -> dict[int, ModelCamera]:
    """Read cameras.bin."""
    reader = _Reader(path)
    cameras: dict[int, ModelCamera] = {}
    for _ in range(reader.count(24)):
        camera_id, number, width, height = reader.unpack("<iiQQ")
        name, count = model_of_id(number, str(path))
        camera = ModelCamera(camera_id, name, width, height, reader.unpack(f"<{count}d"))
        _add(path, cameras, camera_id, camera)
    return cameras


def _binary_images(path: Path) -> dict[int, ModelImage]:
    """Read images.bin."""
    reader = _Reader(path)
    images: dict[int, ModelImage] = {}
    for _ in range(reader.count(73)):
        image_id, *pose, camera_id = reader.unpack("<i7di")
        name = reader.text()
        count = reader.count(_OBSERVATION.itemsize)
        rows = np.frombuffer(reader.take(count * _OBSERVATION.itemsize), dtype=_OBSERVATION)
        xys, points = np.array(rows["xy"]).reshape(-1, 2), np.array(rows["point"])
        image = ModelImage(image_id, np.array(pose[:4]), np.array(pose[4:]), camera_id, name, xys, points)
        _add(path, images, image_id, image)
    return images


_Record = TypeVar("_Record", ModelCamera, ModelImage)


def _add(path: Path, records: dict[int, _Record], number: int, record: _Record) -> None:
    if number in records:
        what = " and ".join(repr(getattr(r, "name", r)) for r in (records[number], record))
        raise AwError(f"{path} has the id {number} twice ({what}): keep one, or build the model again")
    records[number] = record


def _binary_points(path: Path) -> ModelPoints:
    """Read points3D.bin."""
    reader = _Reader(path)
    total = reader.count(_POINT_ROW.itemsize)
    heads, tracks = list[bytes](), list[bytes]()
    if len(reader.data) - reader.at == total * _POINT_ROW.itemsize:  # no tracks: rows of one size
        heads.append(reader.take(total * _POINT_ROW.itemsize))
    else:
        for _ in range(total):
            heads.append(reader.take(_POINT_ROW.itemsize))
            length = int.from_bytes(heads[-1][-8:], "little")
            if length * 8 > len(reader.data) - reader.at:
                point = int.from_bytes(heads[-1][:8], "little")
                raise AwError(f"{path} is damaged: point {point} announces a track of {length}")
            tracks.append(reader.take(length * 8))
    rows = np.frombuffer(b"".join(heads), _POINT_ROW)
    flat = np.frombuffer(b"".join(tracks), "<i4").reshape(-1, 2).astype(np.int64)
    if (rows["id"] >= 2**63).any() or (rows["track"] > len(flat)).any():
        raise AwError(f"{path} is damaged: its ids or tracks do not fit its size; copy it again")
    offsets = np.concatenate([[0], np.cumsum(rows["track"].astype(np.int64))])
    xyz, rgb, error = (rows[name].copy() for name in ("xyz", "rgb", "error"))
    return ModelPoints(rows["id"].astype(np.int64), xyz, rgb, error, offsets, flat[:, 0], flat[:, 1])


def _text_cameras(path: Path) -> dict[int, ModelCamera]:
    """Read cameras.txt."""
    cameras: dict[int, ModelCamera] = {}
    for number, fields in _rows(path):
        try:
            camera_id, model = int(fields[0]), fields[1]
            width, height = int(fields[2]), int(fields[3])
            params = tuple(float(v) for v in fields[4:])
        except (ValueError, IndexError) as error:
            raise _damaged(path, number) from error
        if model not in MODELS:
            raise AwError(
                f"{path}, line {number}: camera model {model[:40]!r} is not known; convert it with COLMAP's "
                f"model_converter to one of {', '.join(MODELS)}"
            )
        if len(params) != MODELS[model][1]:
            problem = f"{model} has {MODELS[model][1]} parameters, not {len(params)}"
            raise AwError(f"{path}, line {number}: {problem}; copy or build the model again")
        _add(path, cameras, camera_id, ModelCamera(camera_id, model, width, height, params))
    return cameras


def _text_images(path: Path) -> dict[int, ModelImage]:
    """Read images.txt: two lines an image, of which the second, of observations, may be empty.

    A file may also lack the second line of all images.
    """
    lines = [(n, text) for n, text in enumerate(_lines(path), 1) if not text.startswith("#")]
    while lines and not lines[0][1].strip():
        lines.pop(0)
    full = [line for line in lines if line[1].strip()]
    if len(full) > 1 and all(_IMAGE_LINE.match(text) for _, text in full):
        lines = [line for image in full for line in (image, (image[0], ""))]
    images: dict[int, ModelImage] = {}
    for i in range(0, len(lines), 2):
        number, text = lines[i]
        if not text.strip():  # trailing empty lines
            continue
        fields = text.strip().split(maxsplit=9)
        rest = lines[i + 1][1].split() if i + 1 < len(lines) else []
        try:
            image_id, camera_id, name = int(fields[0]), int(fields[8]), fields[9]
            pose = np.array([float(v) for v in fields[1:8]])
            table = np.array([float(v) for v in rest]).reshape(-1, 3)
            ids = np.array([int(v) for v in rest[2::3]], dtype=np.int64)
        except (ValueError, IndexError, OverflowError) as error:
            raise _damaged(path, number) from error
        image = ModelImage(image_id, pose[:4], pose[4:], camera_id, name, table[:, :2].copy(), ids)
        _add(path, images, image_id, image)
    return images


def _text_points(path: Path) -> ModelPoints:
    """Read points3D.txt."""
    ids, xyz, rgb, error_px, lengths, tracks = [], [], [], [], [], []
    for number, fields in _rows(path):
        try:
            ids.append(int(fields[0]))
            xyz.append([float(v) for v in fields[1:4]])
            rgb.append([int(v) for v in fields[4:7]])
            error_px.append(float(fields[7]))
            track = [int(v) for v in fields[8:]]
        except (ValueError, IndexError) as error:
            raise _damaged(path, number) from error
        if len(track) % 2 or len(xyz[-1]) != 3 or len(rgb[-1]) != 3 or not all(0 <= v < 256 for v in rgb[-1]):
            raise _damaged(path, number)
        lengths.append(len(track) // 2)
        tracks += track
    flat = np.array(tracks, dtype=np.int64).reshape(-1, 2)
    return ModelPoints(
        np.array(ids, dtype=np.int64),
        np.array(xyz, dtype=np.float64).reshape(-1, 3),
        np.array(rgb, dtype=np.uint8).reshape(-1, 3),
        np.array(error_px, dtype=np.float64),
        np.concatenate([[0], np.cumsum(lengths, dtype=np.int64)]).astype(np.int64),
        flat[:, 0],
        flat[:, 1],
    )


def _lines(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8-sig", errors="surrogateescape").split("\n")


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, text in enumerate(_lines(path), 1):
        if text.strip() and not text.startswith("#"):
            yield number, text.split()


def _damaged(path: Path, number: int) -> AwError:
    return AwError(f"{path}, line {number}, is not in COLMAP's format; copy or build the model again")


_BINARY = (_binary_cameras, _binary_images, _binary_points)
_TEXT = (_text_cameras, _text_images, _text_points)


def write_model(folder: Path, model: ColmapModel) -> None:
    """Write cameras.bin and images.bin, ordered by id, and points3D.bin, in the order given."""
    _write_cameras(folder / "cameras.bin", model.cameras.values())
    _write_images(folder / "images.bin", model.images.values())
    _write_points(folder / "points3D.bin", model.points)


def write_views(folder: Path, views: Sequence[View], points: SparsePoints) -> None:
    """Write a model with a pinhole camera a view, at the views' size, and points without tracks."""
    from scipy.spatial.transform import Rotation

    cameras, images, none = {}, {}, np.zeros(0, np.int64)
    for number, view in enumerate(views, start=1):
        c, pose = view.camera, view.camera.cam_from_world
        cameras[number] = ModelCamera(number, "PINHOLE", c.width, c.height, (c.fx, c.fy, c.cx, c.cy))
        qvec = np.roll(Rotation.from_matrix(pose[:3, :3]).as_quat(), 1)
        images[number] = ModelImage(number, qvec, pose[:3, 3], number, view.name, np.zeros((0, 2)), none)
    write_model(folder, ColmapModel(cameras, images, points_without_tracks(points.xyz, points.rgb)))


def _write_cameras(path: Path, cameras: Iterable[ModelCamera]) -> None:
    """Write cameras.bin, ordered by id."""
    ordered = sorted(cameras, key=lambda c: c.camera_id)
    parts = [struct.pack("<Q", len(ordered))]
    for c in ordered:
        parts.append(struct.pack("<iiQQ", c.camera_id, MODELS[c.model][0], c.width, c.height))
        parts.append(struct.pack(f"<{len(c.params)}d", *c.params))
    write_bytes(path, parts)


def _write_images(path: Path, images: Iterable[ModelImage]) -> None:
    """Write images.bin, ordered by id."""
    ordered = sorted(images, key=lambda i: i.image_id)
    parts = [struct.pack("<Q", len(ordered))]
    for image in ordered:
        parts.append(struct.pack("<i7di", image.image_id, *image.qvec, *image.tvec, image.camera_id))
        parts.append(image.name.encode("utf-8", errors="surrogateescape") + b"\0")
        rows = np.empty(len(image.xys), _OBSERVATION)
        rows["xy"], rows["point"] = image.xys, image.point_ids
        parts += [struct.pack("<Q", len(rows)), rows.tobytes()]
    write_bytes(path, parts)


def _write_points(path: Path, points: ModelPoints) -> None:
    """Write points3D.bin, in the order given."""
    tracks = np.stack([points.track_image_ids, points.track_point2d], axis=1).astype("<i4")
    rows = np.zeros(len(points.ids), _POINT_ROW)
    rows["id"], rows["error"], rows["track"] = points.ids, points.error_px, np.diff(points.track_offsets)
    rows["xyz"], rows["rgb"] = points.xyz, points.rgb
    parts = [struct.pack("<Q", len(rows)), rows.tobytes()]
    if len(tracks):
        size, heads = _POINT_ROW.itemsize, parts.pop()
        for i, (start, end) in enumerate(pairwise(points.track_offsets)):
            parts += [heads[i * size : (i + 1) * size], tracks[start:end].tobytes()]
    write_bytes(path, parts)
