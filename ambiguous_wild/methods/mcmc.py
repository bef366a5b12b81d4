"""3DGS-MCMC: a fixed number of Gaussians that move to where they are needed, without cloning and pruning.

Source: the released code, ubc-vision/3dgs-mcmc. `min_every`, `start_scale` and `apart` are ours, for short
runs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import comb
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.splat.density import DensityConfig, DensityControl, covariance_offsets
from ambiguous_wild.splat.gaussians import Gaussians, rotation_matrices
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step


@dataclass(frozen=True)
class McmcConfig(DensityConfig):
    """Rounds in nominal iterations; `max_gaussians` is the fixed number."""

    stop: float = 25_000.0
    min_every: int = 20
    prune_opacity: float = 0.0  # no Gaussian is removed
    resets: tuple[float, ...] = ()
    dead_opacity: float = 0.005  # Gaussians up to this opacity are moved
    noise: float = 5e5  # times the learning rate of means
    lambda_opacity: float = 0.01  # weight of the mean opacity in the loss
    lambda_scale: float = 0.01  # weight of the mean scale in the loss
    # copies are offset by a draw from their source times this. Released: 0; they then separate only over
    # thousands of iterations (700 iterations of a courtyard: 28.4 dB, with 1 29.4; 3000: 32.4, with 1 33.2)
    apart: float = 1.0
    start_opacity: float = 0.5
    start_scale: float = 1.0  # times that of 3DGS; released: 0.1 (1500 iterations: 28.5 dB for 30.1)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limits(
            self, "mcmc", apart=(0, 10), start_opacity=(1e-3, 0.999), start_scale=(1e-3, 1e3),
            dead_opacity=(0, 0.5),
        )  # fmt: skip
        for name in ("grow_grad", "grow_scale"):
            if getattr(self, name) != getattr(DensityConfig, name):
                raise AwError(f"mcmc.{name} is not used: its copies are drawn by opacity; leave it out")


def build(options: McmcConfig) -> MethodHooks:
    """Return 3DGS with another start and another density control."""
    return MethodHooks(
        density=McmcDensity, density_config=options,
        start_opacity=options.start_opacity, start_scale=options.start_scale,
    )  # fmt: skip


def relocation(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity [n] and scale factor [n] with which m `copies` [n] look like one Gaussian."""
    # o' = 1 - (1 - o)^(1/m), D = sum_i sum_k C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1), summed over i first
    o, m, k = opacity.double(), copies.clamp(max=51), np.arange(1, 52)
    each = 1.0 - (1.0 - o) ** (1.0 / m)
    ways = comb(m.cpu().numpy()[:, None], k) * (-1.0) ** (k - 1) / k**0.5  # [n, 51]
    total = (torch.from_numpy(ways).to(o) * each[:, None] ** torch.from_numpy(k).to(o)).sum(dim=1)
    return each.clamp(0.005, 1 - 1.2e-7).to(opacity), (o / total).to(opacity)


class McmcDensity(DensityControl):
    """Moves dead Gaussians, grows by a share each round, and adds noise to faint ones in every step."""

    config: McmcConfig

    def before_step(self, step: Step, gradients: Gradients) -> Gradients:
        g = step.gaussians
        o, scales, weights = torch.sigmoid(g.opacity_logits), g.log_scales.exp(), self.weights(g)
        d_logits = gradients.opacity_logits + self.config.lambda_opacity * weights * o * (1 - o)
        d_scales = gradients.log_scales + self.config.lambda_scale / 3.0 * weights[:, None] * scales
        return replace(gradients, opacity_logits=d_logits, log_scales=d_scales)

    def refine(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> tuple[Gaussians, list[str]]:
        g, events = super().refine(step, gaussians, optimiser)
        noise = torch.from_numpy(self.rng.standard_normal((len(g), 3), dtype=np.float32)).to(g.device)
        gate = torch.sigmoid(100 * (0.005 - torch.sigmoid(g.opacity_logits)))
        if self.protected is not None:
            gate[self.protected(g.means)] = 0.0
        half = rotation_matrices(g.quats) * g.log_scales.exp()[:, None, :]  # covariance = half half^T
        pushed = noise * (gate * self.config.noise * optimiser.rates["means"])[:, None]
        g.means += (half @ (half.mT @ pushed[:, :, None])).squeeze(2)
        return g, events

    def due(self, step: Step) -> bool:
        return True  # noise in every step

    def _grow(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        mutable = self.mutable_rows(
            torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.device), gaussians
        )
        if not bool(mutable.any()):
            return gaussians
        dead = (torch.sigmoid(gaussians.opacity_logits) <= self.config.dead_opacity) & mutable
        if 0 < (count := int(dead.sum())) < int(mutable.sum()):
            sources = self._draw(gaussians, optimiser, ~dead & mutable, count)
            for _, tensor in gaussians.named_tensors():
                tensor[dead] = tensor[sources]
            gaussians.means[dead] += self._offsets(gaussians.select(sources))
        most = min(len(gaussians) // 20, self.room(step, gaussians))
        new = gaussians.select(self._draw(gaussians, optimiser, mutable, most))
        new.means += self._offsets(new)
        optimiser.append(len(new))
        self.log.grew(len(new), 0, new.means)
        return gaussians.cat(new)

    def _offsets(self, g: Gaussians) -> Tensor:
        """Draw the offsets of copies from their sources, [N, 3], scaled by `apart`."""
        if not self.config.apart:
            return torch.zeros_like(g.means)
        noise = torch.from_numpy(self.rng.standard_normal((len(g), 3), dtype=np.float32)).to(g.device)
        return self.config.apart * covariance_offsets(noise, g)

    def _draw(self, g: Gaussians, optimiser: SplatAdam, among: Tensor, count: int) -> Tensor:
        """Draw rows [count] by opacity; their opacity and scale become those of the copies."""
        share = torch.where(among, torch.sigmoid(g.opacity_logits), 0.0).double().cpu().numpy()
        drawn = torch.from_numpy(self.rng.choice(len(share), count, p=share / share.sum())).to(g.device)
        rows, times = drawn.unique(return_counts=True)
        opacity, factor = relocation(torch.sigmoid(g.opacity_logits[rows]), 1 + times)
        g.opacity_logits[rows] = torch.logit(opacity)
        g.log_scales[rows] += factor.log()[:, None]
        optimiser.reset_moments(list(optimiser.rates), rows)
        return drawn
