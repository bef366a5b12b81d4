"""ForestSplats: one small transient field for all photos, deformed for each by a net; another net masks.

Source: arXiv 2503.06179 and kalelpark/ForestSplats, which says that parts are missing; the losses of the
paper are unverified. Two readings of the code: superpixels are of channels-last photos, and masks stay
fractions. Ours: the mask net (plain and dilated convolutions instead of CGNet) and the superpixels get the
photo at `side` px; a narrower deforming net, whose heads start near zero; no sky points, no Mip filter. Its
growth (UAD) has no effect in the released code: `@density=uad` gives this toolkit's reading of it.
Appearance is that of WildGaussians, for static Gaussians alone.

Cost: a second picture, the deforming net, and two evaluations of D-SSIM for the mask.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from skimage.segmentation import slic
from torch import Tensor

from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.dronesplat import label_means
from ambiguous_wild.methods.masking_common import EffectMask, d_keep, resized
from ambiguous_wild.methods.wildgaussians import WildAppearance, WildGaussiansConfig
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects.autograd_effect import AutogradEffect, Leaf, mlp_leaves
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.geometry import SceneNormaliser, conv_leaves, frequencies
from ambiguous_wild.splat.field import Rates
from ambiguous_wild.splat.fields import STATIC, ComposeVjp, Fields, FieldStart
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Cotangents, Frame, Vjp
from ambiguous_wild.splat.step import Step, TrainData, ViewContext

OCTAVES, LAYERS, SKIP = 10, 8, 4
TRANSIENT = "transient"


@dataclass(frozen=True)
class ForestSplatsConfig:
    """Options; times in nominal iterations (of 30 000)."""

    density: DensityConfig = field(default_factory=DensityConfig)
    points: int = 5000  # transient Gaussians; their number stays
    width: int = 64  # units of the deforming net's hidden layers; published 256
    side: int = 160  # px, the longer side of the photo that the mask net sees
    segments: int = 30  # superpixels
    filled: float = 0.2  # superpixels with this mean mask are masked as a whole
    area: float = 0.05  # weight of mean M^2 at the start
    area_final: float = 0.006  # and at the end
    static: float = 0.2  # weight of the loss of the static picture where it is not masked
    appearance: bool = False  # published: on for photo collections
    lr_mask: float = 1e-3
    lr_bend: float = 8e-4

    def __post_init__(self) -> None:
        limits = {"points": (4, 1e7), "width": (1, 4096), "side": (16, 4096), "segments": (1, 1e5)}
        check_limits(self, "forestsplats", filled=(0, 1), **limits)


class ForestSplatsNets(AutogradEffect):
    """Holds the deforming net and the mask net. As an effect it changes no picture itself."""

    name = "forestsplats"

    def __init__(self, config: ForestSplatsConfig) -> None:
        self.config = config

    def acts(self, hook: str) -> bool:
        return hook == "step"

    def setup(self, data: TrainData) -> None:
        super().setup(data)
        self.unit = SceneNormaliser(data.scene.points.xyz, data.device)
        self.segments = [self._superpixels(photo).to(data.device) for photo in data.photos]

    def _superpixels(self, photo: Tensor) -> Tensor:
        small = self._small(photo)[0].permute(1, 2, 0).cpu().numpy()
        count = self.config.segments
        labels = slic(small, n_segments=count, compactness=1.0, sigma=3, start_label=0, channel_axis=-1)
        return torch.from_numpy(np.minimum(labels, 2 * count - 1).astype(np.int64))

    def _small(self, photo: Tensor) -> Tensor:
        share = min(self.config.side / max(photo.shape[:2]), 1.0)
        size = [max(round(side * share), 4) for side in photo.shape[:2]]
        return F.interpolate(photo.permute(2, 0, 1)[None], size=size, mode="area")

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        position, w, rate = 4 * (1 + 2 * OCTAVES), self.config.width, self.config.lr_bend
        leaves: dict[str, Leaf] = {}
        for i in range(LAYERS):
            inputs = position if i == 0 else w + position if i == SKIP + 1 else w
            leaves |= mlp_leaves(f"bend{i}", (inputs, w), rng, rate)
        for key, leaf in mlp_leaves("moved", (w, 10), rng, rate).items():
            leaves[key] = replace(leaf, values=0.01 * leaf.values)
        for name, channels in (("stem", (3, 32, 32, 32)), ("near", (32, 64, 128)), ("far", (32, 64, 128))):
            leaves |= conv_leaves(name, channels, rng, self.config.lr_mask)
        return leaves | conv_leaves("last", (128, 1), rng, self.config.lr_mask, side=1)

    def change(
        self, gaussians: Gaussians, leaf: Mapping[str, Tensor], context: ViewContext
    ) -> Mapping[str, Tensor]:
        """Deform the transient Gaussians for this photo."""
        assert context.view is not None
        time = torch.full_like(gaussians.means[:, :1], context.view / max(self.photos - 1, 1))
        code = frequencies(torch.cat([self.unit(gaussians.means.detach()), time], dim=1), OCTAVES)
        x = code
        for i in range(LAYERS):
            x = torch.cat([x, code], dim=1) if i == SKIP + 1 else x
            x = F.relu(torch.addmm(leaf[f"bend{i}_bias0"], x, leaf[f"bend{i}_weight0"]))
        moved = torch.addmm(leaf["moved_bias0"], x, leaf["moved_weight0"])
        return {
            "means": gaussians.means + moved[:, :3],
            "quats": F.normalize(gaussians.quats, dim=1) + moved[:, 3:7],
            "log_scales": (gaussians.log_scales.exp() + moved[:, 7:]).clamp(min=1e-6).log(),
        }

    def masked(self, photo: Tensor, leaf: Mapping[str, Tensor]) -> Tensor:
        """Return M [H, W] in (0, 1), 1 = transient."""

        def conv(x: Tensor, name: str, i: int, stride: int = 1, dilation: int = 1) -> Tensor:
            weight, bias = leaf[f"{name}_weight{i}"], leaf[f"{name}_bias{i}"]
            return F.conv2d(x, weight, bias, stride, dilation * (weight.shape[2] // 2), dilation)

        x = self._small(photo) - 0.5
        for i in range(3):
            x = F.relu(conv(x, "stem", i, stride=2 if i == 0 else 1))
        for i, dilation in enumerate((2, 4)):
            both = conv(x, "near", i, 2) + conv(x, "far", i, 2, dilation)
            x = F.relu(F.group_norm(both, 1))
        small = torch.sigmoid(conv(x, "last", 0))[0, 0]
        return resized(small, *photo.shape[:2])

    def filled(self, mask: Tensor, view: int) -> Tensor:
        """Return M_f [H, W]: the largest value in superpixels whose mean reaches `filled`, elsewhere M."""
        segments = F.interpolate(self.segments[view][None, None].float(), size=mask.shape)[0, 0].long()
        return fill_superpixels(mask, segments, 2 * self.config.segments, self.config.filled)


def fill_superpixels(mask: Tensor, segments: Tensor, count: int, share: float) -> Tensor:
    """Replace the mask [H, W] by its maximum in segments [H, W] whose mean is `share` or more."""
    flat = segments.reshape(-1)
    most = torch.zeros(count, device=mask.device).scatter_reduce(0, flat, mask.reshape(-1), "amax")
    whole = label_means(mask, segments, count) >= share
    return torch.where(whole[segments], most[segments], mask)


def build(options: ForestSplatsConfig) -> MethodHooks:
    """Return a static and a transient field, mixed by the mask."""
    nets = ForestSplatsNets(options)
    effects: tuple[Effect, ...] = (nets,)
    if options.appearance:
        effects = (nets, WildAppearance(WildGaussiansConfig()))
    return MethodHooks(
        mask=ForestSplatsMask(nets),
        density_config=options.density,
        fields=ForestSplatsFields(nets),
        effects=effects,
    )


class ForestSplatsFields(Fields):
    """Composes C = M_f R_t + (1 - M_f) R_s of the transient and the static render."""

    def __init__(self, nets: ForestSplatsNets) -> None:
        self.nets, self.config = nets, nets.config

    def required_effect(self) -> ForestSplatsNets:
        return self.nets

    def setup(self, data: TrainData, static: Gaussians, rates: Rates) -> Mapping[str, FieldStart]:
        self.nets.require_setup()
        rng, count = np.random.default_rng([data.seed, 0xF0]), min(self.config.points, len(static))
        rows = torch.from_numpy(np.sort(rng.choice(len(static), count, replace=False))).to(static.device)
        return {TRANSIENT: FieldStart(replace(static.select(rows), attributes={}), rates)}

    def drawn(self, context: ViewContext) -> Sequence[str]:
        return () if context.view is None else (TRANSIENT,)

    def deform(self, name: str, gaussians: Gaussians, context: ViewContext) -> tuple[Gaussians, Vjp]:
        return self.nets.model(gaussians, context)

    @torch.no_grad()
    def mask(self, context: ViewContext) -> Tensor:
        """Return M_f of a train photo."""
        assert context.photo is not None and context.view is not None
        return self.nets.filled(self.nets.masked(context.photo, self.nets._leaf(context)), context.view)

    def compose(self, frames: Mapping[str, Frame], context: ViewContext) -> tuple[Frame, ComposeVjp]:
        front, back, mask = frames[TRANSIENT], frames[STATIC], self.mask(context)
        share = {TRANSIENT: mask, STATIC: 1.0 - mask}
        image = mask[..., None] * front.image + (1.0 - mask)[..., None] * back.image
        alpha = mask * front.alpha + (1.0 - mask) * back.alpha

        def vjp(c: Cotangents) -> Mapping[str, Cotangents]:
            def of(name: str, value: Tensor | None) -> Tensor | None:
                if value is None:
                    return None
                return (
                    share[name][..., None] * value if value.dim() == 3 else share[name] * value
                ).contiguous()

            return {
                name: Cotangents(
                    of(name, c.image), of(name, c.extra), of(name, c.alpha),
                    c.depth if name == STATIC else None,
                    effect_grads=c.effect_grads if name == STATIC else {},
                )
                for name in share
            }  # fmt: skip

        return Frame(image, alpha, lambda: back.depth), vjp

    def regularise(self, frames: Mapping[str, Frame], context: ViewContext) -> Mapping[str, Cotangents]:
        assert context.photo is not None
        config, nets, photo = self.config, self.nets, context.photo
        static, transient = frames[STATIC].image.detach(), frames[TRANSIENT].image.detach()
        with torch.enable_grad():
            leaf = {name: value.requires_grad_() for name, value in nets._leaf(context).items()}
            mask = nets.masked(photo, leaf)
        m, apart = mask.detach(), transient - photo
        area = max(config.area_final, config.area * math.exp(-0.001 * context.nominal))
        d_mask = 2.0 * area / m.numel() * m + apart.abs().mean(dim=2) / m.numel()
        d_mask = d_mask - config.static * d_keep(static, photo, 1.0 - m)
        with torch.enable_grad():
            d_leaves = torch.autograd.grad(mask, list(leaf.values()), d_mask, allow_unused=True)
        own = {nets.name: {name: d for name, d in zip(leaf, d_leaves) if d is not None}}
        d_static = config.static * photometric(static, photo, 1.0 - m, weighting="images").d_image
        d_transient = m[..., None] * apart.sign() / apart.numel()
        of_static = Cotangents(image=d_static, effect_grads=own)
        return {STATIC: of_static, TRANSIENT: Cotangents(image=d_transient)}


class ForestSplatsMask(EffectMask):
    """1 - M_f, for pictures and metrics: the loss uses the mixture instead."""

    def __init__(self, nets: ForestSplatsNets) -> None:
        self.effect, self.forest = nets, ForestSplatsFields(nets)

    def composed_keep(self, step: Step) -> Tensor | None:
        return self.predict(step)

    def predict(self, step: Step) -> Tensor | None:
        return 1.0 - self.forest.mask(step)
