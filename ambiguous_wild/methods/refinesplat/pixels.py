"""Evidence of a distractor at every pixel of a photo, in units of what is normal in the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.maps import sized
from ambiguous_wild.methods.refinesplat.multiview import OtherViews, discount
from ambiguous_wild.methods.refinesplat.ranks import low_quantile, median
from ambiguous_wild.methods.refinesplat.structure import resized, structure_residual, unrelated_residual
from ambiguous_wild.vision.sparse_surface import seldom_seen

STATIC_QUANTILE = 0.25  # of a photo's pixels: static even where distractors cover two thirds of it


class PixelEvidence:
    """The structure residual of each view, discounted by other views' evidence about the same surface."""

    def __init__(
        self,
        photos: Sequence[np.ndarray],  # [H, W, 3] float32 in [0, 1]
        cameras: Sequence[Camera],
        surfaces: Sequence[np.ndarray | None],  # inverse depths of the sparse points, or none at all
        config: MaskConfig,
        device: torch.device | str,
        tensors: Sequence[Tensor] | None = None,  # the photos, if they are on the device already
    ) -> None:
        self.config = config
        # unchanged: photos that do not fit on the device are sent there one at a time
        self.photos = tensors or [sized(photo, device) for photo in photos]
        self.other_views = OtherViews(cameras, photos, config.multiview, surfaces, device)
        self.unseen_on_host = [
            None if few is None or not few.any() else _at_size(few, photo.shape)
            for few, photo in zip(
                seldom_seen(cameras, surfaces, config.multiview.seen_by) or [None] * len(photos), photos
            )
        ]
        # [H, W] bool of each view, where masks may be; None: everywhere
        self.seen = [
            None if unseen is None else torch.from_numpy(~unseen).to(device) for unseen in self.unseen_on_host
        ]
        self.unrelated = unrelated_residual([torch.from_numpy(photo) for photo in photos], config.base)
        # quantile of each view's residual that static pixels have; NaN before it was looked at
        self.normal = torch.full((len(photos),), torch.nan, dtype=torch.float64, device=device)
        # view: [H, W] float16, its residual averaged over its visits
        self.before: dict[int, Tensor] = {}

    def look(
        self, view: int, image: Tensor, alpha: Tensor, depth: Tensor, *, remember: bool
    ) -> tuple[Tensor, Tensor]:
        """Evidence in units, and that unit.

        Args:
            view: which photo.
            image: [h, w, 3] render of its camera, any size.
            alpha: [h, w] its opacity; below `least_alpha` the model is not learnt yet: no evidence.
            depth: [h, w] sum of weight times z.
            remember: whether the evidence is stored for other views.

        Returns:
            [H, W] float32 at the photo's size, and 0-d float64.
        """
        photo, config = self.photos[view], self.config
        size = (photo.shape[0], photo.shape[1])
        judged, seen = resized(alpha, size) >= config.least_alpha, self.seen[view]
        left_out = ~(judged if seen is None else judged & seen)
        evidence = structure_residual(photo, resized(image, size), config.base)
        evidence = evidence.masked_fill_(left_out, 0.0)
        if config.memory > 0 and view in self.before:
            evidence = torch.lerp(evidence, self.before[view].float(), config.memory)
        normal, count = low_quantile(evidence, left_out, STATIC_QUANTILE)
        others = None
        if config.multiview.strength > 0:
            mean_depth = depth / alpha.clamp(min=1e-3) * (alpha > 1e-3)
            halved = self.other_views.halved(view, mean_depth)
            others = self.other_views.ask(view, halved)
            if remember:
                self.other_views.remember(view, evidence, halved)
        if remember:
            self.normal[view].copy_(torch.where(count > 0, normal, self.normal[view]))
            if config.memory > 0:
                self.before[view] = evidence.half()
        unit = self._unit(normal)
        return discount(evidence, others, unit, config.multiview) / unit, unit

    def ceiling(self, unit: Tensor) -> Tensor | None:
        """Upper limit of thresholds, in the unit that `look` divided by, 0-d; None: no limit.

        `ceiling` of the residual of unrelated pictures, never below `ceiling_least`: while the model is
        hardly learnt, every pixel has such a residual.
        """
        share = self.config.ceiling
        if share <= 0 or self.unrelated <= 0:
            return None
        return (share * self.unrelated / unit).clamp_(min=self.config.ceiling_least)

    def _unit(self, normal: Tensor) -> Tensor:
        """Normal residual of the scene: the median over views; of this view alone before any was seen."""
        found = median(self.normal)
        # a perfect render of a synthetic scene has no noise at all
        return torch.where(found > 0, found, normal).clamp_(min=1e-4)

    def state_dict(self) -> dict[str, Any]:
        others, normal = self.other_views, self.normal.tolist()
        views = sorted(others.stored_views)
        return {
            "normal": {str(v): x for v, x in enumerate(normal) if not math.isnan(x)},
            "before": {str(v): x.cpu() for v, x in self.before.items()},
            "evidence": {str(v): others.stored.of(v)[0].cpu().contiguous() for v in views},
            "depth": {str(v): others.depth.of(v)[0].cpu().contiguous() for v in views},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        device = self.normal.device
        normal = np.full(len(self.photos), np.nan)
        for view, x in state["normal"].items():
            normal[int(view)] = x
        self.normal = torch.from_numpy(normal).to(device)
        self.before = {int(v): x.to(device) for v, x in state["before"].items()}
        self.other_views.restore(
            {int(v): x.to(device) for v, x in state["evidence"].items()},
            {int(v): x.to(device) for v, x in state["depth"].items()},
        )


def _at_size(few: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A coarse bool map at the size of a photo of that shape."""
    return cv2.resize(few.astype(np.uint8), shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
