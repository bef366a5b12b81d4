"""UAD, uncertainty-aware densification: growth by views that show a Gaussian large and free of distractors.

Source: the density control that ForestSplats (arXiv 2503.06179) proposes. UNVERIFIED: its equation was
not available, and the released code's version is never reached and would prune almost everything. This is
a reading of it: the mean of a Gaussian's screen gradient over views, weighted by n (1 - u), with n the
pixels that it was drawn in (as Pixel-GS, which the authors thank) and u the share of its footprint that
the keep map masks. Without masks u is 0 everywhere.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step


def build(options: DensityConfig) -> MethodHooks:
    """Return 3DGS with this density control; graft it onto methods with masks: METHOD@density=uad."""
    return MethodHooks(density=UncertaintyAwareDensity, density_config=options)


class UncertaintyAwareDensity(DensityControl):
    """Grows by the ratio of `grad_sum`, a sum of weighted gradients, to `seen`, the sum of weights.

    A Gaussian whose weights sum to less than one pixel does not grow. `grow_grad` is the threshold of
    the ratio.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"count"})
    reads_keep: ClassVar[bool] = True

    @torch.no_grad()
    def observe(self, step: Step, gradients: Gradients, keep: Tensor | None = None) -> None:
        if step.nominal > self.config.stop:
            return
        assert gradients.count is not None
        self._match(step.gaussians)
        weight = gradients.count
        if keep is not None:
            weight = weight * footprint_mean(keep, step.gaussians.means, step.rendered.radii, step.camera)
        scale = self._half(step.camera.width, step.camera.height, gradients.screen.device)
        norms = torch.linalg.vector_norm(self.statistic(gradients) * scale, dim=1)
        weight = torch.where(step.rendered.visible, weight, torch.zeros_like(weight))
        self.grad_sum += weight * norms
        self.views_seen += weight


def footprint_mean(
    values: Tensor,  # [H, W]
    means: Tensor,  # [N, 3] world
    radii: Tensor,  # [N] px
    camera: Camera,
) -> Tensor:
    """Average `values` over the square of half side `radii` around each projected mean, [N].

    The result is 1 if the square lies outside or the mean behind the camera. Sums are in float64.
    """
    pose = torch.as_tensor(camera.cam_from_world.copy(), dtype=means.dtype, device=means.device)
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    depth = z.clamp(min=1e-3)
    u, v = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    height, width = values.shape
    total = torch.zeros(height + 1, width + 1, dtype=torch.float64, device=values.device)
    total[1:, 1:] = values.double().cumsum(0).cumsum(1)
    left, right = (u - radii).floor().clamp(0, width).long(), (u + radii).ceil().clamp(0, width).long()
    top, bottom = (v - radii).floor().clamp(0, height).long(), (v + radii).ceil().clamp(0, height).long()
    area = (right - left) * (bottom - top)
    inside = total[bottom, right] - total[top, right] - total[bottom, left] + total[top, left]
    in_view = (area > 0) & (z > 0)
    return torch.where(in_view, inside / area.clamp(min=1), torch.ones_like(inside)).to(means.dtype)
