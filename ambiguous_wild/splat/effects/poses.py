"""Pose refinement: a small rigid motion per train camera, learnt with the scene, held near zero.

The renderer has no gradient for the camera and needs none: moving the camera is moving all Gaussians the
other way, except that the *world* direction in which a colour is looked up does not turn with the camera. So
the camera's gradient is a sum over the Gaussians' own gradients, less the part that went through direction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.effects.base import Effect, RowAdam, State, decayed, share_of
from ambiguous_wild.splat.effects.placing import higher_harmonics
from ambiguous_wild.splat.effects.posed import PosedCamera, left_jacobian, scaled, turned
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Shot, TrainData

RATE_PX, FINAL = 0.2, 0.01  # px a step of what a turn moves in the picture; decays to this share
BEGIN = 0.05  # of the run: before it the render is no evidence of where a camera stood
PULL = 1e-2  # a visit, towards the pose of the sparse model

Rows = Tensor | slice  # of the Gaussians: those that learnt, or on an accelerator all


class PoseRefinement(Effect):
    """x_cam' = exp(w) x_cam + d v: rotation vector w [3] rad and shift v [3] in median depths d."""

    name = "poses"

    def setup(self, data: TrainData) -> None:
        self.views = len(data.photos)
        centres = np.array([camera.center for camera in data.cameras])
        distance = np.linalg.norm(data.scene.points.xyz - centres.mean(axis=0), axis=1)
        self.depth = float(np.median(distance)) if len(distance) else 1.0
        self.adam = RowAdam(torch.zeros(self.views, 6, dtype=torch.float64, device=data.device))
        self.cameras = data.cameras
        # on an accelerator both lie beside the motions: a pose that the host composes is waited for
        self.poses = torch.from_numpy(np.stack([c.cam_from_world for c in data.cameras])).to(data.device)
        self.intrinsics = torch.from_numpy(np.stack([c.intrinsics for c in data.cameras])).to(data.device)
        self.rate = RATE_PX / float(np.median([camera.fx for camera in data.cameras]))  # rad, and of depth
        self.degree = 3

    def camera(self, shot: Shot) -> Camera:
        assert shot.view is not None
        view, camera = shot.view, shot.camera
        if not backend_of(self.adam.values.device).reads_at_once:
            return self._camera_there(view, camera)
        delta = self.adam.values[view].numpy()
        if not delta.any():
            return camera
        return replace(camera, cam_from_world=moved(camera.cam_from_world, delta[:3], self.depth * delta[3:]))

    def _camera_there(self, view: int, camera: Camera) -> Camera:
        if not self.adam.steps[view]:  # never moved; known without a look at its row
            return camera
        full, row = self.cameras[view], self.adam.values[view]
        turn = turned(row[:3])
        base = self.poses[view]
        pose = base.clone()
        pose[:3, :3] = turn @ base[:3, :3]
        pose[:3, 3] = turn @ base[:3, 3] + self.depth * row[3:]
        smaller = camera.width / full.width, camera.height / full.height
        return PosedCamera(camera, pose, scaled(self.intrinsics[view], *smaller))

    def pose(self, gaussians: Gaussians, gradients: Gradients, shot: Shot) -> Mapping[str, Tensor]:
        assert shot.view is not None
        row = self.adam.values[shot.view]
        if not backend_of(row.device).reads_at_once:
            return {"motion": self._gradient_there(gaussians, gradients, shot.camera, shot.view)}
        left = left_gradient(gaussians, shot.camera, gradients, self.degree)
        # the motion is exp(w) then the shift: about the present pose, the shift part of w is subtracted
        shift = torch.tensor(self.depth * row[3:].numpy())
        turn = left[:3] - torch.linalg.cross(shift, left[3:])
        turn = right_jacobian_transposed(row[:3]) @ turn
        return {"motion": torch.cat([turn, self.depth * left[3:]])}

    def _gradient_there(
        self, gaussians: Gaussians, gradients: Gradients, camera: Camera, view: int
    ) -> Tensor:
        pose = camera.pose if isinstance(camera, PosedCamera) else self.poses[view]
        centre = -pose[:3, 3] @ pose[:3, :3]
        left = _left_gradient(gaussians, pose, centre, gradients, slice(None), self.degree)
        row = self.adam.values[view]
        turn = left[:3] - torch.linalg.cross(self.depth * row[3:], left[3:])
        return torch.cat([left_jacobian(row[:3]).T @ turn, self.depth * left[3:]])

    def step(self, own: Mapping[str, Tensor], shot: Shot, called_off: Tensor | None = None) -> None:
        if shot.progress < BEGIN or shot.view is None:
            return
        row = self.adam.values[shot.view]
        share = decayed(1.0, FINAL, shot.progress)
        self.adam.step(shot.view, own["motion"], self.rate * share, called_off)
        pull = PULL * share if called_off is None else PULL * share * share_of(called_off, row)
        row *= 1 - pull  # decoupled from Adam's scaling, as weight decay is in AdamW

    def facts(self) -> dict[str, Any]:
        angle = torch.rad2deg(self.adam.values[:, :3].norm(dim=1))
        return {
            "turned_deg_median": float(angle.median()),
            "shifted_median": float(self.depth * self.adam.values[:, 3:].norm(dim=1).median()),
        }

    def state_dict(self) -> State:
        return self.adam.state_dict()

    def load_state_dict(self, state: State) -> None:
        self.adam.load_state_dict(state)


