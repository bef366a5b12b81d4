"""Splatfacto-W: harmonics by a net of the Gaussian's feature and the photo's embedding, and a background.

Source: KevinXu02/splatfacto-w (its paper was not read). Ours: a test photo's embedding is fitted with the
model frozen (the release trains on left halves of test photos); the background lies on a grid of every fourth
pixel; rates of positions are 3DGS's (published 1.6e-5, for 55 000 steps); embeddings start at a tenth of a
normal draw; positions get no gradient from directions; rules by screen size and pruning after growth are left
out. Cost: the net, 120-256-256-48 on every visible Gaussian, takes most of a step; `width` makes it smaller.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.config import State, check_limits
from ambiguous_wild.methods.masking_common import EffectMask, upsampled
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.density import DensityConfig, DensityControl, Growth
from ambiguous_wild.splat.effects.autograd_effect import (
    AutogradEffect,
    Leaf,
    VisibleGaussians,
    mlp,
    mlp_leaves,
)
from ambiguous_wild.splat.effects.geometry import directions, harmonics, ray_directions
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks, Schedule
from ambiguous_wild.splat.rendered import Cotangents, Gradients
from ambiguous_wild.splat.step import Step, TrainData, ViewContext

PHOTO, FEATURE = 48, 72


def _density() -> DensityConfig:
    resets = tuple(2500.0 * k for k in range(1, 8))
    # published: sizes of 0.01 and 0.5 in a scene of extent 3
    return DensityConfig(
        grow_grad=8e-4, stop=20_000.0, grow_scale=0.0033, prune_scale=0.17, prune_opacity=0.1,
        resets=resets, reset_opacity=0.2,
    )  # fmt: skip


@dataclass(frozen=True)
class SplatfactoWConfig:
    """Options; times in nominal iterations (of 30 000; published for 55 000)."""

    density: DensityConfig = field(default_factory=_density)
    width: int = 256  # units of the net's hidden layers
    background: bool = True
    lr_photo: float = 0.02
    lr_feature: float = 0.02
    lr_net: float = 2e-3
    lr_rest: float = 1e-4  # rate of the head for higher harmonics
    mask_start: float = 6000.0
    most_masked: float = 0.4  # largest share of masked pixels
    never_masked: float = 0.4  # upper share of the picture that is never masked, a prior of tourist photos
    alpha: float = 0.15  # weight of the mean alpha where the background explains the photo

    def __post_init__(self) -> None:
        shares = dict.fromkeys(("most_masked", "never_masked"), (0, 1))
        check_limits(self, "splatfacto-w", width=(1, 4096), alpha=(0, 1e3), **shares)


def build(options: SplatfactoWConfig) -> MethodHooks:
    """Return 3DGS with colours, background, masks, and growth by absolute gradients."""
    effect = SplatfactoColours(options)
    return MethodHooks(
        mask=TrimmedLossMask(effect), density=SplatfactoDensity, density_config=options.density,
        schedule=Schedule(lr_opacity=0.03, resolution="coarse-to-fine"), weighting="images", antialias=True,
        effects=(effect,),
    )  # fmt: skip


class SplatfactoColours(AutogradEffect):
    """Draws SH = net([embedding; feature]), and picture + (1 - alpha) background(direction, embedding)."""

    name, unseen = "splatfacto-w", "mean"

    def __init__(self, config: SplatfactoWConfig) -> None:
        self.config = config

    def setup(self, data: TrainData) -> None:
        super().setup(data)
        self.behind = torch.tensor(data.scene.background, device=data.device)

    def acts(self, hook: str) -> bool:
        return (hook != "image" or self.config.background) and super().acts(hook)

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        photo = torch.tensor(0.1 * rng.normal(size=(len(data.photos), PHOTO)), dtype=torch.float32)
        lr, w, rest = self.config.lr_net, self.config.width, self.config.lr_rest
        leaves = {"photo": Leaf(photo, self.config.lr_photo, 0.015, per_photo=True)}
        nets = {
            "net": ((PHOTO + FEATURE, w, w), lr, 0.05), "dc": ((w, 3), lr, 0.05),
            "rest": ((w, 45), rest, 0.05), "sky": ((PHOTO, 128, 128), lr, 0.05),
            "sky_dc": ((128, 3), lr, 0.1), "sky_rest": ((128, 72), rest, 0.1),
        }  # fmt: skip
        for name, (widths, rate, final) in nets.items():
            for key, leaf in mlp_leaves(name, widths, rng, rate).items():
                values = torch.zeros_like(leaf.values) if name.endswith("rest") else leaf.values
                leaves[key] = replace(leaf, values=values, lr_decay=final)
        return leaves

    def rows(self, gaussians: Gaussians) -> Mapping[str, GaussianAttribute]:
        zeros = torch.zeros(len(gaussians), FEATURE, device=gaussians.device)
        return {
            "splatfacto_feature": GaussianAttribute(
                zeros, self.config.lr_feature, self.config.lr_feature / 20
            )
        }

    def forward(self, visible: VisibleGaussians, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        weight = leaf["net_weight0"]
        net = {
            **leaf,
            "net_weight0": weight[PHOTO:],  # the embedding's part is the same for every Gaussian
            "net_bias0": leaf["net_bias0"] + leaf["photo"] @ weight[:PHOTO],
            **{f"head_{kind}0": torch.cat([leaf[f"dc_{kind}0"], leaf[f"rest_{kind}0"]], dim=-1)
               for kind in ("weight", "bias")},
        }  # fmt: skip
        hidden = F.relu(mlp(visible.attributes["splatfacto_feature"], net, "net"))
        coefficients = mlp(hidden, net, "head").reshape(-1, 16, 3)
        basis = harmonics(directions(visible.means.detach(), context.camera), 3)
        return 0.5 + torch.einsum("mk,mkc->mc", _up_to(basis, context.nominal // 2000), coefficients)

    def background(self, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        """Return the background [H, W, 3] of the view context's photo, without an offset."""
        height, width = context.camera.height, context.camera.width
        small = (max(height // 4, 1), max(width // 4, 1))
        rays = ray_directions(context.camera, *small, leaf["photo"])
        hidden = F.relu(mlp(leaf["photo"][None], leaf, "sky"))
        rest = mlp(hidden, leaf, "sky_rest").reshape(24, 3)
        basis = _up_to(harmonics(rays, 4), context.nominal // 1000)
        colours = basis @ torch.cat([mlp(hidden, leaf, "sky_dc"), rest])
        return upsampled(colours.reshape(*small, 3), height, width)

    def tone(self, image: Tensor, alpha: Tensor, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        background = self.background(leaf, context) - self.behind  # instead of the scene's
        return (image + (1.0 - alpha)[..., None] * background).clamp(0.0, 1.0)


def _up_to(basis: Tensor, degree: float) -> Tensor:
    """Zero the harmonics above this degree."""
    count = int(degree + 1) ** 2
    return torch.cat([basis[:, :count], torch.zeros_like(basis[:, count:])], dim=1)


class TrimmedLossMask(EffectMask):
    """Masks the largest residuals: the more, the larger the photo's loss among all so far."""

    effect: SplatfactoColours

    def __init__(self, effect: SplatfactoColours) -> None:
        self.effect, self.config = effect, effect.config
        self.high: float | Tensor = 0.0  # largest mean residual since the last multiple of 6000
        self.low: float | Tensor = 1.0
        self.rounds = 0

    def keep(self, step: Step) -> Tensor | None:
        if step.nominal < self.config.mask_start:
            return None
        error = self._error(step)
        loss, rounds = error.mean(), int(step.nominal // 6000)
        start = rounds != self.rounds
        self.high = loss if start else torch.maximum(loss, torch.as_tensor(self.high).to(loss))
        self.low = torch.minimum(loss, torch.as_tensor(self.low).to(loss)) if self.rounds else loss
        number = backend_of(loss.device).number
        self.rounds, self.high, self.low = rounds, number(self.high), number(self.low)
        return trimmed_keep(error, self._share(loss))

    def predict(self, step: Step) -> Tensor | None:
        if not self.rounds:
            return None
        error = self._error(step)
        return trimmed_keep(error, self._share(error.mean()))

    def _error(self, step: Step) -> Tensor:
        """Return the mean over channels of |photo - render|, [H, W], 0 in the part that is never masked."""
        error = (step.photo - step.rendered.image.detach()).abs().mean(dim=2)
        error[: int(self.config.never_masked * len(error))] = 0.0
        return error

    def _share(self, loss: Tensor) -> Tensor:
        """Return the share of pixels to mask, a 0-d tensor."""
        share = self.config.most_masked * (loss - self.low) / (self.high - self.low + 1e-6)
        return share.clamp(0.0, 1.0)

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | None:
        if not self.config.background or not self.config.alpha:
            return None
        photo = step.photo if keep is None else step.photo * keep[..., None]
        sky = self.effect.background(self.effect._leaf(step), step)
        near = ((photo - sky).abs().mean(dim=2) < 0.003).float()
        explained = (F.avg_pool2d(near[None, None], 3, stride=1, padding=1)[0, 0] > 0.6).float()
        return Cotangents(alpha=explained * (self.config.alpha / explained.sum().clamp(min=1.0)))

    def state_dict(self) -> State:
        return {"high": float(self.high), "low": float(self.low), "rounds": self.rounds}

    def load_state_dict(self, state: State) -> None:
        self.high, self.low, self.rounds = state["high"], state["low"], int(state["rounds"])


def trimmed_keep(error: Tensor, share: Tensor) -> Tensor:
    """Return 0 for this share of the largest errors, unless over 40 % of the 5x5 window is kept; [H, W]."""
    ordered = error.reshape(-1).sort().values
    at = ((1.0 - share) * (len(ordered) - 1)).reshape(1)  # rank of the quantile, between two values
    low, high = (ordered.gather(0, k.long()) for k in (at.floor(), at.ceil()))
    inlier = (error <= low + (at - at.floor()) * (high - low)).float()
    near = F.avg_pool2d(inlier[None, None], 5, stride=1, padding=2)[0, 0] > 0.4
    return torch.maximum(inlier, near.float())


class SplatfactoDensity(DensityControl):
    """Grows by the absolute gradient, but after an opacity reset only once every photo was seen."""

    needs: ClassVar[frozenset[str]] = frozenset({"absolute"})

    def setup(self, data: TrainData) -> None:
        self.pause = len(data.photos) + 100

    def statistic(self, gradients: Gradients) -> Tensor:
        assert gradients.screen_abs is not None
        return gradients.screen_abs

    def choose(self, step: Step, gaussians: Gaussians) -> Growth:
        if self.last_reset and step.iteration - self.last_reset <= self.pause:
            none = torch.zeros(0, dtype=torch.int64, device=gaussians.device)
            return Growth(none, none)
        return super().choose(step, gaussians)
