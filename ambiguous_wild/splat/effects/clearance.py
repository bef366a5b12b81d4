"""Gaussians that float right before a train camera, nearer than anything structure from motion saw there, go.

They explain one photo and no other: with few photos, or photos that look outward, nothing contradicts them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.step import Step, TrainData

NEAREST = 5.0  # percentile of the depths of a photo's points that counts as its nearest surface
FEWEST = 10  # points of a photo, or nothing is said about it
SHARE = 0.5  # of the nearest surface's depth that is empty
EVERY = 50  # iterations
FAINT = -6.0  # logit below what is drawn and what density control keeps


class Clearance(Effect):
    """Before each camera is empty space, up to a share of the depth of its nearest surface."""

    name = "clearance"

    def __init__(self) -> None:
        self.removed = 0

    def setup(self, data: TrainData) -> None:
        self.spaces = empty_spaces(data, SHARE)

    @torch.no_grad()
    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        if step.iteration % EVERY:
            return
        floats = held(self.spaces, gaussians.means) & (gaussians.opacity_logits > FAINT)
        self.removed += int(floats.sum())
        gaussians.opacity_logits.masked_fill_(floats, FAINT)

    def facts(self) -> dict[str, Any]:
        return {"removed": self.removed}

    def state_dict(self) -> dict[str, Any]:
        return {"removed": self.removed}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.removed = int(state["removed"])


def empty_spaces(data: TrainData, share: float) -> Tensor:
    """[V, 19] float32 of the train views with enough points: pose, intrinsics and size, depth of the space.

    Args:
        data: cameras and sparse points; without tracks, those that lie in a picture count as seen there.
        share: of the nearest surface's depth.
    """
    points = data.scene.points
    number = {view.name: k for k, view in enumerate(data.scene.views)}
    point = np.repeat(np.arange(len(points)), np.diff(points.track_offsets))
    rows = []
    for view, camera in zip(data.scene.train, data.cameras):
        world = camera.cam_from_world
        tracked = points.xyz[point[points.track_views == number[view.name]]]
        depth = _depths(tracked if len(tracked) >= FEWEST else points.xyz, camera)
        if len(depth) < FEWEST:
            continue
        size = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        rows.append(np.concatenate([world[:3].ravel(), size, [share * np.percentile(depth, NEAREST)]]))
    return torch.from_numpy(np.array(rows, np.float32).reshape(-1, 19)).to(data.device)


def _depths(xyz: np.ndarray, camera: Camera) -> np.ndarray:
    """Of the points [M, 3] that lie in the picture."""
    x, y, z = (xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]).T
    x, y, z = x[z > 0], y[z > 0], z[z > 0]
    column, line = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside: np.ndarray = z[(column >= 0) & (column <= camera.width) & (line >= 0) & (line <= camera.height)]
    return inside


def held(spaces: Tensor, means: Tensor) -> Tensor:
    """[N] bool: centres that lie in the empty space of a camera, within its picture."""
    found = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    for row in spaces:
        pose = row[:12].reshape(3, 4)
        x, y, z = (means @ pose[:, :3].T + pose[:, 3]).unbind(1)
        fx, fy, cx, cy, width, height, depth = row[12:]
        near = (z > 0) & (z < depth)
        column, line = fx * x + cx * z, fy * y + cy * z  # times z, which is above 0 where it counts
        found |= near & (column >= 0) & (column <= width * z) & (line >= 0) & (line <= height * z)
    return found
