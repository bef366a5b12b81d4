"""HybridGS: every photo has 2D Gaussians on its plane for what only it shows; 3D Gaussians are the rest.

Source: arXiv 2412.03844, its project page and the released code for inference. UNVERIFIED, hence ours: every
loss weight, rate and length of a stage, and how the stages share the loss: while both kinds learn separately,
the 3D Gaussians learn where the 2D ones leave the photo uncovered, and the 2D ones learn what the 3D ones
leave over. Also ours: fewer 2D Gaussians (released 10 000), larger to match their number and cut off at
`reach`; a penalty on the area that they cover. Left out: the page's supervision by other views, of which
nothing is known.

Cost: the 2D Gaussians' windows, `points` times (2 reach)^2 cells, forward and backward.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.masking_common import CountingMask, EffectMask, MaskedShares
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects.autograd_effect import AutogradEffect, Leaf
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.splat.step import Step, TrainData, ViewContext

COVERED = 1.0 / 4.33  # size of a cell in distances between Gaussians, as released: 1 px with 10 000 a photo
FAINT = 2.0 * float(np.log(255.0))  # squared distance, in deviations, beyond which a kernel is below 1/255


@dataclass(frozen=True)
class HybridGsConfig:
    """Options; times in nominal iterations (of 30 000)."""

    density: DensityConfig = field(default_factory=DensityConfig)
    points: int = 1000  # 2D Gaussians a photo
    reach: int = 5  # cells; no 2D Gaussian is drawn farther from its centre
    apart: float = 5000.0  # from here on both kinds learn separately
    joint: float = 15_000.0  # and from here on together
    lr: float = 0.05  # learning rate of 2D Gaussians
    area: float = 0.05  # weight of the mean area that they cover

    def __post_init__(self) -> None:
        check_limits(self, "hybridgs", points=(1, 1e6), reach=(1, 64), joint=(self.apart, 1e9), lr=(0, 10))


def build(options: HybridGsConfig) -> MethodHooks:
    """Return 3DGS with a layer of each photo over its picture."""
    plane = PlanarLayer(options)
    return MethodHooks(mask=PlanarLayerMask(plane), density_config=options.density, effects=(plane,))


class PlanarLayer(AutogradEffect):
    """Draws clip(T + (1 - M) S) from `joint` on, with T and M sums of the photo's 2D Gaussians."""

    name = "hybridgs"

    def __init__(self, config: HybridGsConfig) -> None:
        self.config = config

    def acts(self, hook: str) -> bool:
        return hook != "fit" and super().acts(hook)  # test photos have no layer

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        shape = (len(data.photos), self.config.points)
        start = np.zeros((*shape, 9), np.float32)  # position, colour, Cholesky factor, weight
        start[..., :2] = np.arctanh(rng.uniform(-0.999, 0.999, (*shape, 2)))
        start[..., 2:5] = 0.5
        start[..., 5:8] = rng.uniform(0.0, 1.0, (*shape, 3))
        return {"planar": Leaf(torch.from_numpy(start), self.config.lr, per_photo=True)}

    def layer(self, planar: Tensor, context: ViewContext) -> tuple[Tensor, Tensor]:
        """Return T [H, W, 3] and M [H, W] of the photo."""
        sums = planar_sums(planar, context.camera.height, context.camera.width, self.config.reach).clamp(
            0.0, 1.0
        )
        return sums[..., :3], sums[..., 3]

    def tone(self, image: Tensor, alpha: Tensor, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        if context.view is None or context.other_gaussians or context.nominal < self.config.joint:
            return image
        return composite_over(*self.layer(leaf["planar"], context), image)


def composite_over(front: Tensor, mask: Tensor, back: Tensor) -> Tensor:
    """Return clip(T + (1 - M) S, 0, 1)."""
    return (front + (1.0 - mask)[..., None] * back.clamp(0.0, 1.0)).clamp(0.0, 1.0)


class PlanarLayerMask(EffectMask, CountingMask):
    """1 - M, which weights the loss while both kinds learn separately; afterwards the picture contains M."""

    effect: PlanarLayer
    learns_by_gradients = True

    def __init__(self, plane: PlanarLayer) -> None:
        self.effect, self.config, self.shares = plane, plane.config, MaskedShares()

    def keep(self, step: Step) -> Tensor | None:
        keep = self.predict(step)
        if keep is not None:
            self.shares.take(step.view, keep)
        return keep if step.nominal < self.config.joint else None

    def composed_keep(self, step: Step) -> Tensor | None:
        return self.predict(step) if step.nominal >= self.config.joint else None

    @torch.no_grad()
    def predict(self, step: Step) -> Tensor | None:
        if step.nominal < self.config.apart:
            return None
        return 1.0 - self.effect.layer(self.effect._leaf(step)["planar"], step)[1]

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | None:
        if step.nominal < self.config.apart:
            return None
        with torch.enable_grad():
            planar = self.effect._leaf(step)["planar"].requires_grad_()
            front, mask = self.effect.layer(planar, step)
            outputs, cotangents = [mask], [torch.full_like(mask, self.config.area / mask.numel())]
            if step.nominal < self.config.joint:
                picture = composite_over(front, mask, step.rendered.image.detach())
                outputs.append(picture)
                cotangents.append(photometric(picture.detach(), step.photo, self._user(keep, mask)).d_image)
            (d_planar,) = torch.autograd.grad(outputs, planar, cotangents)
        return Cotangents(effect_grads={self.effect.name: {"planar": d_planar}})

    @staticmethod
    def _user(keep: Tensor | None, mask: Tensor) -> Tensor | None:
        """Return the capture's own mask alone: it masks pixels that the layer does not cover."""
        if keep is None:
            return None
        return ((keep > 0) | (mask.detach() >= 1.0)).float()


def planar_sums(planar: Tensor, height: int, width: int, reach: int) -> Tensor:
    """Sum o (c, 1) g over 2D Gaussians, without order or background, [H, W, 4].

    Args:
        planar: [n, 9]: p with tanh(p) the centre in [-1, 1]^2, colour, (l1, l2, l3) with the lower factor
            [[l1 + 0.5, 0], [l2, l3 + 0.5]] of the covariance in cells, and the logit of the weight.
        height, width: size of the picture, px.
        reach: cells; a kernel is 0 farther from its centre along an axis.
    """
    cell = (height * width / len(planar)) ** 0.5 * COVERED  # px
    half = max(round(reach * cell), 1)
    centre = torch.stack(
        [(planar[:, k].tanh() + 1.0) * (0.5 * size) for k, size in enumerate((width, height))], 1
    )
    around = torch.arange(-half, half + 1, device=planar.device)
    base = centre.detach().floor().long()
    u, v = (base[:, k, None] + around for k in (0, 1))  # [n, K]
    dx, dy = ((w + 0.5 - centre[:, k, None]) / cell for k, w in enumerate((u, v)))
    first, below, last = planar[:, 5:6] + 0.5, planar[:, 6:7], planar[:, 7:8] + 0.5
    x = dx / _apart_from_zero(first)  # [n, K] of columns
    y = (dy[:, :, None] - (below * x)[:, None, :]) / _apart_from_zero(last)[:, :, None]  # [n, rows, columns]
    square = x.square()[:, None, :] + y.square()
    inside = ((v >= 0) & (v < height))[:, :, None] & ((u >= 0) & (u < width))[:, None, :]
    kernel = torch.where(inside & (square <= FAINT), torch.exp(-0.5 * square), 0.0)
    weight = torch.sigmoid(planar[:, 8])[:, None, None] * kernel
    at = (v.clamp(0, height - 1) * width)[:, :, None] + u.clamp(0, width - 1)[:, None, :]
    values = [weight * planar[:, 2 + k, None, None] for k in range(3)] + [weight]
    empty = torch.zeros(height * width, dtype=planar.dtype, device=planar.device)
    sums = [empty.scatter_add(0, at.reshape(-1), value.reshape(-1)) for value in values]
    return torch.stack(sums, dim=1).reshape(height, width, 4)


def _apart_from_zero(x: Tensor) -> Tensor:
    """Move x away from zero to at least 0.1 on its side: a factor of the covariance may cross zero."""
    return torch.where(x >= 0, x.clamp(min=0.1), x.clamp(max=-0.1))
