"""Instances, thresholds and masks of one photo from its evidence: evidence.make_masks with torch.

For the statistic `structure` only: the evidence is both the statistic and the distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.masking import GAPS
from ambiguous_wild.methods.refinesplat.on_device.components import dilate, fill_holes, hysteresis
from ambiguous_wild.methods.refinesplat.on_device.threshold import Cut, Pool, pool_of, t_ent


@dataclass(frozen=True)
class PhotoMasks:
    """As `evidence.Masks`, on the device."""

    local: Tensor  # [H, W] bool
    global_: Tensor  # [H, W] bool
    keep: Tensor  # [H, W] float32
    means: Tensor  # [K] float64, mean evidence of every instance, NaN where there is none
    cut: Cut
    pool: Pool  # what the threshold cut

    def shares(self) -> Tensor:
        """Masked in all, locally and globally, and T_ent: [4] float64."""
        masked = torch.stack([self.keep < 0.5, self.local, self.global_]).double().mean((1, 2))
        return torch.cat([masked, self.cut.threshold[None]])


class Labels:
    """The instances of every photo; K is the largest number of them."""

    def __init__(
        self,
        labels: Sequence[np.ndarray],  # [H, W] int32, 0 = none
        static: Sequence[np.ndarray],  # [K of the photo] bool, not to be masked
        unseen: Sequence[np.ndarray | None],  # [H, W] bool, not to be judged
        device: torch.device | str,
    ) -> None:
        self.counts = [len(s) for s in static]
        self.most = max([*self.counts, 1])
        clean = [
            np.where((label > 0) & (True if u is None else ~u), label, 0)
            for label, u in zip(labels, unseen, strict=True)
        ]
        self.of_pixel = [torch.from_numpy(label.astype(np.int32).ravel()).to(device) for label in clean]
        areas = np.full((len(clean), self.most), np.nan)
        flags = np.zeros((len(clean), self.most), bool)
        for view, (label, count) in enumerate(zip(clean, self.counts)):
            areas[view, :count] = np.bincount(label.ravel(), minlength=count + 1)[1 : count + 1]
            flags[view, :count] = static[view]
        areas[areas == 0] = np.nan
        self.known = np.isfinite(areas)  # [views, K]
        self.areas = torch.from_numpy(areas).to(device)  # [views, K] float64 px, NaN where there is none
        self.static_flags = torch.from_numpy(flags).to(device)  # [views, K]
        # view: [H, W] bool, its static instances by structure from motion; only views that have some
        self.static = {
            view: torch.from_numpy(np.r_[False, flags[view]][label]).to(device)
            for view, label in enumerate(clean)
            if flags[view].any()
        }

    def means(self, view: int, evidence: Tensor) -> Tensor:
        """Mean of evidence [H, W] over every instance, [K] float64; NaN where there is none."""
        sums = torch.zeros(self.most + 1, dtype=torch.float64, device=evidence.device)
        sums.index_add_(0, self.of_pixel[view], evidence.double().view(-1))
        return sums[1:] / self.areas[view]

    def on_pixels(self, view: int, values: Tensor, shape: torch.Size) -> Tensor:
        """A value of each instance [K] at its pixels [H, W]; 0 where there is none."""
        return F.pad(values, (1, 0)).index_select(0, self.of_pixel[view]).view(shape)


def make_masks(
    view: int,
    evidence: Tensor,  # [H, W] float32 in units
    labels: Labels,
    others: Tensor,  # [views, K] float64, means of all photos when they were last judged; NaN = none
    w2: Tensor,
    config: MaskConfig,
    ceiling: Tensor | None,
    seen: Tensor | None,
) -> PhotoMasks:
    """As `evidence.make_masks`; the row of this view in `others` is not read. `seen` [H, W]: None = all."""
    shape = evidence.shape
    means = labels.means(view, evidence)
    values = means
    if config.scope == "scene":
        values = others.clone()
        values[view].copy_(means)
    pool = pool_of(values.view(-1))
    cut = t_ent(pool, w2, config).below(ceiling)
    static = labels.static.get(view)
    flagged = means > cut.threshold
    if static is not None:
        flagged = flagged & ~labels.static_flags[view]
    nothing = torch.zeros(shape, dtype=torch.bool, device=evidence.device)
    local = labels.on_pixels(view, flagged, shape) if config.use_local else nothing
    weak, strong = config.hold * cut.threshold, cut.threshold
    judging = evidence
    if config.combine == "fused" and config.use_local and config.use_global:
        of_instance = labels.on_pixels(view, means.nan_to_num(nan=0.0), shape)
        # a pixel without an instance is judged alone
        inside = labels.of_pixel[view].view(shape) > 0
        judging = torch.where(inside, (evidence * of_instance).sqrt_(), evidence)
        final, global_ = hysteresis(torch.stack([judging, evidence.double()]), weak, strong)
    else:
        global_ = hysteresis(evidence[None], weak, strong)[0] if config.use_global else nothing
        final = local | global_
    if static is not None:
        # the union contains none of them
        final, global_ = final & ~static, global_ & ~static
    if seen is not None:
        final = final & seen
    final = grown(final, config, judging)
    if seen is not None:
        final = final & seen
    return PhotoMasks(local, global_, (~final).float(), means, cut, pool)


def grown(transient: Tensor, config: MaskConfig, evidence: Tensor) -> Tensor:
    """As `masking.grown`, [H, W] bool; the host decides nothing, so that it need not wait."""
    size = transient.numel()
    surest = torch.where(transient, evidence, -torch.inf).flatten().sort(descending=True).values
    cut = surest[max(int(config.most * size), 1) - 1]
    too_many = transient.sum() > config.most * size
    chosen = transient & ((evidence > cut) | ~too_many)
    larger = dilate(fill_holes(chosen, config.fill), config.dilation)
    return torch.where(too_many & (larger.sum() > GAPS * config.most * size), chosen, larger)
