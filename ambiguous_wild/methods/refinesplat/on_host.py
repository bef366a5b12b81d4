"""The masks of all views, computed and kept on the host: numpy and OpenCV, for every statistic."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.config import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.evidence import Judged, Maps, Masks, make_masks, pooled, scaled_by
from ambiguous_wild.methods.refinesplat.first_look import FirstLook
from ambiguous_wild.methods.refinesplat.pixels import PixelEvidence
from ambiguous_wild.methods.refinesplat.threshold import LearntWeight, robust_floor
from ambiguous_wild.splat.step import Step

PRICE = 3.0  # of a masked pixel, robust deviations above the median distance, if `disagree` is off


class HostMasks:
    """Masks of all views, with what they are computed from beside the render, and the learnt w2."""

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
        compare: Callable[[Step], Maps],  # on the feature grid; called only if the statistic needs it
    ) -> None:
        self.config, self.looks, self.labels, self.static = config, looks, labels, static
        self.device, self.compare = device, compare
        self.limited = {view: config.mask.limited(look.most) for view, look in looks.items()}
        self.pixels = PixelEvidence(
            photos,
            cameras,
            config.mask.multiview,
            base=config.mask.base,
            least_alpha=config.mask.least_alpha,
            memory=config.mask.memory,
            surfaces=surfaces,
        )
        self.weight = LearntWeight()
        self.keeps: dict[int, Tensor] = {}  # view: [H, W] float32 at the photo's size
        self.shares: dict[int, tuple[float, float, float, float]] = {}  # view: final, local, global, T_ent
        self.judged: dict[int, Judged] = {}  # view: its instances when its mask was last made

    def has(self, view: int) -> bool:
        """Whether the view has a mask."""
        return view in self.keeps

    def keep_of(self, view: int) -> Tensor | None:
        """[H, W] float32 at the photo's size; None where there is none yet."""
        return self.keeps.get(view)

    def renew(self, step: Step) -> None:
        """Compute the mask of the step's view, store its evidence for other views, and learn w2."""
        _, masks = self.examine(step, remember=True)
        self.judged[step.view] = masks.judged
        if self.config.mask.w2 is None:
            self._learn(masks)
        self.keeps[step.view] = torch.from_numpy(masks.keep).to(self.device)
        self.shares[step.view] = (
            float(1.0 - masks.keep.mean()),
            float(masks.local.mean()),
            float(masks.global_.mean()),
            masks.cut.threshold,
        )

    def predict(self, step: Step) -> Tensor:
        """The keep map [H, W] that the step's render gives; nothing is kept of it."""
        return torch.from_numpy(self.examine(step)[1].keep).to(self.device)

    @property
    def w2(self) -> float:
        """Weight of T_ent's lower subset, learnt or fixed."""
        return self.weight.value if self.config.mask.w2 is None else self.config.mask.w2

    @torch.no_grad()
    def examine(self, step: Step, *, remember: bool = False) -> tuple[Maps, Masks]:
        """The maps of the step's view and its masks at the photo's own size.

        Args:
            step: of any train view.
            remember: whether the evidence is stored for other views; else nothing is kept.
        """
        view, mask = step.view, self.limited.get(step.view, self.config.mask)
        ceiling, unseen = math.inf, None
        if mask.statistic == "structure":
            rendered = step.rendered
            evidence = self.pixels.look(
                view,
                rendered.image.cpu().numpy(),
                rendered.alpha.cpu().numpy(),
                rendered.depth.cpu().numpy(),
                remember=remember,
            )
            if view in self.looks:
                evidence *= self.looks[view].factor(evidence.shape)
            if mask.entropy_weight > 0:
                evidence = scaled_by(evidence, self.compare(step).statistic, mask.entropy_weight)
            maps = Maps(evidence, evidence)
            ceiling = self.pixels.ceiling(view, mask.ceiling, mask.ceiling_least)
            unseen = self.pixels.unseen(view)
        else:
            maps = self.compare(step)
        others = [self.judged[v] for v in sorted(self.judged) if v != view]
        labels, static = self.labels[view], self.static[view]
        return maps, make_masks(maps, labels, static, others, self.w2, mask, ceiling, unseen)

    def _learn(self, masks: Masks) -> None:
        """w2 from all instances; the price of a masked pixel is a robustly high residual."""
        everything = masks.judged
        if self.config.mask.scope == "scene":
            everything = pooled([self.judged[v] for v in sorted(self.judged)])
        deviations = max(self.config.mask.disagree, 1.0) if self.config.mask.disagree > 0 else PRICE
        price = robust_floor(everything.distances, deviations)
        if len(everything.values) > 1 and np.isfinite(price):
            residuals = everything.distances / max(price, 1e-12)
            floor, form = masks.cut.floor, self.config.mask.threshold
            self.weight.learn(everything.values, residuals, everything.areas, floor, form)

    def state_dict(self) -> dict[str, Any]:
        return {
            "keeps": {str(view): (keep > 0.5).to(torch.uint8) for view, keep in self.keeps.items()},
            "shares": {str(view): [repr(x) for x in row] for view, row in self.shares.items()},
            "judged": {
                str(view): torch.from_numpy(np.stack([j.values, j.distances, j.areas]))
                for view, j in self.judged.items()
            },
            "theta": self.weight.theta,
            "pixels": self.pixels.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.keeps = {int(v): keep.float().to(self.device) for v, keep in state["keeps"].items()}
        self.shares = {int(v): _four(row) for v, row in state["shares"].items()}
        self.judged = {int(v): Judged(*rows.numpy()) for v, rows in state["judged"].items()}
        self.weight.theta = float(state["theta"])
        self.pixels.load_state_dict(state["pixels"])


def _four(row: list[str]) -> tuple[float, float, float, float]:
    # stored as text: T_ent is inf if no instance is an outlier, and JSON has no inf
    final, local, global_, threshold = (float(x) for x in row)
    return final, local, global_, threshold
