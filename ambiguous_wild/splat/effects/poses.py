"""Pose refinement: a small rigid motion per train camera, learnt with the scene and pulled towards zero.

The renderer has no gradient for the camera and needs none: to move the camera is to move all Gaussians the
other way. Only the world direction in which a colour is looked up does not turn with the camera. So the
camera's gradient is a sum over the gradients of the Gaussians, less the part that went through this
direction.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.effects.base import Effect, RowAdam, exponential_decay, step_factor
from ambiguous_wild.splat.effects.device_cameras import PosedCamera, on_device, scaled
from ambiguous_wild.splat.effects.geometry import higher_harmonics
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import TrainData, ViewContext

RATE_PX, FINAL = 0.2, 0.01  # motion of a step in the picture, px, and the share that it decays to
BEGIN = 0.05  # share of the run before which renders are too poor to correct cameras
PULL = 1e-2  # share of the motion that each step with the photo takes back

Rows = Tensor | slice  # Gaussians that have a gradient; on an accelerator all


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
        self.rate = RATE_PX / float(np.median([camera.fx for camera in data.cameras]))  # rad, and depths

    def camera(self, context: ViewContext) -> Camera:
        assert context.view is not None
        if not self.adam.steps[context.view]:  # never moved: its row need not be read
            return context.camera
        full, row = self.cameras[context.view], self.adam.values[context.view]
        base = on_device(full, row.device, row.dtype)
        rotation, pose = so3_exp(row[:3]), base.viewmat[0].clone()
        pose[:3, :3] = rotation @ base.viewmat[0, :3, :3]
        pose[:3, 3] = rotation @ base.viewmat[0, :3, 3] + self.depth * row[3:]
        smaller = context.camera.width / full.width, context.camera.height / full.height
        return PosedCamera(context.camera, pose, scaled(base.intrinsics[0], *smaller))

    def pose(self, gaussians: Gaussians, gradients: Gradients, context: ViewContext) -> Mapping[str, Tensor]:
        assert context.view is not None
        row = self.adam.values[context.view]
        left = left_gradient(gaussians, context.camera, gradients)
        # the motion is exp(w), then the shift, so the shift's part of the gradient of w is subtracted
        rotation = left[:3] - torch.linalg.cross(self.depth * row[3:], left[3:])
        return {"motion": torch.cat([left_jacobian(row[:3]).T @ rotation, self.depth * left[3:]])}

    def step(
        self, effect_grads: Mapping[str, Tensor], context: ViewContext, skip_step: Tensor | None = None
    ) -> None:
        if context.progress < BEGIN or context.view is None:
            return
        row = self.adam.values[context.view]
        share = exponential_decay(1.0, FINAL, context.progress)
        self.adam.step(context.view, effect_grads["motion"], self.rate * share, skip_step)
        decay = PULL * share if skip_step is None else PULL * share * step_factor(skip_step, row)
        row *= 1 - decay  # decoupled from Adam's scaling, as weight decay is in AdamW

    def facts(self) -> Facts:
        angle = torch.rad2deg(self.adam.values[:, :3].norm(dim=1))
        return {
            "turned_deg_median": float(angle.median()),
            "shifted_median": float(self.depth * self.adam.values[:, 3:].norm(dim=1).median()),
        }

    def state_dict(self) -> State:
        return self.adam.state_dict()

    def load_state_dict(self, state: State) -> None:
        self.adam.load_state_dict(state)


@torch.no_grad()
def left_gradient(gaussians: Gaussians, camera: Camera, gradients: Gradients) -> Tensor:
    """Return dL/d(w, v) [6] float64 of a small further motion of the camera, x_cam + w x x_cam + v.

    Args:
        gaussians: Gaussians that were rendered.
        camera: camera that was rendered.
        gradients: gradients of that render; Gaussians without a gradient add nothing.
    """
    rows = backend_of(gaussians.device).visible_rows(
        lambda: (gradients.means.abs().sum(dim=1) + gradients.quats.abs().sum(dim=1)) > 0
    )
    means, d_means = gaussians.means[rows].double(), gradients.means[rows].double()
    if not len(means):  # no Gaussian has a gradient
        return torch.zeros(6, dtype=torch.float64, device=gaussians.device)
    there = on_device(camera, gaussians.device, torch.float64)
    rotation, move = there.viewmat[0, :3, :3], there.viewmat[0, :3, 3]
    geometric = d_means - _through_direction(gaussians, there.centre, gradients, rows)
    local = means @ rotation.T + move
    d_local = geometric @ rotation.T
    shift = (d_means @ rotation.T).sum(dim=0)  # a shift changes the direction too, like a shift of the means
    through_means = torch.linalg.cross(local, d_local).sum(dim=0)
    return torch.cat([through_means + rotation @ _rotation_of_quats(gaussians, gradients, rows), shift])


def _rotation_of_quats(gaussians: Gaussians, gradients: Gradients, rows: Rows) -> Tensor:
    """Return dL/dw [3] of a rotation of every Gaussian by w in world axes: dq = (0, w) q / 2."""
    q, d = gaussians.quats[rows].double(), gradients.quats[rows].double()
    v, dv = q[:, 1:], d[:, 1:]
    # <d, (0, w) q> with (0, w)(a, v) = (-w.v, a w + w x v)
    inner = -d[:, :1] * v + q[:, :1] * dv + torch.linalg.cross(v, dv)
    return 0.5 * inner.sum(dim=0)


def _through_direction(gaussians: Gaussians, centre: Tensor, gradients: Gradients, rows: Rows) -> Tensor:
    """Return the part of dL/dmeans [rows, 3] that went through the direction of the harmonics."""
    means = gaussians.means[rows]
    if gaussians.sh_degree == 0:
        return torch.zeros(means.shape, dtype=torch.float64, device=gaussians.device)
    used = gradients.sh_rest[rows]
    d_colour = gradients.sh0[rows] / SH_C0
    rest = gaussians.sh_rest[rows]
    # a coefficient that the render did not use has no gradient, whatever its value
    rest = torch.where(used.abs().amax(dim=(0, 2), keepdim=True) > 0, rest, torch.zeros_like(rest))
    with torch.enable_grad():
        means = means.detach().requires_grad_(True)
        direction = torch.nn.functional.normalize(means - centre.to(means), dim=1)
        shade = torch.einsum("nk,nkc->nc", higher_harmonics(direction, gaussians.sh_degree), rest)
        return torch.autograd.grad(shade, means, d_colour)[0].double()


def _hat(vector: Tensor) -> Tensor:
    """Return the matrix [3, 3] of x -> vector x x."""
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return torch.linalg.cross(vector.expand(3, 3), eye).T


def so3_exp(rotation: Tensor) -> Tensor:
    """Return exp(w) [3, 3] of a rotation vector [3], rad; smooth at zero, without reading values."""
    a, b, _ = _coefficients(rotation)
    cross = _hat(rotation)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + a * cross + b * cross @ cross


def left_jacobian(rotation: Tensor) -> Tensor:
    """Return J [3, 3] with exp(w + dw) = exp(J dw) exp(w)."""
    _, b, c = _coefficients(rotation)
    cross = _hat(rotation)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + b * cross + c * cross @ cross


def _coefficients(rotation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the angle t, 0-d each."""
    squared = (rotation * rotation).sum()
    angle = squared.sqrt()
    a = torch.sinc(angle / torch.pi)
    b = 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2
    # below 0.01 rad the difference loses digits; two terms of the series do not
    series = 1.0 / 6.0 - squared / 120.0
    c = torch.where(squared < 1e-4, series, (1.0 - a) / squared.clamp(min=1e-8))
    return a, b, c
