"""The space close in front of the cameras, where nothing belongs: no floaters, no wrong SfM points.

Floaters there explain one photo, and no other photo corrects them. With the effect `near`, what lies in a
camera's picture nearer than a share of the depth of its nearest SfM points becomes transparent, and density
control, while it works, removes it. Every run leaves out start points that violate the free space of other
photos.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera, Scene
from ambiguous_wild.core.config import Facts
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.geometry import inside, projected
from ambiguous_wild.splat.effects.tracks import tracks_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.step import Step, TrainData

SHARE = 0.6  # share of the depth of the nearest points below which nothing belongs
NEAREST = 0.02  # quantile of depths that counts as that depth
FEW_POINTS = 20  # cameras with fewer points are ignored
EVERY = 50  # iterations
MIN_TRACK = 3  # train photos that must see a point, so that each is checked by two others
VIOLATED = 2  # photos whose free space a point must violate; one may have missed it
GONE = -9.0  # logit of opacity, so low that density control removes the Gaussian before Adam can raise it


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


def free_space_violations(scene: Scene, keeps: Sequence[Tensor | None]) -> np.ndarray:
    """Return the SfM points [M] bool that lie in space which other photos show to be free.

    Points of fewer than `MIN_TRACK` train photos are judged by the others. Such a point is in free space for
    a photo that does not see it if it lies nearer than `SHARE` of the depth of the nearest of these in that
    photo, and than `SHARE` of all corners of the triangle of these (Delaunay) that it lies in: ground at the
    lower border has none below it. `VIOLATED` such photos are needed. Such points are distractors that passed
    close to the cameras, and wrong matches. Where masks hide them, the loss corrects nothing, and they are
    floaters in a test view between the train photos.

    Args:
        scene: scene with tracks.
        keeps: keep map [H, W] of each train photo, or None.
    """
    xyz, seen = scene.points.xyz, tracks_of(scene)
    length = np.bincount(np.concatenate([np.zeros(0, np.int64), *seen]), minlength=len(xyz))
    tracked = length >= MIN_TRACK
    cameras = [view.camera for view in scene.train]
    violated = np.zeros(len(xyz), np.int64)
    judges = [rows[tracked[rows]] for rows in seen]
    for camera, own, judge, depth, keep in zip(
        cameras, seen, judges, nearest_depths(cameras, xyz, judges), keeps, strict=True
    ):
        others = ~tracked
        others[own] = False
        rows = np.flatnonzero(others)
        pixels, z = camera.project(xyz[rows])
        near = (z > 0) & (z < depth)
        if not near.any():
            continue
        rows, pixels, z = rows[near], pixels[near], z[near]
        free = z < SHARE * depth_around(pixels, xyz[judge], camera)
        free &= ((pixels >= 0) & (pixels <= (camera.width, camera.height))).all(axis=1)
        if keep is not None:  # the photo's features there were not matched
            column, row = pixels.clip(0, (camera.width - 1, camera.height - 1)).astype(int).T
            free &= keep.cpu().numpy()[row, column] > 0.5
        violated[rows] += free
    return violated >= VIOLATED


def depth_around(pixels: np.ndarray, xyz: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the least depth of the triangle of points [M, 3] around each pixel, [N]; 0 outside of all."""
    from scipy.spatial import Delaunay, QhullError

    corners, z = camera.project(xyz)
    corners, z = corners[z > 0], z[z > 0]
    try:
        mesh = Delaunay(corners)
    except QhullError:  # all in a line
        return np.zeros(len(pixels))
    triangle = mesh.find_simplex(pixels)
    return np.where(triangle < 0, 0.0, z[mesh.simplices[triangle]].min(axis=1))
