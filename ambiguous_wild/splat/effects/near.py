"""No Gaussians close before a camera: floaters that explain one photo and that no other photo corrects.

What lies in a camera's picture nearer than a share of its nearest SfM points becomes transparent. While
density control works, it removes it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.placing import inside, projected
from ambiguous_wild.splat.effects.tracks import tracks_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.step import Step, TrainData

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
