"""A skybox: Gaussians on a far sphere behind the scene.

SfM points lie on the scene alone. What the photos show behind it (a dark room, the sky) would be explained by
haze: large, faint Gaussians anywhere in front of the cameras, which a test photo sees from the side. The
skybox follows Kerbl et al., "A Hierarchical 3D Gaussian Representation", SIGGRAPH 2024. Here it is coarse,
and density control does not change it: it learns light, not the distractors in front of it.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import Facts
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.geometry import inside, projected
from ambiguous_wild.splat.gaussians import MIN_POINTS
from ambiguous_wild.splat.step import TrainData

RADIUS = 8.0  # times the distance of the farthest camera, or of 99 % of the SfM points, from their middle
COUNT = 4000  # points on the whole sphere, some 3 degrees apart; those in a photo are used
MIN_SPHERE_POINTS = 100  # a sphere with fewer points is not used
BLUR = 0.05  # size of the window that a colour is averaged over, as a share of a photo's longer side
PHOTOS = 200  # largest number of photos that colours are read from


class Skybox(Effect):
    """Adds first Gaussians on a far sphere, which density control must not change."""

    name = "skybox"

    def __init__(self) -> None:
        self.count = 0

    def setup(self, data: TrainData) -> None:
        middle, radius = skybox_sphere(data.cameras, data.scene.points.xyz)
        self._middle = torch.from_numpy(middle.astype(np.float32)).to(data.device)
        self._inner = 0.5 * radius

    def frozen_in_density_control(self, means: Tensor) -> Tensor:
        if not self.count:  # without a skybox, points so far out are outliers of SfM
            return super().frozen_in_density_control(means)
        return torch.linalg.vector_norm(means - self._middle, dim=1) > self._inner

    def first_points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        middle, radius = skybox_sphere(data.cameras, data.scene.points.xyz)
        views = range(0, len(data.photos), -(-len(data.photos) // PHOTOS))
        count, self.count = COUNT, 0
        while count >= MIN_SPHERE_POINTS:
            xyz = middle + radius * fibonacci_sphere(count)
            projections = [_project_into(data, view, xyz) for view in views]
            seen = np.unique(np.concatenate([rows for rows, _, _ in projections]))
            if MIN_POINTS <= len(seen) <= most:
                self.count = len(seen)
                return xyz[seen], _colours(data, views, projections, len(xyz))[seen]
            count //= 2  # a coarser sphere, instead of a part of one
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)

    def facts(self) -> Facts:
        return {"points": self.count}


def skybox_sphere(cameras: list[Camera], xyz: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the middle [3] and the radius of the skybox in the world.

    Args:
        cameras: cameras of the train photos.
        xyz: [M, 3] SfM points; the farthest hundredth may be wrong and is ignored. Without any, the cameras
            alone decide.
    """
    centres = np.stack([c.center for c in cameras])
    xyz = xyz if len(xyz) else centres
    middle = np.median(xyz, axis=0)
    points = float(np.quantile(np.linalg.norm(xyz - middle, axis=1), 0.99))
    return middle, RADIUS * max(points, float(np.linalg.norm(centres - middle, axis=1).max()))


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return unit vectors [count, 3], spread evenly (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    angle, z = k * np.pi * (3.0 - np.sqrt(5.0)), 1.0 - 2.0 * k / count
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _project_into(data: TrainData, view: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows of those points [M, 3] that a photo shows and does not mask, and their pixels u, v."""
    camera = data.cameras[view]
    pixels, z = projected(torch.from_numpy(xyz), camera)
    rows = np.flatnonzero(inside(pixels, z, camera, margin=0.0).numpy())
    u, v = pixels.numpy()[rows].astype(int).T
    u, v = u.clip(max=camera.width - 1), v.clip(max=camera.height - 1)
    keep = data.user_keep[view]
    if keep is not None:  # masked pixels do not show the background
        kept = keep.cpu().numpy()[v, u] > 0.5
        rows, u, v = rows[kept], u[kept], v[kept]
    return rows, u, v


def _colours(
    data: TrainData, views: range, projections: list[tuple[np.ndarray, np.ndarray, np.ndarray]], count: int
) -> np.ndarray:
    """Return the median colour [count, 3] uint8 of each point in the photos; 0 where no photo shows it."""
    by_photo = np.full((len(views), count, 3), np.nan, np.float32)
    for k, (view, (rows, u, v)) in enumerate(zip(views, projections, strict=True)):
        photo = data.photos[view].cpu().numpy()
        side = max(int(BLUR * max(photo.shape[:2])), 1)
        by_photo[k, rows] = cv2.blur(photo, (side, side))[v, u]
    median = np.ma.median(np.ma.masked_invalid(by_photo), axis=0).filled(0.0)
    return np.clip(np.rint(median * 255.0), 0, 255).astype(np.uint8)
