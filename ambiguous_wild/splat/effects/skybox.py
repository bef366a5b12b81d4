"""Where Gaussians belong: on a skybox behind the scene, and not close in front of a camera.

SfM points lie on the scene alone. What the photos show behind it (a dark room, the sky) would be explained by
haze: large, faint Gaussians anywhere in front of the cameras, which a test photo sees from the side. The
skybox follows Kerbl et al., "A Hierarchical 3D Gaussian Representation", SIGGRAPH 2024. Here it is coarse,
and density control does not change it: it learns light, not the distractors in front of it.

Close in front of a camera lie floaters that explain one photo and that no other photo corrects. What lies in
a camera's picture nearer than a share of the depth of its nearest SfM points becomes transparent, and density
control, while it works, removes it. Every run leaves out start points there that other photos contradict.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera, Scene
from ambiguous_wild.core.config import Facts
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.geometry import inside, projected
from ambiguous_wild.splat.effects.tracks import tracks_of
from ambiguous_wild.splat.gaussians import MIN_POINTS, Gaussians
from ambiguous_wild.splat.step import Step, TrainData

RADIUS = 8.0  # times the distance of the farthest camera, or of 99 % of the SfM points, from their middle
COUNT = 4000  # points on the whole sphere, some 3 degrees apart; those in a photo are used
MIN_SPHERE_POINTS = 100  # a sphere with fewer points is not used
BLUR = 0.05  # size of the window that a colour is averaged over, as a share of a photo's longer side
PHOTOS = 200  # largest number of photos that colours are read from
SHARE = 0.6  # share of the depth of the nearest points below which nothing belongs
NEAREST = 0.02  # quantile of depths that counts as that depth
FEW_POINTS = 20  # cameras with fewer points are ignored
EVERY = 50  # iterations
SURE = 3  # train photos that must see a point, so that each is checked by two others
CONTRADICTIONS = 2  # photos that must contradict a point; one may have missed it
GONE = -9.0  # logit of opacity, so low that density control removes the Gaussian before Adam can raise it


class Skybox(Effect):
    """Adds first Gaussians on a far sphere, which density control must not change."""

    name = "skybox"

    def __init__(self) -> None:
        self.count = 0

    def setup(self, data: TrainData) -> None:
        middle, radius = sphere_of(data.cameras, data.scene.points.xyz)
        self._middle = torch.from_numpy(middle.astype(np.float32)).to(data.device)
        self._inner = 0.5 * radius

    def frozen_in_density_control(self, means: Tensor) -> Tensor:
        if not self.count:  # without a skybox, points so far out are outliers of SfM
            return super().frozen_in_density_control(means)
        return torch.linalg.vector_norm(means - self._middle, dim=1) > self._inner

    def first_points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        middle, radius = sphere_of(data.cameras, data.scene.points.xyz)
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


def sphere_of(cameras: list[Camera], xyz: np.ndarray) -> tuple[np.ndarray, float]:
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


class NearSpace(Effect):
    """Keeps the space in front of every train camera empty."""

    name = "near"

    def setup(self, data: TrainData) -> None:
        depths = nearest_depths(data.cameras, data.scene.points.xyz, tracks_of(data.scene))
        # camera, depth up to which nothing belongs
        self.empty = [(camera, depth) for camera, depth in zip(data.cameras, depths, strict=True) if depth]

    @torch.no_grad()
    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        if step.iteration % EVERY == 0:
            gaussians.opacity_logits[self.holds(gaussians.means)] = GONE

    def holds(self, means: Tensor) -> Tensor:
        """Return which means [N, 3] lie in the empty space of any camera, [N] bool."""
        inside_any = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        for camera, depth in self.empty:
            pixels, z = projected(means, camera)
            inside_any |= inside(pixels, z, camera, margin=0.0) & (z < depth)
        return inside_any

    def facts(self) -> Facts:
        return {"cameras": len(self.empty)}


def nearest_depths(cameras: Sequence[Camera], xyz: np.ndarray, seen: Sequence[np.ndarray]) -> list[float]:
    """Return for each camera the depth up to which nothing belongs; 0 where it sees too few points.

    Args:
        cameras: cameras of the train photos.
        xyz: [M, 3] SfM points.
        seen: for each camera, the rows of the points that it sees.
    """
    depths = []
    for camera, rows in zip(cameras, seen, strict=True):
        depth = xyz[rows] @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
        depth = depth[depth > 0]
        depths.append(SHARE * float(np.quantile(depth, NEAREST)) if len(depth) >= FEW_POINTS else 0.0)
    return depths


def contradicted_points(scene: Scene) -> np.ndarray:
    """Return the SfM points [M] bool that no third train photo confirms and that other photos contradict.

    A photo contradicts a point that it should show, and does not, nearer than what it surely shows: than
    `SHARE` of the depth of its nearest points of at least `SURE` train photos. Such points are distractors
    that passed close to the cameras, and wrong matches. Where masks hide them, the loss corrects nothing,
    and they veil a test view between the train photos.
    """
    xyz, seen = scene.points.xyz, tracks_of(scene)
    photos = np.bincount(np.concatenate([np.zeros(0, np.int64), *seen]), minlength=len(xyz))
    sure = photos >= SURE
    cameras = [view.camera for view in scene.train]
    contradictions = np.zeros(len(xyz), np.int64)
    depths = nearest_depths(cameras, xyz, [rows[sure[rows]] for rows in seen])
    for camera, own, depth in zip(cameras, seen, depths, strict=True):
        asked = ~sure
        asked[own] = False
        rows = np.flatnonzero(asked)
        local = camera.to_camera(xyz[rows])
        near = (local[:, 2] > 0) & (local[:, 2] < depth)
        (x, y, z), rows = local[near].T, rows[near]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        contradictions[rows] += (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
    return contradictions >= CONTRADICTIONS
