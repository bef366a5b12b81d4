"""motion.npz of a scene: features that fit the place in other train photos, and those that move."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.atomic import atomic_path

FILE = "motion.npz"  # in the scene's folder


@dataclass(frozen=True)
class MotionPoints:
    """Features of one photo that other train photos show too."""

    xy: np.ndarray  # [N, 2] float32, share of the photo's width and height
    static: np.ndarray  # [N] uint8, photos in which it is where the place puts it
    moving: np.ndarray  # [N] uint8, photos in which it fits another rigid motion, and not the place
    motion: np.ndarray  # [N] int16, from 1: features of the photo that move together; 0 = does not move

    @property
    def moves(self) -> np.ndarray:
        """[N] bool: more photos say that it moves than say that it does not."""
        return self.moving > self.static


def write_motion_points(path: Path, photos: Mapping[str, MotionPoints]) -> None:
    """Write the points of all photos, by the names that the scene gives them."""
    points = list(photos.values())
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file,
            names=np.array(list(photos), dtype=np.str_),
            counts=np.array([len(p.xy) for p in points], np.int64),
            xy=np.concatenate([np.zeros((0, 2), np.float32), *(p.xy for p in points)]),
            static=np.concatenate([np.zeros(0, np.uint8), *(p.static for p in points)]),
            moving=np.concatenate([np.zeros(0, np.uint8), *(p.moving for p in points)]),
            motion=np.concatenate([np.zeros(0, np.int16), *(p.motion for p in points)]),
        )


def read_motion_points(scene: Path) -> dict[str, MotionPoints]:
    """Name -> points, of a scene's folder; empty where it has no such file.

    Raises:
        AwError: the file is damaged.
    """
    path = scene / FILE
    if not path.is_file():
        return {}
    try:
        with np.load(path, allow_pickle=False) as file:
            names, counts = file["names"].tolist(), file["counts"]
            columns = [
                _column(file[name], dtype, counts.sum())
                for name, dtype in (("xy", "f4"), ("static", "u1"), ("moving", "u1"), ("motion", "i2"))
            ]
        if columns[0].shape[1:] != (2,) or len(names) != len(counts) or counts.min(initial=0) < 0:
            raise ValueError("its arrays do not fit together")
    except (ValueError, KeyError, OSError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise AwError(f"{path} is damaged ({error}); remove it, or build the scene again") from error
    parts = zip(*(np.split(column, np.cumsum(counts)[:-1]) for column in columns))
    return {str(name): MotionPoints(*part) for name, part in zip(names, parts)}


def _column(values: np.ndarray, dtype: str, length: int) -> np.ndarray:
    if values.dtype != np.dtype(dtype) or len(values) != length:
        raise ValueError("its arrays do not fit together")
    return values