def moved(cam_from_world: np.ndarray, rotation: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """[4, 4]: the pose followed by a turn (rotation vector, rad) and a shift, both in camera axes."""
    from scipy.spatial.transform import Rotation

    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    motion[:3, 3] = shift
    return motion @ cam_from_world


def right_jacobian_transposed(rotation: Tensor) -> Tensor:
    """J^T [3, 3]: dL/dw of exp(w) from dL/d(a further small turn in camera axes)."""
    angle = float(rotation.norm())
    x, y, z = rotation.tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=rotation.dtype)
    if angle < 1e-6:
        a, b = 0.5, 1.0 / 6.0
    else:
        a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    # exp(w + dw) = exp(J dw) exp(w) with the left Jacobian J
    return (torch.eye(3, dtype=rotation.dtype) + a * cross + b * cross @ cross).T


@torch.no_grad()
def left_gradient(gaussians: Gaussians, camera: Camera, gradients: Gradients, degree: int) -> Tensor:
    """dL/d(turn, shift) [6] float64 of a further small motion of the camera frame: x_cam + w x x_cam + v.

    Args:
        gaussians: as rendered.
        camera: as rendered.
        gradients: of that render.
        degree: largest SH degree that the render may have used.
    """
    rows = torch.nonzero(gradients.means.abs().sum(dim=1) + gradients.quats.abs().sum(dim=1)).squeeze(1)
    if not len(rows):  # nothing in the picture learns from it
        return torch.zeros(6, dtype=torch.float64)
    pose = torch.as_tensor(camera.cam_from_world.copy(), device=gaussians.device)
    return _left_gradient(gaussians, pose, torch.as_tensor(camera.center), gradients, rows, degree).cpu()


@torch.no_grad()
def _left_gradient(
    gaussians: Gaussians, pose: Tensor, centre: Tensor, gradients: Gradients, rows: Rows, degree: int
) -> Tensor:
    """`left_gradient` from the Gaussians in `rows`; those without a gradient add nothing."""
    if not len(gaussians):
        return torch.zeros(6, dtype=torch.float64, device=gaussians.device)
    rotation, move = pose[:3, :3], pose[:3, 3]
    means = gaussians.means[rows].double()
    d_means = gradients.means[rows].double()
    geometric = d_means - _through_direction(gaussians, centre, gradients, rows, degree)
    local = means @ rotation.T + move
    d_local = geometric @ rotation.T
    shift = (d_means @ rotation.T).sum(dim=0)  # a shift does move the direction, as a mean would
    turn = torch.linalg.cross(local, d_local).sum(dim=0)
    return torch.cat([turn + rotation @ _of_quats(gaussians, gradients, rows), shift])


def _of_quats(gaussians: Gaussians, gradients: Gradients, rows: Rows) -> Tensor:
    """dL/dw [3] of turning every Gaussian by w in world axes: dq = (0, w) q / 2."""
    q, d = gaussians.quats[rows].double(), gradients.quats[rows].double()
    v, dv = q[:, 1:], d[:, 1:]
    # <d, (0, w) q> with (0, w)(a, v) = (-w.v, a w + w x v)
    inner = -d[:, :1] * v + q[:, :1] * dv + torch.linalg.cross(v, dv)
    return 0.5 * inner.sum(dim=0)


def _through_direction(
    gaussians: Gaussians, centre: Tensor, gradients: Gradients, rows: Rows, degree: int
) -> Tensor:
    """The part of dL/dmeans [rows, 3] that went through the direction of the harmonics."""
    degree = min(degree, gaussians.sh_degree)
    means = gaussians.means[rows]
    if degree == 0:
        return torch.zeros(means.shape, dtype=torch.float64, device=gaussians.device)
    used = gradients.sh_rest[rows]
    d_colour = gradients.sh0[rows] / SH_C0
    rest = gaussians.sh_rest[rows]
    # a coefficient that the render did not use has no gradient, whatever its value
    rest = torch.where(used.abs().amax(dim=(0, 2), keepdim=True) > 0, rest, torch.zeros_like(rest))
    with torch.enable_grad():
        means = means.detach().requires_grad_(True)
        direction = torch.nn.functional.normalize(means - centre.to(means), dim=1)
        count = (degree + 1) ** 2 - 1
        shade = torch.einsum("nk,nkc->nc", higher_harmonics(direction, degree), rest[:, :count])
        return torch.autograd.grad(shade, means, d_colour)[0].double()
