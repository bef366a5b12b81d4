"""COLMAP's text model files; see `colmap_records` for what they hold."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ambiguous_wild.core.errors import AwError, unknown
from ambiguous_wild.io.colmap_records import MODELS, ModelCamera, ModelImage, ModelPoints


def read_cameras(path: Path) -> dict[int, ModelCamera]:
    """cameras.txt."""
    cameras = {}
    for number, fields in _rows(path):
        try:
            camera_id, model = int(fields[0]), fields[1]
            width, height = int(fields[2]), int(fields[3])
            params = tuple(float(v) for v in fields[4:])
        except (ValueError, IndexError) as error:
            raise _damaged(path, number) from error
        if model not in MODELS:
            raise unknown(f"camera model in {path}", model, MODELS)
        if len(params) != MODELS[model][1]:
            raise _damaged(path, number)
        cameras[camera_id] = ModelCamera(camera_id, model, width, height, params)
    return cameras


def read_images(path: Path) -> dict[int, ModelImage]:
    """images.txt: two lines an image; the second, of observations, may be empty."""
    lines = [(n, text) for n, text in enumerate(_lines(path), 1) if not text.startswith("#")]
    while lines and not lines[0][1].strip():
        lines.pop(0)
    images = {}
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
        images[image_id] = ModelImage(image_id, pose[:4], pose[4:], camera_id, name, table[:, :2].copy(), ids)
    return images


def read_points(path: Path) -> ModelPoints:
    """points3D.txt."""
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
    return path.read_text(encoding="utf-8", errors="surrogateescape").split("\n")


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, text in enumerate(_lines(path), 1):
        if text.strip() and not text.startswith("#"):
            yield number, text.split()


def _damaged(path: Path, number: int) -> AwError:
    return AwError(f"{path}, line {number}, is not what COLMAP writes; copy or build the model again")
