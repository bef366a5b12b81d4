"""Mip-Splatting's 3D smoothing filter, with its 2D filter: no Gaussian smaller than any photo can resolve.

Source: Mip-Splatting (Yu et al., CVPR 2024), constants of its code. The screen blur stays the renderer's
0.3 px^2 instead of 0.1, with opacity compensated (gsplat's "antialiased").
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.geometry import pose_like
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import Gradients, Vjp
from ambiguous_wild.splat.step import TrainData, ViewContext

VARIANCE = 0.2  # variance of the filter, in squared sampling intervals
MARGIN = 0.15  # share of the picture by which it is widened on each side when points count as seen
NEAR = 0.2  # least depth that counts as seen
EVERY = 100  # iterations between filter sizes


class SmoothingFilter(Effect):
    """s' = sqrt(s^2 + f^2), o' = o sqrt(prod s^2 / prod (s^2 + f^2)); f from the nearest train camera."""

    name = "antialias"
    antialias = True

    def setup(self, data: TrainData) -> None:
        self.cameras = data.cameras
        self.size = torch.zeros(0, device=data.device)  # [N] f, world units
        self._stale = True  # whether rows have changed since the sizes were computed
        self._at = 0  # iteration of the sizes

    def model(self, gaussians: Gaussians, context: ViewContext) -> tuple[Gaussians, Vjp]:
        size = self.size
        due = self._stale or (not context.neutral and context.iteration - self._at >= EVERY)
        if due or context.other_gaussians:
            size = filter_sizes(gaussians.means, self.cameras)
            if not context.neutral and not context.other_gaussians:  # a probe must not change the state
                self.size, self._at, self._stale = size, context.iteration, False
        wide, share = filtered_variances(gaussians.log_scales, size)
        plain = torch.sigmoid(gaussians.opacity_logits)
        opacity = plain * share.prod(dim=1).sqrt()
        # the logit of an opaque Gaussian that is not widened would be infinite
        opacity = opacity.clamp(1e-7, 1 - 1e-6)

        def vjp(gradients: Gradients) -> Gradients:
            # dL/d log o', with o' (1 - o') the slope of the sigmoid
            d_log = gradients.opacity_logits / (1 - opacity)
            return replace(
                gradients,
                log_scales=(gradients.log_scales * share + d_log[:, None] * (1 - share)).contiguous(),
                opacity_logits=(d_log * (1 - plain)).contiguous(),
            )

        return replace(gaussians, log_scales=0.5 * wide.log(), opacity_logits=torch.logit(opacity)), vjp

    def rows_changed(self) -> None:
        self._stale = True

    def facts(self) -> Facts:
        return {"filter_size_median": float(self.size.median()) if len(self.size) else None}

    def state_dict(self) -> State:
        return {"size": self.size, "at": self._at, "stale": self._stale}

    def load_state_dict(self, state: State) -> None:
        self.size = state["size"].to(self.size.device)
        self._at, self._stale = int(state["at"]), bool(state["stale"])


def filtered_variances(log_scales: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Return s^2 + f^2 [N, 3] under a filter of size f [N], and s^2 as a share of it."""
    variance = (2 * log_scales).exp()
    wide = variance + size.to(variance)[:, None] ** 2
    return wide, variance / wide


@torch.no_grad()
def filter_sizes(means: Tensor, cameras: list[Camera]) -> Tensor:
    """Return f [N] in world units: sqrt(0.2) z / F, with z to the nearest camera that sees the Gaussian.

    F is the longest focal length.

    Args:
        means: [N, 3] in the world.
        cameras: cameras of the train photos, at full size.
    """
    nearest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        pose = pose_like(camera, means)
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
        depth = z.clamp(min=1e-3)
        u = (camera.fx * x / depth + camera.cx) / camera.width
        v = (camera.fy * y / depth + camera.cy) / camera.height
        seen = (z > NEAR) & ((u - 0.5).abs() <= 0.5 + MARGIN) & ((v - 0.5).abs() <= 0.5 + MARGIN)
        nearest = torch.where(seen, torch.minimum(nearest, z), nearest)
    any_sees = torch.isfinite(nearest)
    if len(means):  # unseen Gaussians get the largest seen depth; seen depths are positive, so 0 = none
        far = nearest.masked_fill(~any_sees, 0.0).amax()
        nearest = torch.where(any_sees, nearest, far)
    return nearest * (VARIANCE**0.5 / max(camera.fx for camera in cameras))
