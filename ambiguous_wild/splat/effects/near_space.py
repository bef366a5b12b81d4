"""The space close in front of the cameras, where nothing belongs: no floaters, no wrong SfM points.

Floaters there explain one photo, and no other photo corrects them. With the effect `near`, what lies in a
camera's picture nearer than a share of the depth of its nearest SfM points becomes transparent, and density
control, while it works, removes it. Every run leaves out start points there that other photos contradict.
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
SURE = 3  # train photos that must see a point, so that each is checked by two others
CONTRADICTIONS = 2  # photos that must contradict a point; one may have missed it
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
