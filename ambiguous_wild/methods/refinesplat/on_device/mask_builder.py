"""The default masks of all views, computed and kept on an accelerator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.config import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.evidence import Judged, Maps, Masks
from ambiguous_wild.methods.refinesplat.first_look import FirstLook
from ambiguous_wild.methods.refinesplat.on_device.maps import sized
from ambiguous_wild.methods.refinesplat.on_device.masks import Labels, PhotoMasks, make_masks
from ambiguous_wild.methods.refinesplat.on_device.pixels import PixelEvidence
from ambiguous_wild.methods.refinesplat.on_device.threshold import learnt
from ambiguous_wild.methods.refinesplat.threshold import Cut

if TYPE_CHECKING:
    from ambiguous_wild.splat.step import Step


def only_on_host(config: RefineSplatConfig) -> str | None:
    """The setting, as the command line writes it, that needs masks from the host; None if there is none."""
    mask = config.mask
    if mask.statistic != "structure":
        return f"refinesplat.mask.statistic={mask.statistic}"
    if mask.entropy_weight > 0:
        return f"refinesplat.mask.entropy_weight={mask.entropy_weight}"
    return None


class DeviceMasks:
    """As `on_host.HostMasks`: the same masks, and the same state in a checkpoint.

    `renew` reads nothing back; pictures and checkpoints do.
    """

    def __init__(
        self,
        config: RefineSplatConfig,
        photos: Sequence[np.ndarray],  # [H, W, 3] float32 in [0, 1]
        cameras: Sequence[Camera],
        surfaces: Sequence[np.ndarray | None],  # inverse depths of the sparse points
        looks: Mapping[int, FirstLook],
        labels: Sequence[np.ndarray],  # [H, W] int32 instances, 0 = none
        static: Sequence[np.ndarray],  # [K of the photo] bool, not to be masked
        device: torch.device | str,
        tensors: Sequence[Tensor] | None = None,  # the photos, if they are on the device already
    ) -> None:
        self.config = config
        self.pixels = PixelEvidence(photos, cameras, surfaces, config.mask, device, tensors)
        self.labels = Labels(labels, static, self.pixels.unseen_on_host, device)
        # view: [H, W], factor of its evidence; absent if that is 1
        self.factors = {
            view: sized(look.factor(photos[view].shape[:2]), device)
            for view, look in looks.items()
            if look.weight != 1
        }
        self.limited = {view: config.mask.limited(look.most) for view, look in looks.items()}
        self.keeps: dict[int, Tensor] = {}  # view: [H, W] float32; of the views that have a mask
        wide, views = torch.float64, len(photos)
        # [views, K] mean evidence of every instance when its mask was last made, NaN where there is none
        self.means = torch.full((views, self.labels.most), torch.nan, dtype=wide, device=device)
        self._shares = torch.zeros((views, 4), dtype=wide, device=device)
        self.theta = torch.zeros((), dtype=wide, device=device)  # w2 = sigmoid(theta)
        fixed = config.mask.w2
        self.fixed_w2 = None if fixed is None else torch.full((), fixed, dtype=wide, device=device)

    def has(self, view: int) -> bool:
        """Whether the view has a mask."""
        return view in self.keeps

    def keep_of(self, view: int) -> Tensor | None:
        """[H, W] float32 at the photo's size; None where there is none yet."""
        return self.keeps.get(view)

    @torch.no_grad()
    def renew(self, step: Step) -> None:
        """Compute the mask of the step's view, store its evidence for other views, and learn w2."""
        view, config = step.view, self.config.mask
        _, made = self._make(step, remember=True)
        self.means[view].copy_(made.means)
        if config.w2 is None:
            areas = self.labels.areas if config.scope == "scene" else self.labels.areas[view]
            self.theta = learnt(self.theta, made.pool, areas.view(-1), made.cut.floor, config)
        self.keeps[view] = made.keep
        self._shares[view].copy_(made.shares())

    @torch.no_grad()
    def predict(self, step: Step) -> Tensor:
        """The keep map [H, W] that the step's render gives; nothing is kept of it."""
        return self._make(step, remember=False)[1].keep

    @torch.no_grad()
    def examine(self, step: Step, *, remember: bool = False) -> tuple[Maps, Masks]:
        """Evidence and masks of the step's view as arrays, for pictures."""
        view = step.view
        looked, made = self._make(step, remember=remember)
        evidence, means = looked.cpu().numpy(), made.means.cpu().numpy()
        judged = self._judged(view, means)
        threshold = float(made.cut.threshold)
        cut = Cut(threshold, judged.values > threshold, float(made.cut.floor))
        local, global_, keep = (t.cpu().numpy() for t in (made.local, made.global_, made.keep))
        return Maps(evidence, evidence), Masks(local, global_, keep, judged, cut)

    def _make(self, step: Step, *, remember: bool) -> tuple[Tensor, PhotoMasks]:
        view, rendered = step.view, step.rendered
        config = self.limited.get(view, self.config.mask)
        evidence, unit = self.pixels.look(
            view, rendered.image.detach(), rendered.alpha.detach(), rendered.depth.detach(), remember=remember
        )
        if view in self.factors:
            evidence = evidence * self.factors[view]
        w2 = torch.sigmoid(self.theta) if self.fixed_w2 is None else self.fixed_w2
        seen, ceiling = self.pixels.seen[view], self.pixels.ceiling(unit)
        return evidence, make_masks(view, evidence, self.labels, self.means, w2, config, ceiling, seen)

    def _judged(self, view: int, means: np.ndarray) -> Judged:
        known = self.labels.known[view]
        areas = self.labels.areas[view].cpu().numpy()
        return Judged(means[known], means[known].copy(), areas[known])

    @property
    def w2(self) -> float:
        """Weight of T_ent's lower subset, learnt or fixed."""
        return float(torch.sigmoid(self.theta)) if self.config.mask.w2 is None else self.config.mask.w2

    @property
    def judged(self) -> dict[int, Judged]:
        """View: its instances when its mask was last made."""
        means = self.means.cpu().numpy()
        return {view: self._judged(view, means[view]) for view in self.keeps}

    @property
    def shares(self) -> dict[int, tuple[float, float, float, float]]:
        """View: masked in all, locally, globally, and T_ent."""
        rows = self._shares.tolist()
        return {view: tuple(rows[view]) for view in self.keeps}

    def state_dict(self) -> dict[str, Any]:
        return {
            "keeps": {str(view): (keep > 0.5).to(torch.uint8) for view, keep in self.keeps.items()},
            "shares": {str(view): [repr(x) for x in row] for view, row in self.shares.items()},
            "judged": {
                str(view): torch.from_numpy(np.stack([j.values, j.distances, j.areas]))
                for view, j in self.judged.items()
            },
            "theta": float(self.theta),
            "pixels": self.pixels.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        device = self.theta.device
        means, shares = np.full(self.means.shape, np.nan), np.zeros(self._shares.shape)
        for view, rows in state["judged"].items():
            means[int(view), self.labels.known[int(view)]] = rows[0].cpu().numpy()
        for view, row in state["shares"].items():
            shares[int(view)] = [float(x) for x in row]
        self.keeps = {int(v): keep.float().to(device) for v, keep in state["keeps"].items()}
        self.means, self._shares = (torch.from_numpy(x).to(device) for x in (means, shares))
        self.theta = torch.full_like(self.theta, float(state["theta"]))
        self.pixels.load_state_dict(state["pixels"])
