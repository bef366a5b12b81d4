"""AbsGS: large Gaussians are split by the absolute screen gradient, where signed gradients cancel out.

Source: the defaults of the released code, TY424/AbsGS; the settings of the tables in its paper are
unverified. Ours: the clamp of opacity ends with growth. Left out: pruning by screen size and by blending
weight, which are off in the released code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from ambiguous_wild.core.config import check_limits
from ambiguous_wild.splat.density import DensityConfig, DensityControl, Growth, top_k_mask
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step


@dataclass(frozen=True)
class AbsGsConfig(DensityConfig):
    """Density control with a separate threshold for splits; times in nominal iterations."""

    grow_scale: float = 0.001  # of the scene extent: clone below, split above; 3DGS has 0.01
    split_grad: float = 4e-4  # mean absolute gradient above which Gaussians split; `grow_grad` is for clones
    clamp_every: float = 500.0
    min_clamp_every: int = 500  # real iterations
    clamp_opacity: float = 0.8  # 1 = never

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limits(
            self, "absgs", split_grad=(1e-12, 1e9), clamp_every=(1e-6, 1e9),
            min_clamp_every=(1, 1e9), clamp_opacity=(1e-3, 1),
        )  # fmt: skip


def build(options: AbsGsConfig) -> MethodHooks:
    """Return 3DGS with growth by two gradients."""
    return MethodHooks(density=AbsDensity, density_config=options)


class AbsoluteGradientSums(DensityControl):
    """Density control that also sums the absolute gradients."""

    needs: ClassVar[frozenset[str]] = frozenset({"absolute"})
    sums: ClassVar[Mapping[str, tuple[int, ...]]] = {"grad_sum": (), "views_seen": (), "abs_sum": ()}
    order = 2  # of the norm
    abs_sum: Tensor  # [N] sum over views that saw the row of the norm of single pixels' |dL/du|, |dL/dv|

    @torch.no_grad()
    def observe(self, step: Step, gradients: Gradients, keep: Tensor | None = None) -> None:
        super().observe(step, gradients, keep)
        if step.nominal > self.config.stop:
            return
        assert gradients.screen_abs is not None
        scale = self._half(step.camera.width, step.camera.height, gradients.screen.device)
        norms = torch.linalg.vector_norm(gradients.screen_abs * scale, self.order, dim=1)
        self.abs_sum += torch.where(step.rendered.visible, norms, torch.zeros_like(norms))


class AbsDensity(AbsoluteGradientSums):
    """Small Gaussians grow by the signed gradient, large ones by the absolute."""

    config: AbsGsConfig
    saved = (*DensityControl.saved, "last_clamp")
    last_clamp = 0  # iteration

    def choose(self, step: Step, gaussians: Gaussians) -> Growth:
        """Choose clones and splits together: rows farthest above their threshold come first."""
        seen, small = self.views_seen.clamp(min=1), self.small(gaussians)
        signed = self.grad_sum / seen / max(self.config.grow_grad, 1e-12)
        score = torch.where(small, signed, self.abs_sum / seen / self.config.split_grad)
        chosen = top_k_mask(score, score >= 1.0, self.room(step, gaussians))
        return Growth.of(chosen, small)

    @torch.no_grad()
    def refine(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> tuple[Gaussians, list[str]]:
        gaussians, events = super().refine(step, gaussians, optimiser)
        if self._clamp_due(step):
            limit = torch.logit(torch.tensor(self.config.clamp_opacity)).item()
            gaussians.opacity_logits.clamp_(max=limit)
            optimiser.reset_moments(["opacity_logits"])
            self.last_clamp = step.iteration
        return gaussians, events

    def due(self, step: Step) -> bool:
        return super().due(step) or self._clamp_due(step)

    def _clamp_due(self, step: Step) -> bool:
        config, since = self.config, step.iteration - self.last_clamp
        due = since >= config.min_clamp_every and since * step.nominal / step.iteration >= config.clamp_every
        return due and step.nominal <= config.stop and config.clamp_opacity < 1
