"""Removes floaters close in front of the cameras.

Floaters there explain one photo, and no other photo corrects them. With the effect `near`, what lies in a
camera's picture nearer than a share of the depth of its nearest SfM points becomes transparent, and density
control, while it works, removes it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import Facts
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.geometry import inside, projected
from ambiguous_wild.splat.effects.tracks import point_indices_by_photo
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.step import Step, TrainData

SHARE = 0.6  # share of the depth of the nearest points below which nothing belongs
NEAREST = 0.02  # quantile of depths that counts as that depth
FEW_POINTS = 20  # cameras with fewer points are ignored
EVERY = 50  # iterations
GONE = -9.0  # logit of opacity, so low that density control removes the Gaussian before Adam can raise it


class NearSpace(Effect):
    """Keeps the space in front of every train camera empty."""

    name = "near"

    def setup(self, data: TrainData) -> None:
        depths = nearest_depths(data.cameras, data.scene.points.xyz, point_indices_by_photo(data.scene))
        # camera, depth up to which nothing belongs
        self.empty = [(camera, depth) for camera, depth in zip(data.cameras, depths, strict=True) if depth]

    @torch.no_grad()
    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        if step.iteration % EVERY == 0:
            gaussians.opacity_logits[self.contains(gaussians.means)] = GONE

    def contains(self, means: Tensor) -> Tensor:
        """Return which means [N, 3] lie in the empty space of any camera, [N] bool."""
        inside_any = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        for camera, depth in self.empty:
            pixels, z = projected(means, camera)
            inside_any |= inside(pixels, z, camera, margin=0.0) & (z < depth)
        return inside_any

    def facts(self) -> Facts:
        return {"cameras": len(self.empty)}


def nearest_depths(cameras: Sequence[Camera], xyz: np.ndarray, seen: Sequence[np.ndarray]) -> list[float]:
    """Return for each camera the depth of its empty space; 0 where it sees too few points.

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
