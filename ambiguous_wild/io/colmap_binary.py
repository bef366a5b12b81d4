"""COLMAP's binary model files; see `colmap_records` for what they hold."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.io.colmap_records import MODELS, ModelCamera, ModelImage, ModelPoints, model_of_id

_OBSERVATION = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_POINT = struct.Struct("<Q3d3BdQ")  # id, xyz, rgb, error, track length


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
        """A uint64 count of records; refused where that many cannot fit in what is left."""
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


def read_cameras(path: Path) -> dict[int, ModelCamera]:
    """cameras.bin."""
    reader, cameras = _Reader(path), {}
    for _ in range(reader.count(24)):
        camera_id, number, width, height = reader.unpack("<iiQQ")
        name, count = model_of_id(number, str(path))
        cameras[camera_id] = ModelCamera(camera_id, name, width, height, reader.unpack(f"<{count}d"))
    return cameras


def read_images(path: Path) -> dict[int, ModelImage]:
    """images.bin."""
    reader, images = _Reader(path), {}
    for _ in range(reader.count(73)):
        image_id, *pose, camera_id = reader.unpack("<i7di")
        name = reader.text()
        count = reader.count(_OBSERVATION.itemsize)
        rows = np.frombuffer(reader.take(count * _OBSERVATION.itemsize), dtype=_OBSERVATION)
        images[image_id] = ModelImage(
            image_id,
            np.array(pose[:4]),
            np.array(pose[4:]),
            camera_id,
            name,
            np.array(rows["xy"]).reshape(-1, 2),
            np.array(rows["point"]),
        )
    return images


def read_points(path: Path) -> ModelPoints:
    """points3D.bin."""
    reader = _Reader(path)
    total = reader.count(_POINT.size)
    ids, xyz = np.empty(total, np.int64), np.empty((total, 3))
    rgb, error = np.empty((total, 3), np.uint8), np.empty(total)
    offsets, tracks = np.zeros(total + 1, np.int64), []
    for i in range(total):
        row = _POINT.unpack(reader.take(_POINT.size))
        if row[0] >= 2**63:
            raise AwError(f"{path} is damaged: a point numbered {row[0]}; copy or build the model again")
        ids[i], xyz[i], rgb[i], error[i] = row[0], row[1:4], row[4:7], row[7]
        if row[8] * 8 > len(reader.data) - reader.at:
            raise AwError(f"{path} is damaged: point {row[0]} announces a track of {row[8]}")
        tracks.append(np.frombuffer(reader.take(row[8] * 8), dtype="<i4").reshape(-1, 2))
        offsets[i + 1] = offsets[i] + row[8]
    flat = np.concatenate(tracks).astype(np.int64) if tracks else np.zeros((0, 2), np.int64)
    return ModelPoints(ids, xyz, rgb, error, offsets, flat[:, 0], flat[:, 1])


def write_cameras(path: Path, cameras: Iterable[ModelCamera]) -> None:
    """Write cameras.bin, ordered by id."""
    ordered = sorted(cameras, key=lambda c: c.camera_id)
    parts = [struct.pack("<Q", len(ordered))]
    for c in ordered:
        parts.append(struct.pack("<iiQQ", c.camera_id, MODELS[c.model][0], c.width, c.height))
        parts.append(struct.pack(f"<{len(c.params)}d", *c.params))
    _write(path, parts)


def write_images(path: Path, images: Iterable[ModelImage]) -> None:
    """Write images.bin, ordered by id."""
    ordered = sorted(images, key=lambda i: i.image_id)
    parts = [struct.pack("<Q", len(ordered))]
    for image in ordered:
        parts.append(struct.pack("<i7di", image.image_id, *image.qvec, *image.tvec, image.camera_id))
        parts.append(image.name.encode("utf-8", errors="surrogateescape") + b"\0")
        rows = np.empty(len(image.xys), _OBSERVATION)
        rows["xy"], rows["point"] = image.xys, image.point_ids
        parts += [struct.pack("<Q", len(rows)), rows.tobytes()]
    _write(path, parts)


def write_points(path: Path, points: ModelPoints) -> None:
    """Write points3D.bin, in the order given."""
    tracks = np.stack([points.track_image_ids, points.track_point2d], axis=1).astype("<i4")
    parts = [struct.pack("<Q", len(points.ids))]
    for i in range(len(points.ids)):
        start, end = points.track_offsets[i], points.track_offsets[i + 1]
        head = (*points.xyz[i], *(int(v) for v in points.rgb[i]), points.error_px[i], end - start)
        parts += [_POINT.pack(points.ids[i], *head), tracks[start:end].tobytes()]
    _write(path, parts)


def _write(path: Path, parts: list[bytes]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(b"".join(parts))
