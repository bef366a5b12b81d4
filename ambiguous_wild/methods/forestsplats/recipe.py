"""ForestSplats: one small transient field for all photos, bent for each by a net; a net on the photo masks.

Source: arXiv 2503.06179 and kalelpark/ForestSplats, which says that parts are missing; the paper's own
losses are unverified. Read as the card does: superpixels of channels-last photos and masks that stay
fractions. Ours: the mask net (plain and dilated convolutions in CGNet's place) and superpixels see the
photo at `side` px; a narrower bending net; its heads start near zero; no sky points, no Mip filter. Its
growth (UAD) has no effect in the released code: `--density uad` gives this toolkit's reading of it.
Appearance is WildGaussians', of static Gaussians alone.
Cost: a second picture, the bending net, and two evaluations of D-SSIM for the mask.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.methods.forestsplats.nets import ForestSplatsConfig, Nets
from ambiguous_wild.methods.masking_common import d_keep
from ambiguous_wild.methods.wildgaussians import WildAppearance, WildGaussiansConfig
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.field import Rates
from ambiguous_wild.splat.fields import STATIC, ComposePull, Fields, FieldStart
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.parts import MaskPolicy, Parts
from ambiguous_wild.splat.rendered import Cotangents, Frame, Pull
from ambiguous_wild.splat.step import Shot, Step, TrainData

TRANSIENT = "transient"


def build(options: ForestSplatsConfig) -> Parts:
    """A static and a transient field, mixed by the mask."""
    nets = Nets(options)
    effects: tuple[Effect, ...] = (nets,)
    if options.appearance:
        effects = (nets, WildAppearance(WildGaussiansConfig()))
    return Parts(mask=Mixed(nets), density_config=options.density, fields=Forest(nets), effects=effects)


class Forest(Fields):
    """C = M_f R_t + (1 - M_f) R_s."""

    def __init__(self, nets: Nets) -> None:
        self.nets, self.config = nets, nets.config

    def reads(self) -> Nets:
        return self.nets

    def setup(self, data: TrainData, static: Gaussians, rates: Rates) -> Mapping[str, FieldStart]:
        self.nets.require_setup()
        rng, count = np.random.default_rng([data.seed, 0xF0]), min(self.config.points, len(static))
        rows = torch.from_numpy(np.sort(rng.choice(len(static), count, replace=False))).to(static.device)
        return {TRANSIENT: FieldStart(replace(static.select(rows), extra={}), rates)}

    def drawn(self, shot: Shot) -> Sequence[str]:
        return () if shot.view is None else (TRANSIENT,)

    def bend(self, name: str, gaussians: Gaussians, shot: Shot) -> tuple[Gaussians, Pull]:
        return self.nets.model(gaussians, shot)

    @torch.no_grad()
    def mask(self, shot: Shot) -> Tensor:
        """M_f of a train photo."""
        assert shot.photo is not None and shot.view is not None
        return self.nets.filled(self.nets.masked(shot.photo, self.nets._leaf(shot)), shot.view)

    def compose(self, frames: Mapping[str, Frame], shot: Shot) -> tuple[Frame, ComposePull]:
        front, back, mask = frames[TRANSIENT], frames[STATIC], self.mask(shot)
        share = {TRANSIENT: mask, STATIC: 1.0 - mask}
        image = mask[..., None] * front.image + (1.0 - mask)[..., None] * back.image
        alpha = mask * front.alpha + (1.0 - mask) * back.alpha

        def pull(c: Cotangents) -> Mapping[str, Cotangents]:
            def of(name: str, value: Tensor | None) -> Tensor | None:
                if value is None:
                    return None
                return (
                    share[name][..., None] * value if value.dim() == 3 else share[name] * value
                ).contiguous()

            return {
                name: Cotangents(
                    of(name, c.image), of(name, c.extra), of(name, c.alpha),
                    c.depth if name == STATIC else None, c.own if name == STATIC else {},
                )
                for name in share
            }  # fmt: skip

        return Frame(image, alpha, lambda: back.depth), pull

    def regularise(self, frames: Mapping[str, Frame], shot: Shot) -> Mapping[str, Cotangents]:
        assert shot.photo is not None
        config, nets, photo = self.config, self.nets, shot.photo
        static, transient = frames[STATIC].image.detach(), frames[TRANSIENT].image.detach()
        with torch.enable_grad():
            leaf = {name: value.requires_grad_() for name, value in nets._leaf(shot).items()}
            mask = nets.masked(photo, leaf)
        m, apart = mask.detach(), transient - photo
        area = max(config.area_final, config.area * math.exp(-0.001 * shot.nominal))
        d_mask = 2.0 * area / m.numel() * m + apart.abs().mean(dim=2) / m.numel()
        d_mask = d_mask - config.static * d_keep(static, photo, 1.0 - m)
        with torch.enable_grad():
            found = torch.autograd.grad(mask, list(leaf.values()), d_mask, allow_unused=True)
        own = {nets.name: {name: d for name, d in zip(leaf, found) if d is not None}}
        d_static = config.static * photometric(static, photo, 1.0 - m, weighting="images").d_image
        d_transient = m[..., None] * apart.sign() / apart.numel()
        return {STATIC: Cotangents(image=d_static, own=own), TRANSIENT: Cotangents(image=d_transient)}


class Mixed(MaskPolicy):
    """1 - M_f, for pictures and measures: the mixture has weighed the loss already."""

    def __init__(self, nets: Nets) -> None:
        self.forest = Forest(nets)

    def reads(self) -> Nets:
        return self.forest.nets

    def setup(self, data: TrainData) -> None:
        self.forest.nets.require_setup()

    def composed_keep(self, step: Step) -> Tensor | None:
        return self.predict(step)

    def predict(self, step: Step) -> Tensor | None:
        return 1.0 - self.forest.mask(step)
