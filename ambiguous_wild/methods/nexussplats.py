"""NexusSplats on plain Gaussians: uncertainty is drawn like a colour, and each Gaussian has a code of its
light.

Source: arXiv 2411.14514 and juliantang324/NexusSplats; which of its settings the tables used is unverified.
LEFT OUT: anchors, so each Gaussian has its own codes, and growth is 3DGS's without opacity resets. Ours:
features (Lab and HOG for DINOv2's, option `features`) with a distance in units of what blur alone causes;
toned colours are colour + 2 sigmoid(net) - 1; D-SSIM is of the toned picture; growth reads the photometric
gradient alone; the uncertainty moves no Gaussians (option `through_geometry`) and is at least 0.1 (the
release: weights are at most 3); nets are narrower, because they run on each Gaussian, not on every tenth;
rates of nets and of codes of photos are higher in runs below 30 000 iterations.

Cost: a second picture in each step and the features of the render.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.config import Facts, check_limits
from ambiguous_wild.methods.masking_common import (
    CountingMask,
    EffectMask,
    MaskedShares,
    WarmUpMask,
    hashed_uniform,
)
from ambiguous_wild.methods.wildgaussians import FeatureDistance, noisy_fourier
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.effects.autograd_effect import (
    AutogradEffect,
    Leaf,
    VisibleGaussians,
    mlp,
    mlp_leaves,
)
from ambiguous_wild.splat.effects.geometry import directions, in_picture
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Cotangents, Gradients
from ambiguous_wild.splat.step import Step, TrainData, ViewContext
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS
from ambiguous_wild.vision.backends import check_features

CODE, SHIFT = 32, 4.0  # length of codes; offset of the drawn uncertainty, because the renderer clamps at 0
MIN_SIGMA = 0.1  # smallest sigma
GEOMETRY = ("means", "quats", "log_scales", "opacity_logits")
COLOURING = ("nexussplats", "exposure", "appearance")  # effects that are not applied to the uncertainty


@dataclass(frozen=True)
class NexusSplatsConfig:
    """Options; times in nominal iterations (of 30 000)."""

    features: str = "labhog"  # see vision/backends.py; published: dinov2-small-registers@350,blocks=6
    appearance: bool = True  # published: on for photo collections, off for captures
    density: DensityConfig = field(default_factory=lambda: DensityConfig(resets=()))
    mask_start: float = 2000.0
    min_mask_start: int = 300  # iterations: earlier renders show too little
    boundary: bool = False  # photo collections: the lower middle of a picture is masked more easily
    normal_units: float = 80.0  # hand-made features: the distance, in units of blur, that counts as 1
    prior: float = 0.5  # weight of the mean ln sigma
    volume: float = 0.01  # weight of the mean volume of a Gaussian
    # whether the loss of the uncertainty also moves Gaussians, as published with anchors. Without anchors it
    # costs 4 dB on a courtyard (21.2 against 25.3)
    through_geometry: bool = False
    light_width: int = 64  # published 256, for ten Gaussians at once
    doubt_width: int = 64  # published 128, likewise
    dropout: float = 0.2
    # codes of photos and uncertainty; runs below 30 000 iterations have higher rates of photos and nets
    lr_code: float = 1e-3
    lr_light: float = 5e-3  # rate of a Gaussian's light
    lr_net: float = 5e-4

    def __post_init__(self) -> None:
        check_features(self.features)
        widths = dict.fromkeys(("light_width", "doubt_width"), (1, 4096))
        check_limits(
            self, "nexussplats", normal_units=(1e-3, 1e9), dropout=(0, 0.9), prior=(1e-3, 1e3), **widths
        )


def build(options: NexusSplatsConfig) -> MethodHooks:
    """Return 3DGS without resets, with colours and uncertainty from codes."""
    codes = NexusSplatsColours(options)
    control = type("NexusDensity", (VolumeRegularisedDensity,), {"weight": options.volume})
    return MethodHooks(RenderedUncertainty(codes), control, options.density, effects=(codes,))


class NexusSplatsColours(AutogradEffect):
    """The codes of photos and Gaussians, and both nets."""

    name = "nexussplats"

    def __init__(self, config: NexusSplatsConfig) -> None:
        self.config = config

    def setup(self, data: TrainData) -> None:
        self.seed, self.points = data.seed, data.sfm_points
        super().setup(data)

    def acts(self, hook: str) -> bool:
        return (hook != "shade" or self.config.appearance) and super().acts(hook)

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        def codes() -> Leaf:
            start = torch.tensor(0.01 * rng.normal(size=(len(data.photos), CODE)), dtype=torch.float32)
            return Leaf(start, self.config.lr_code, per_photo=True, made_for=NOMINAL_ITERATIONS)

        light, hidden, rate = self.config.light_width, self.config.doubt_width, self.config.lr_net
        photos = {"light": codes(), "transient": codes()}
        nets = {
            **mlp_leaves("toned", (3 + 24 + CODE + 3, light, light, 3), rng, rate),
            **mlp_leaves("uncertainty", (2 * CODE, hidden, hidden, 1), rng, rate),
        }
        return photos | {name: replace(leaf, made_for=NOMINAL_ITERATIONS) for name, leaf in nets.items()}

    def rows(self, gaussians: Gaussians) -> Mapping[str, GaussianAttribute]:
        light = noisy_fourier(gaussians.means, self.points, [self.seed, 0x4E])
        uncertainty = torch.zeros(len(gaussians), CODE, device=gaussians.device)
        return {
            "nexus_light": GaussianAttribute(light, self.config.lr_light),
            "nexus_uncertainty": GaussianAttribute(uncertainty, self.config.lr_code),
        }

    def forward(self, visible: VisibleGaussians, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        photo = leaf["light"].expand(len(visible.base), CODE)
        towards = directions(visible.means.detach(), context.camera)
        inputs = torch.cat([visible.base, visible.attributes["nexus_light"], photo, towards], dim=1)
        share, layer = self.config.dropout if context.view is not None else 0.0, count()

        def dropout(x: Tensor) -> Tensor:
            key = (self.seed, context.iteration, next(layer))
            kept = hashed_uniform(x.numel(), key, x.device).reshape(x.shape) >= share
            return torch.relu(x) * kept / (1.0 - share)

        return (
            visible.base
            + 2.0 * torch.sigmoid(mlp(inputs, leaf, "toned", dropout if share else torch.relu))
            - 1.0
        )

    def uncertainty(self, codes: Tensor, leaf: Mapping[str, Tensor]) -> Tensor:
        """Return the raw uncertainty [M] of Gaussians with these codes [M, 32] in the photo of the leaves."""
        photo = leaf["transient"].expand(len(codes), CODE)
        return mlp(torch.cat([codes, photo], dim=1), leaf, "uncertainty")[:, 0]


class RenderedUncertainty(EffectMask, CountingMask, WarmUpMask):
    """Keeps pixels where the drawn uncertainty gives a weight above 1."""

    config: NexusSplatsConfig
    effect: NexusSplatsColours
    learns_by_gradients = True

    def __init__(self, codes: NexusSplatsColours) -> None:
        self.effect, self.config = codes, codes.config
        self.distance = FeatureDistance(self.config.features, self.config.normal_units)
        self.shares = MaskedShares()
        self.pending: Gradients | None = None  # gradients of the current step, until `gradients` returns them

    def setup(self, data: TrainData) -> None:
        super().setup(data)
        self.behind = data.scene.background[0]  # its red
        self.distance.setup(data)

    def keep(self, step: Step) -> Tensor | None:
        weight, self.pending = self._weight(step, learn=True)
        if not self.begun(step):
            return None
        keep = confident_pixels(weight)
        self.shares.take(step.view, keep)
        return keep

    def gradients(self, step: Step, keep: Tensor | None) -> Gradients | None:
        gradients, self.pending = self.pending, None
        return gradients

    def predict(self, step: Step) -> Tensor | None:
        return confident_pixels(self._weight(step, learn=False)[0]) if self.begun(step) else None

    def _weight(self, step: Step, learn: bool) -> tuple[Tensor, Gradients | None]:
        """Return w = 1 / (2 sigma^2) [H, W] of the drawn uncertainty, and gradients of its loss."""
        g, seen = step.gaussians, self._seen(step)
        with torch.set_grad_enabled(learn):
            leaf = {name: value.requires_grad_(learn) for name, value in self.effect._leaf(step).items()}
            codes = g.attributes["nexus_uncertainty"][seen].detach().requires_grad_(learn)
            uncertainty = self.effect.uncertainty(codes, leaf)
        drawn = step.draw(gaussians=as_colour(g, seen, uncertainty.detach()), without=COLOURING)
        with torch.set_grad_enabled(learn):
            shift = SHIFT - self.behind
            raw = (drawn.image[..., 0] - shift * drawn.alpha - self.behind).detach().requires_grad_(learn)
            # with an upper limit of w instead, the distance has no gradient where w reaches it, and sigma
            # falls without end
            sigma = MIN_SIGMA + F.softplus(raw)
            weight = 0.5 / sigma.square()
        judged = weight.detach()
        if self.config.boundary:
            judged = judged / boundary_weight(judged.shape[0], judged.shape[1], judged)
        if not learn:
            return judged, None
        with torch.enable_grad():
            loss = (self.distance(step) * weight).mean() + self.config.prior * sigma.log().mean()
            (d_raw,) = torch.autograd.grad(loss, raw)
        image = torch.stack([d_raw, torch.zeros_like(d_raw), torch.zeros_like(d_raw)], dim=2)
        back = drawn.backward(Cotangents(image=image, alpha=-shift * d_raw))
        inputs = [codes, *leaf.values()]
        with torch.enable_grad():
            d_inputs = torch.autograd.grad(uncertainty, inputs, back.sh0[seen, 0] / SH_C0, allow_unused=True)
        d_codes = torch.zeros_like(g.attributes["nexus_uncertainty"])
        d_codes[seen] = d_inputs[0]
        own = {name: d for name, d in zip(leaf, d_inputs[1:]) if d is not None}
        if not self.config.through_geometry:
            zeros = [torch.zeros_like(getattr(back, name)) for name in GEOMETRY]
            back = replace(back, means=zeros[0], quats=zeros[1], log_scales=zeros[2], opacity_logits=zeros[3])
        gradients = replace(
            back, sh0=torch.zeros_like(g.sh0), sh_rest=torch.zeros_like(g.sh_rest), screen_abs=None,
            screen=torch.zeros_like(back.screen), attributes={"nexus_uncertainty": d_codes},
            effect_grads={self.effect.name: own},
        )  # fmt: skip
        return judged, gradients

    def _seen(self, step: Step) -> Any:
        """Return the rows that may be in the picture, see `Backend.visible_rows`."""
        g = step.gaussians
        return backend_of(g.device).visible_rows(lambda: in_picture(g.means, step.camera, margin=0.5))

    def facts(self) -> Facts:
        return super().facts() | {"features": self.distance.name}


def confident_pixels(weight: Tensor) -> Tensor:
    """Keep pixels with a weight above 1; a photo without such pixels is kept whole."""
    static = weight > 1.0
    return torch.where(static.any(), static, True).float()


def as_colour(gaussians: Gaussians, rows: Any, values: Tensor) -> Gaussians:
    """Return the Gaussians with value + `SHIFT` as the colour of `rows`, without harmonics."""
    colours = torch.full_like(gaussians.sh0, (SHIFT - 0.5) / SH_C0)
    colours[rows] += values[:, None] / SH_C0
    return replace(gaussians, sh0=colours, sh_rest=gaussians.sh_rest[:, :0], attributes={})


def boundary_weight(height: int, width: int, like: Tensor) -> Tensor:
    """Return G [H, W] = exp(-((r - 0.5)^2 / (2 0.5^2) + c^2 / (2 0.8^2))) at rows, columns in [-1, 1]."""
    r = torch.linspace(-1, 1, height, device=like.device)[:, None]
    c = torch.linspace(-1, 1, width, device=like.device)[None, :]
    return torch.exp(-((r - 0.5) ** 2 / 0.5 + c**2 / 1.28))


class VolumeRegularisedDensity(DensityControl):
    """Density control of 3DGS, with a loss of `weight` times the mean volume (product of the scales)."""

    weight = 0.0

    def before_step(self, step: Step, gradients: Gradients) -> Gradients:
        g = step.gaussians
        gradient = self.weight * self.weights(g) * g.log_scales.sum(dim=1).exp()
        return replace(gradients, log_scales=gradients.log_scales + gradient[:, None])
