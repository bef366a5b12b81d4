"""Where Gaussians belong: a skybox behind the scene, and nothing close before a camera.

SfM points lie on the scene alone. What the photos show behind it (a dark room, the sky) is else explained
by haze: large, faint Gaussians anywhere before the cameras, which a test photo sees from the side. A skybox
is that of Kerbl et al., "A Hierarchical 3D Gaussian Representation", SIGGRAPH 2024. Here it is coarse, and
density control leaves it alone: it learns light, not the distractors that stand before it.

Close before a camera lie floaters that explain one photo and that no other photo corrects. What lies in a
camera's picture nearer than a share of its nearest SfM points becomes transparent. While density control
works, it removes it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.placing import inside, projected
from ambiguous_wild.splat.effects.tracks import tracks_of
from ambiguous_wild.splat.gaussians import LEAST_POINTS, Gaussians
from ambiguous_wild.splat.step import Step, TrainData

RADIUS = 8.0  # times the distance of the farthest camera, or of 99 % of the SfM points, from their middle
COUNT = 4000  # on the whole sphere, some 3 degrees apart; those that a photo looks at are used
LEAST = 100  # with fewer on the whole sphere there is no skybox
BLUR = 0.05  # of a photo's longer side, around the place where a colour is read
PHOTOS = 200  # that colours are read from, at most


class Skybox(Effect):
    """Acts on the first Gaussians, and keeps their number."""

    name = "skybox"

    def __init__(self) -> None:
        self.count = 0

    def setup(self, data: TrainData) -> None:
        middle, radius = sphere_of(data.cameras, data.scene.points.xyz)
        self._middle = torch.from_numpy(middle.astype(np.float32)).to(data.device)
        self._inner = 0.5 * radius

    def spared(self, means: Tensor) -> Tensor:
        if not self.count:  # what lies so far out is an outlier of SfM
            return super().spared(means)
        return torch.linalg.vector_norm(means - self._middle, dim=1) > self._inner

    def first_points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        middle, radius = sphere_of(data.cameras, data.scene.points.xyz)
        views = range(0, len(data.photos), -(-len(data.photos) // PHOTOS))
        count, self.count = COUNT, 0
        while count >= LEAST:
            xyz = middle + radius * spread(count)
            looks = [_look(data, view, xyz) for view in views]
            seen = np.unique(np.concatenate([rows for rows, _, _ in looks]))
            if LEAST_POINTS <= len(seen) <= most:
                self.count = len(seen)
                return xyz[seen], _colours(data, views, looks, len(xyz))[seen]
            count //= 2  # coarser, instead of a part of the sphere
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)

    def facts(self) -> dict[str, Any]:
        return {"points": self.count}


def sphere_of(cameras: list[Camera], xyz: np.ndarray) -> tuple[np.ndarray, float]:
    """Middle [3] and radius of the skybox, world.

    Args:
        cameras: of the train photos.
        xyz: [M, 3] SfM points; their farthest hundredth may be wrong and is not asked.
    """
    middle = np.median(xyz, axis=0)
    centres = np.stack([c.center for c in cameras])
    points = float(np.quantile(np.linalg.norm(xyz - middle, axis=1), 0.99))
    return middle, RADIUS * max(points, float(np.linalg.norm(centres - middle, axis=1).max()))


def spread(count: int) -> np.ndarray:
    """Unit vectors [count, 3], evenly spread (a Fibonacci lattice)."""
    k = np.arange(count) + 0.5
    angle, z = k * np.pi * (3.0 - np.sqrt(5.0)), 1.0 - 2.0 * k / count
    flat = np.sqrt(1.0 - z * z)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)


def _look(data: TrainData, view: int, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [M, 3] that a photo shows where the capture does not mask it: their rows, and pixels u, v."""
    camera = data.cameras[view]
    pixels, z = projected(torch.from_numpy(xyz), camera)
    rows = np.flatnonzero(inside(pixels, z, camera, margin=0.0).numpy())
    u, v = pixels.numpy()[rows].astype(int).T
    u, v = u.clip(max=camera.width - 1), v.clip(max=camera.height - 1)
    keep = data.user_keep[view]
    if keep is not None:  # what the capture masks is no background
        kept = keep.cpu().numpy()[v, u] > 0.5
        rows, u, v = rows[kept], u[kept], v[kept]
    return rows, u, v


def _colours(
    data: TrainData, views: range, looks: list[tuple[np.ndarray, np.ndarray, np.ndarray]], count: int
) -> np.ndarray:
    """Median colour [count, 3] uint8 of the photos that look at a point; 0 where none does."""
    found = np.full((len(views), count, 3), np.nan, np.float32)
    for k, (view, (rows, u, v)) in enumerate(zip(views, looks, strict=True)):
        photo = data.photos[view].cpu().numpy()
        side = max(int(BLUR * max(photo.shape[:2])), 1)
        found[k, rows] = cv2.blur(photo, (side, side))[v, u]
    median = np.ma.median(np.ma.masked_invalid(found), axis=0).filled(0.0)
    return np.clip(np.rint(median * 255.0), 0, 255).astype(np.uint8)


SHARE = 0.6  # of the depth of the nearest points
NEAREST = 0.02  # quantile of depths that stands for them
FEW_POINTS = 20  # a camera with fewer says nothing
EVERY = 50  # iterations
GONE = -9.0  # logit of opacity: Adam does not bring it back above what density control removes in a round


class NearSpace(Effect):
    """Keeps the space before every train camera empty."""

    name = "near"

    def setup(self, data: TrainData) -> None:
        xyz = data.scene.points.xyz
        self.empty: list[tuple[Camera, float]] = []  # camera, depth up to which nothing belongs
        for camera, seen in zip(data.cameras, tracks_of(data.scene)):
            depth = xyz[seen] @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
            depth = depth[depth > 0]
            if len(depth) >= FEW_POINTS:
                self.empty.append((camera, SHARE * float(np.quantile(depth, NEAREST))))

    @torch.no_grad()
    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        if step.iteration % EVERY == 0:
            gaussians.opacity_logits[self.holds(gaussians.means)] = GONE

    def holds(self, means: Tensor) -> Tensor:
        """[N] bool of means [N, 3]: in the empty space of any camera."""
        found = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        for camera, depth in self.empty:
            pixels, z = projected(means, camera)
            found |= inside(pixels, z, camera, margin=0.0) & (z < depth)
        return found

    def facts(self) -> dict[str, Any]:
        return {"cameras": len(self.empty)}
