"""A scene as every reader returns it: posed views, sparse points, a split by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ambiguous_wild.core.camera import Camera

Split = Literal["train", "test"]


@dataclass(frozen=True)
class View:
    """One photo: where it lies, which camera took it, which side of the split it is on.

    Keep maps follow one convention everywhere: 1 = static (kept), 0 = transient.
    """

    name: str  # path relative to the image folder, as COLMAP and the split lists write it
    image_path: Path  # the file that is trained on or measured against, already downsampled
    camera: Camera  # of that file: intrinsics match its size
    split: Split
    keep_path: Path | None = None  # PNG, white = keep; the user's or the capture's own mask
    image_id: int = -1  # COLMAP's id, -1 where there is none


@dataclass(frozen=True)
class Points:
    """Sparse points of structure from motion with their tracks in compressed rows.

    Observation k of point i, for ``track_offsets[i] <= k < track_offsets[i + 1]``, is at
    ``track_xy[k]`` of the view ``views[track_views[k]]``.
    """

    xyz: np.ndarray  # [M, 3] float64, world
    rgb: np.ndarray  # [M, 3] uint8
    error_px: np.ndarray  # [M] float64, mean reprojection error at full size
    track_offsets: np.ndarray  # [M + 1] int64
    track_views: np.ndarray  # [L] int32, index into Scene.views; -1 = a view out of the split, or no position
    track_xy: np.ndarray  # [L, 2] float32, px of the *loaded* image of that view

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True)
class Scene:
    """Views in the order of their names, points, and where they came from."""

    root: Path
    name: str
    views: tuple[View, ...]
    points: Points
    info: dict[str, Any] = field(default_factory=dict, repr=False)  # scene.json, or what stands for it

    @cached_property
    def train(self) -> tuple[View, ...]:
        """Training views, ordered by name."""
        return tuple(v for v in self.views if v.split == "train")

    @cached_property
    def test(self) -> tuple[View, ...]:
        """Test views, ordered by name."""
        return tuple(v for v in self.views if v.split == "test")

    @cached_property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean (3DGS's scene extent).

        Test cameras do not enter: their poses are not known to a method that trains.
        """
        centers = np.array([v.camera.center for v in (self.train or self.views)])
        radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0))
        # A capture from one spot has no baseline; fall back on the points so that rates stay finite.
        if radius <= 0.0 and len(self.points):
            radius = float(np.median(np.linalg.norm(self.points.xyz - centers.mean(axis=0), axis=1)))
        return 1.1 * radius if radius > 0.0 else 1.0
