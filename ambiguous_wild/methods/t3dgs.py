"""T-3DGS: a head predicts the distribution of errors; pixels where photo and render differ in it are masked.

Source: arXiv 2412.00155 and Vadim200116/T-3DGS; the divergence is the code's, the paper's may differ
(unverified). Ours: features (Lab and HOG for DINOv2's, option `features`), enlarged bilinearly (FeatUp
there); doublings of the head stop at half the photo's size; the annealing counts iterations of the run where
these are fewer than nominal ones. Its second stage (SAM 2 tracks masks through the video, then trains anew)
needs a video; `t-3dgs+2passes` trains anew with the final masks. Cost: features of the render, and the head
on two pictures forward and on one backward.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core.config import Facts, State, check_limits
from ambiguous_wild.methods.masking_common import (
    CountingMask,
    MaskedShares,
    PausingMask,
    adam_of,
    annealed,
    calibrated,
    init_uniform,
    learner_state,
    load_learner,
    resized,
    sampled,
)
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.losses import ssim_map
from ambiguous_wild.splat.method_hooks import MethodHooks, Schedule
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import check_features, make_features
from ambiguous_wild.vision.precompute import photo_features


@dataclass(frozen=True)
class T3dgsConfig:
    """Options; times in nominal iterations (of 30 000); the `min_` fields are iterations of the run."""

    features: str = "labhog"  # see vision/backends.py; published: dinov2-small
    density: DensityConfig = field(default_factory=DensityConfig)
    mask_start: float = 500.0
    min_mask_start: int = 300  # earlier renders show too little
    reset_pause: float = 250.0
    min_reset_pause: int = 200
    threshold: float = 50.0  # divergence from which a pixel is transient
    dilation: int = 5  # passes of a 3x3 maximum over the divergence
    beta: float = 0.001  # decay of the chance that a masked pixel is kept nevertheless
    variation: float = 0.1  # weight of the total variation of inverse depth
    lr: float = 5e-3
    lr_final: float = 2e-4  # reached by a cosine over the run
    lr_opacity: float = 0.025
    normal_units: float = 10.0  # for hand-made features: distance in units of blur that counts as 1

    def __post_init__(self) -> None:
        check_features(self.features)
        check_limits(
            self, "t-3dgs", dilation=(0, 100), beta=(0, 1e3), lr=(1e-9, 10), normal_units=(1e-3, 1e9)
        )


def build(options: T3dgsConfig) -> MethodHooks:
    """Return 3DGS with masks and smooth depth."""
    rates = Schedule(lr_opacity=options.lr_opacity)
    return MethodHooks(mask=DivergenceMask(options), density_config=options.density, schedule=rates)


class TwoErrorHead(nn.Module):
    """Maps features [B, h, w, C] to (sigma1, sigma2, rho) [B, 3, H, W] of the two errors."""

    def __init__(self, channels: int, doublings: int, seed: int) -> None:
        super().__init__()
        widths, self.doublings = [max(channels // k, 1) for k in (1, 3, 6, 12)], doublings
        pairs = [(widths[0], widths[0])] + [p for a, b in pairwise(widths) for p in ((a, b), (b, b))]
        self.convs = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairs[:-1])
        self.last = nn.Conv2d(widths[3], 3, 1)
        self.norms = nn.ModuleList(nn.GroupNorm(1, width) for width in widths[1:])
        convs = (*self.convs, self.last)
        init_uniform([(c, (c.in_channels * c.kernel_size[0] ** 2) ** -0.5) for c in convs], seed)

    def forward(self, features: Tensor, height: int, width: int) -> Tensor:
        x = self._doubled(self.convs[0](features.permute(0, 3, 1, 2)), 0)
        for i, norm in enumerate(self.norms):
            x = F.gelu(norm(self.convs[1 + 2 * i](x)))
            if i < 2:
                x = self._doubled(self.convs[2 + 2 * i](x), i + 1)
        x = F.interpolate(self.last(x), size=(height, width), mode="bilinear", align_corners=False)
        return torch.cat([F.softplus(x[:, :2]), torch.tanh(x[:, 2:])], dim=1)

    def _doubled(self, x: Tensor, number: int) -> Tensor:
        return F.interpolate(x, scale_factor=2.0) if number < self.doublings else x


def likelihood_loss(x: Tensor, y: Tensor, prediction: Tensor) -> Tensor:
    """Return the mean negative log likelihood, without constants, of errors x and y [H, W]."""
    s1, s2, rho = prediction
    kept = (1.0 - rho.square()).clamp(min=1e-6)
    cross = 2.0 * rho * x * y / (s1 * s2).clamp(min=1e-6)
    squares = x.square() / s1.square().clamp(min=1e-6) + y.square() / s2.square().clamp(min=1e-6)
    return ((squares - cross) / kept + _determinant(prediction).log()).mean()


def divergence(photo: Tensor, render: Tensor) -> Tensor:
    """Return the divergence [H, W] of two predictions [3, H, W] as in the code, not exactly KL."""
    (a1, a2, rho), (b1, b2, r) = photo, render
    cross = rho * r * a1 * a2 / (b1 * b2).clamp(min=1e-6)
    squares = a1.square() / b1.square().clamp(min=1e-6) + a2.square() / b2.square().clamp(min=1e-6)
    share = _determinant(photo) / _determinant(render)
    return 0.5 * ((squares - cross) / (1.0 - rho.square()).clamp(min=1e-6) - share.log() - 2.0)


def _determinant(prediction: Tensor) -> Tensor:
    s1, s2, rho = prediction
    return (s1.square() * s2.square() * (1.0 - rho.square())).clamp(min=1e-6)


class DivergenceMask(CountingMask, PausingMask):
    """Masks by the head, which learns from the photo alone; after an opacity reset by the last mask."""

    config: T3dgsConfig

    def __init__(self, config: T3dgsConfig) -> None:
        self.config, self.features, self.shares = config, make_features(config.features), MaskedShares()
        self.bank: dict[int, Tensor] = {}  # view -> its last mask, [H, W] bool

    def setup(self, data: TrainData) -> None:
        self.features.fit(data.photos)
        self.phi, self.cameras = photo_features(self.features, data.photos, data.cache_dir), data.cameras
        self.seed, grid, photo = data.seed, self.phi[0].shape, data.photos[0]
        doublings = max(int(math.log2(max(photo.shape[0] / grid[0], 1.0))) - 1, 0)
        self.head = TwoErrorHead(grid[2], min(doublings, 3), data.seed).to(data.device)
        self.optimiser = adam_of(self.head, self.config.lr, data.device)

    def keep(self, step: Step) -> Tensor | None:
        if not self.begun(step):
            return None
        if self.paused(step):
            kept = self.bank.get(step.view)
            return None if kept is None else resized(kept.float(), *step.photo.shape[:2]).round()
        mask = self._mask(step, learn=True)
        self.bank[step.view] = mask > 0
        self.shares.take(step.view, mask)
        return sampled(mask, annealed(step, self.config.beta), (self.seed, step.iteration))

    def predict(self, step: Step) -> Tensor | None:
        return self._mask(step, learn=False) if self.begun(step) else None

    def _mask(self, step: Step, learn: bool) -> Tensor:
        """Return 1 where photo and render agree, before the random draw; trains the head if `learn`."""
        size, render = step.photo.shape[:2], step.rendered.image.detach()
        full = self.cameras[step.view]
        with torch.no_grad():
            seen = self.features(resized(render, full.height, full.width))
        both = torch.stack([self.phi[step.view], seen])
        with torch.set_grad_enabled(learn):
            photo, other = self.head(both, *size)
        if learn:
            cosine = F.cosine_similarity(both[0], both[1], dim=2)
            if self.config.features.startswith("labhog"):
                cosine = calibrated(cosine, self.features.unit, self.config.normal_units)
            apart = resized(1.0 - cosine, *size)
            structure = 0.5 * (1.0 - ssim_map(render, step.photo)).mean(dim=2)
            with torch.enable_grad():
                loss = likelihood_loss(apart, structure, photo)
                self.optimiser.zero_grad(set_to_none=True)
                loss.backward()
            c = self.config
            for group in self.optimiser.param_groups:
                group["lr"] = c.lr_final + 0.5 * (c.lr - c.lr_final) * (
                    1.0 + math.cos(math.pi * step.progress)
                )
            self.optimiser.step()
        apart, side = divergence(photo.detach(), other.detach())[None, None], 2 * self.config.dilation + 1
        return (F.max_pool2d(apart, side, stride=1, padding=side // 2)[0, 0] < self.config.threshold).float()

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | None:
        if step.nominal <= 500.0 or not self.config.variation:
            return None
        with torch.enable_grad():
            depth = step.rendered.depth.detach().requires_grad_()
            alpha = step.rendered.alpha.detach().requires_grad_()
            loss = self.config.variation * total_variation(inverse_depth(alpha, depth))
            pair = torch.autograd.grad(loss, (alpha, depth))
        return Cotangents(alpha=pair[0], depth=pair[1])

    def facts(self) -> Facts:
        return {**super().facts(), "features": self.features.name}

    def state_dict(self) -> State:
        return {
            **super().state_dict(),
            **learner_state(self.head, self.optimiser),
            "bank": {str(view): mask for view, mask in self.bank.items()},
        }

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        load_learner(self.head, self.optimiser, state)
        device = next(self.head.parameters()).device
        self.bank = {int(view): mask.bool().to(device) for view, mask in state["bank"].items()}


def inverse_depth(alpha: Tensor, depth: Tensor) -> Tensor:
    """Return 1 over the expected depth, [H, W]; 0 where the picture is nearly empty."""
    solid = alpha > 0.1
    return torch.where(solid, alpha / depth.clamp(min=1e-6).where(solid, torch.ones_like(depth)), 0.0)


def total_variation(values: Tensor) -> Tensor:
    """Return the total variation of a map [H, W], scaled to [0, 1]: mean |differences| along both axes."""
    low, high = values.amin(), values.amax()
    unit = (values - low) / (high - low).clamp(min=1e-9)
    return unit.diff(dim=0).abs().mean() + unit.diff(dim=1).abs().mean()
