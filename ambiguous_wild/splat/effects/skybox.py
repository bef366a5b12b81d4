"""A skybox: Gaussians on a far sphere, which explain what lies behind the scene.

SfM points lie on the scene alone. What the photos show behind it (a dark room, the sky) is else explained by
haze: large, faint Gaussians anywhere before the cameras, which a test photo sees from the side. A skybox is
that of Kerbl et al., "A Hierarchical 3D Gaussian Representation", SIGGRAPH 2024. Here it is coarse, and
density control leaves it alone: it learns light, not the distractors that stand before it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.step import TrainData

if TYPE_CHECKING:
    from ambiguous_wild.splat.parts import Parts

RADIUS = 8.0  # times the distance of the farthest camera, or SfM point, from the middle of the points
COUNT = 4000  # on the whole sphere, some 3 degrees apart; those that a photo looks at are used
LEAST = 100  # with fewer on the whole sphere there is no skybox
BLUR = 0.05  # of a photo's longer side, around the place where a colour is read
PHOTOS = 200  # that colours are read from, at most


class Skybox(Effect):
    """Acts on the first Gaussians, and keeps their number."""

    name = "skybox"

    def __init__(self) -> None:
        self.count = 0

    def change_parts(self, parts: Parts) -> Parts:
        return parts.with_more_points(self.points)

    def setup(self, data: TrainData) -> None:
        middle, radius = sphere_of(data.cameras, data.scene.points.xyz)
        self._middle = torch.from_numpy(middle.astype(np.float32)).to(data.device)
        self._inner = 0.5 * radius

    def spared(self, means: Tensor) -> Tensor:
        return torch.linalg.vector_norm(means - self._middle, dim=1) > self._inner

    def points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        """xyz [M, 3] and rgb [M, 3] uint8 of at most so many points."""
        middle, radius = sphere_of(data.cameras, data.scene.points.xyz)
        views = range(0, len(data.photos), -(-len(data.photos) // PHOTOS))
        count, xyz, rgb = COUNT, np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        while count >= LEAST:
            directions = spread(count)
            colours = _colours(data, views, middle + radius * directions)
            seen = np.isfinite(colours).all(axis=1)
            if seen.sum() <= most:
                xyz = (middle + radius * directions)[seen]
                rgb = np.clip(np.rint(colours[seen] * 255.0), 0, 255).astype(np.uint8)
                break
            count //= 2  # coarser, instead of a part of the sphere
        self.count = len(xyz)
        return xyz, rgb

    def facts(self) -> dict[str, Any]:
        return {"points": self.count}


def sphere_of(cameras: list[Camera], xyz: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle [3] and radius of the skybox, world.

    Args:
        cameras: of the train photos.
        xyz: [M, 3] SfM points; their farthest hundredth may be wrong and is not asked.
    """
    middle = np.median(xyz, axis=0)
    centres = np.stack([-c.cam_from_world[:3, :3].T @ c.cam_from_world[:3, 3] for c in cameras])
    points = float(np.quantile(np.linalg.norm(xyz - middle, axis=1), 0.99))
    return middle, RADIUS * max(points, float(np.linalg.norm(centres - middle, axis=1).max()))


def spread(count: int) -> np.ndarray:
    """Unit vectors [count, 3], evenly spread (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    angle, z = k * np.pi * (3.0 - np.sqrt(5.0)), 1.0 - 2.0 * k / count
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _colours(data: TrainData, views: range, xyz: np.ndarray) -> np.ndarray:
    """Median colour [M, 3] of the photos that look at points [M, 3]; NaN where none does."""
    found = np.full((len(views), len(xyz), 3), np.nan, np.float32)
    for row, view in enumerate(views):
        camera, photo = data.cameras[view], data.photos[view].cpu().numpy()
        height, width = photo.shape[:2]
        side = max(int(BLUR * max(width, height)), 1)
        blurred = cv2.blur(photo, (side, side))
        local = xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            u = (camera.fx * local[:, 0] / local[:, 2] + camera.cx) * width / camera.width
            v = (camera.fy * local[:, 1] / local[:, 2] + camera.cy) * height / camera.height
        inside = (local[:, 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        rows, u, v = np.flatnonzero(inside), u[inside].astype(int), v[inside].astype(int)
        keep = data.user_keep[view]
        if keep is not None:  # what the capture masks is no background
            kept = keep.cpu().numpy()[v, u] > 0.5
            rows, u, v = rows[kept], u[kept], v[kept]
        found[row, rows] = blurred[v, u]
    with np.errstate(all="ignore"):
        return np.asarray(np.ma.median(np.ma.masked_invalid(found), axis=0).filled(np.nan))
