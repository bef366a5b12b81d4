"""Mip-Splatting: a 3D filter bounds the size of Gaussians, a 2D filter replaces the screen-space dilation.

Source: Mip-Splatting (Yu et al., CVPR 2024) and its code, autonomousvision/mip-splatting, whose README
calls the growth by absolute gradients a later addition: `growth=absolute`, while the default is that of
the tables. Ours: the principal point need not be the centre; the 2D factor is that of gsplat's
"antialiased" mode, without the floors of 1e-6.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.absgs import AbsoluteGradientSums
from ambiguous_wild.splat.density import DensityConfig, DensityControl, Growth, top_k_mask
from ambiguous_wild.splat.effects.smoothing import SmoothingFilter, filter_sizes, filtered_variances
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.step import Step, TrainData


@dataclass(frozen=True)
class MipConfig:
    """Options."""

    kernel: float = 0.1  # px^2, variance of the 2D filter
    growth: Literal["plain", "absolute"] = "plain"  # plain: of the tables; absolute: of the current code
    density: DensityConfig = field(default_factory=DensityConfig)

    def __post_init__(self) -> None:
        check_limits(self, "mip-splatting", kernel=(1e-6, 100))


def build(options: MipConfig) -> MethodHooks:
    """Return 3DGS with both filters, and a reset of the filtered opacity."""
    density = MipDensity if options.growth == "plain" else AbsoluteMipDensity
    return MethodHooks(
        density=density, density_config=options.density, antialias=True, blur=options.kernel,
        effects=(SmoothingFilter(),),
    )  # fmt: skip


def opacity_factor(log_scales: Tensor, size: Tensor) -> Tensor:
    """Return the factor [N] of opacities under a filter of size f [N]: sqrt(prod s^2 / prod (s^2 + f^2))."""
    return filtered_variances(log_scales, size)[1].prod(dim=1).sqrt()


class MipDensity(DensityControl):
    """Density control of 3DGS whose reset brings the filtered opacity to the target."""

    needs_effect = SmoothingFilter.name

    def setup(self, data: TrainData) -> None:
        self.cameras = data.cameras

    def reset_opacity(self, gaussians: Gaussians) -> None:
        factor = opacity_factor(gaussians.log_scales, filter_sizes(gaussians.means, self.cameras))
        target = (torch.sigmoid(gaussians.opacity_logits) * factor).clamp(max=self.config.reset_opacity)
        gaussians.opacity_logits.copy_(torch.logit((target / factor).clamp(1e-7, 1 - 1e-6)))


class AbsoluteMipDensity(AbsoluteGradientSums, MipDensity):
    """Density control that also grows by the absolute gradient, as many Gaussians as by the signed one."""

    order = 1

    def choose(self, step: Step, gaussians: Gaussians) -> Growth:
        seen, small = self.views_seen.clamp(min=1), self.small(gaussians)
        signed, absolute = self.grad_sum / seen, self.abs_sum / seen
        growing = signed >= self.config.grow_grad
        share = float(growing.float().mean())
        limit = upper_quantile(absolute, share)
        score = torch.maximum(signed / max(self.config.grow_grad, 1e-12), absolute / max(limit, 1e-12))
        chosen = top_k_mask(score, growing | (absolute >= limit), self.room(step, gaussians))
        return Growth.of(chosen, small)


def upper_quantile(absolute: Tensor, share: float) -> float:
    """Return the threshold that this share of the values [N] reaches: their (1 - share) quantile."""
    return float(np.quantile(absolute.cpu().numpy(), 1.0 - share))
