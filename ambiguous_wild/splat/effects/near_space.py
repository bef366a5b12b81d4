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

    A point of fewer than `MIN_TRACK` train photos is in free space for another photo if it lies in its frame,
    not under its keep mask, nearer than `SHARE` of the depth of the nearest points of longer tracks that this
    photo sees. `VIOLATED` such photos are needed. Such points are distractors that passed close to the
    cameras, and wrong matches. Where masks hide them, the loss corrects nothing, and they are floaters in a
    test view between the train photos.

    Args:
        scene: scene with tracks.
        keeps: keep map [H, W] of each train photo, or None.
    """
    xyz, seen = scene.points.xyz, tracks_of(scene)
    length = np.bincount(np.concatenate([np.zeros(0, np.int64), *seen]), minlength=len(xyz))
    tracked = length >= MIN_TRACK
    cameras = [view.camera for view in scene.train]
    violated = np.zeros(len(xyz), np.int64)
    depths = nearest_depths(cameras, xyz, [rows[tracked[rows]] for rows in seen])
    for camera, own, depth, keep in zip(cameras, seen, depths, keeps, strict=True):
        others = ~tracked
        others[own] = False
        rows = np.flatnonzero(others)
        local = camera.to_camera(xyz[rows])
        near = (local[:, 2] > 0) & (local[:, 2] < depth)
        (x, y, z), rows = local[near].T, rows[near]
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside_frame = (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        if keep is not None:  # the photo's features there were not matched
            row, column = v.clip(0, camera.height - 1).astype(int), u.clip(0, camera.width - 1).astype(int)
            inside_frame &= keep.cpu().numpy()[row, column] > 0.5
        violated[rows] += inside_frame
    return violated >= VIOLATED
