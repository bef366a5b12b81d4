"""motion.npz of a scene: features that are static by other train photos, and features that move.

In a sequence it also has votes of neighbouring frames for every pixel, by `builder/residual_flow.py`.
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.files import atomic_path

FILE = "motion.npz"  # in the scene's folder
_COLUMNS = {"xy": ("f4", (2,)), "static": ("u1", ()), "moving": ("u1", ()), "motion": ("i2", ())}
_MAX_BYTES = 1 << 30  # largest unpacked size; a thousand photos have about 2e7, of a sequence 6e7
# Exceptions that numpy and zipfile raise for a damaged file, besides their own.
_DAMAGE = (ValueError, LookupError, OSError, EOFError, TypeError, AttributeError, RuntimeError, MemoryError,
           OverflowError)  # fmt: skip


@dataclass(frozen=True)
class MotionPoints:
    """Features of one photo that other train photos show too, and votes on its pixels."""

    xy: np.ndarray  # [N, 2] float32, share of the photo's width and height
    static: np.ndarray  # [N] uint8, photos in which it lies where the static scene puts it
    # [N] uint8, photos in which it fits only another rigid motion, or that see through it
    moving: np.ndarray
    motion: np.ndarray  # [N] int16, from 1: features of the photo that move together; 0 = does not move
    # [2, h, w] uint8, neighbouring frames whose optical flow shows that a pixel stays, and that it moves;
    # None: the photo is of no sequence
    flow: np.ndarray | None = None

    @property
    def informative(self) -> bool:
        """Whether any feature or pixel has a vote."""
        return bool(len(self.xy)) or (self.flow is not None and bool(self.flow.any()))

    @property
    def moves(self) -> np.ndarray:
        """[N] bool: more photos call the feature moving than static."""
        return self.moving > self.static


NO_POINTS = MotionPoints(*(np.zeros((0, *shape), dtype) for dtype, shape in _COLUMNS.values()))


def write_motion_points(path: Path, photos: Mapping[str, MotionPoints]) -> None:
    """Write the points of all photos, by their names in the scene."""
    points = list(photos.values())
    columns: dict[str, Any] = {
        name: np.concatenate([np.zeros((0, *shape), dtype), *(getattr(p, name) for p in points)])
        for name, (dtype, shape) in _COLUMNS.items()
    }
    names, counts = np.array(list(photos), dtype=np.str_), np.array([len(p.xy) for p in points], np.int64)
    if any(p.flow is not None for p in points):
        flows = [np.zeros((2, 0, 0), np.uint8) if p.flow is None else p.flow for p in points]
        columns["flow_shapes"] = np.array([flow.shape[1:] for flow in flows], np.int64)
        columns["flow"] = np.concatenate([flow.ravel() for flow in flows])
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, names=names, counts=counts, **columns)


def read_motion_points(scene: Path) -> dict[str, MotionPoints]:
    """Read name -> points from a scene's folder; empty where it has no such file.

    Raises:
        AwError: the file is damaged.
    """
    path = scene / FILE
    if not path.is_file():
        return {}
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > _MAX_BYTES:
                raise ValueError("it is too large")
        with np.load(path, allow_pickle=False) as file:
            return _read(file)
    except (*_DAMAGE, zlib.error, zipfile.BadZipFile) as error:
        raise AwError(f"{path} is damaged ({error}); build the scene again") from error


def _read(file: Mapping[str, np.ndarray]) -> dict[str, MotionPoints]:
    names, counts = file["names"], file["counts"]
    total = int(counts.sum())
    columns = [file[name] for name in _COLUMNS]
    fit = names.dtype.kind == "U" and counts.dtype == np.int64 and counts.ndim == 1
    fit = fit and names.shape == counts.shape and counts.min(initial=0) >= 0
    fit = fit and len(set(names.tolist())) == len(names)
    for column, (dtype, shape) in zip(columns, _COLUMNS.values()):
        fit = fit and column.dtype == np.dtype(dtype) and column.shape == (total, *shape)
    if not fit or not ((columns[0] >= 0) & (columns[0] <= 1)).all():
        raise ValueError("its arrays do not fit together")
    parts = [np.split(column, np.cumsum(counts)[:-1]) for column in columns]
    flows = _read_flows(file, len(names)) if "flow" in file else [None] * len(names)
    return {name: MotionPoints(*part) for name, *part in zip(names.tolist(), *parts, flows)}


def _read_flows(file: Mapping[str, np.ndarray], count: int) -> list[np.ndarray | None]:
    """Read the votes [2, h, w] of each photo; None where it has none."""
    shapes, flow = file["flow_shapes"], file["flow"]
    fit = shapes.dtype == np.int64 and shapes.shape == (count, 2)
    fit = fit and shapes.min(initial=0) >= 0 and shapes.max(initial=0) <= 1 << 15
    if not fit or flow.dtype != np.uint8 or flow.shape != (2 * int(shapes.prod(axis=1).sum()),):
        raise ValueError("its arrays do not fit together")
    parts = np.split(flow, np.cumsum(2 * shapes.prod(axis=1))[:-1])
    return [p.reshape(2, *shape) if p.size else None for p, shape in zip(parts, shapes.tolist())]
