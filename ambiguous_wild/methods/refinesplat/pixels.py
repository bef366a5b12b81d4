"""Evidence of a distractor at every pixel of a photo, in units of what is normal in the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.multiview import (
    MultiViewConfig,
    MultiViewEvidence,
    OtherViews,
    discount,
)
from ambiguous_wild.methods.refinesplat.structure import structure_residual, unrelated_residual
from ambiguous_wild.vision.sparse_surface import seldom_seen

STATIC_QUANTILE = 0.25  # of a photo's pixels: static even where distractors cover two thirds of it


class PixelEvidence:
    """The structure residual of each view, discounted by other views' evidence about the same surface."""

    def __init__(
        self,
        photos: Sequence[np.ndarray],  # [H, W, 3] float32 in [0, 1]
        cameras: Sequence[Camera],
        config: MultiViewConfig,
        *,
        base: float,
        least_alpha: float,
        memory: float,
        surfaces: Sequence[np.ndarray | None] = (),  # inverse depths of the sparse points, or none at all
    ) -> None:
        self.photos = list(photos)
        self.config, self.base, self.least_alpha, self.memory = config, base, least_alpha, memory
        self.other_views = OtherViews(cameras, self.photos, config, surfaces)
        # view: [h, w] uint8 of any size, 1 where too few other views look, so that nothing is masked
        self.alone = {
            view: few.astype(np.uint8)
            for view, few in enumerate(seldom_seen(cameras, surfaces, config.seen_by))
            if few is not None and few.any()
        }
        self.unrelated = unrelated_residual(self.photos, base)
        self.normal: dict[int, float] = {}  # view: quantile of its residual that static pixels have
        # view: [H, W], its residual averaged over its visits; half precision, a checkpoint holds all of them
        self.before: dict[int, np.ndarray] = {}

    @property
    def unit(self) -> float:
        """Normal residual of the scene: the median over views; 0 before any was seen."""
        return float(np.median([self.normal[v] for v in sorted(self.normal)])) if self.normal else 0.0

    def look(
        self, view: int, image: np.ndarray, alpha: np.ndarray, depth: np.ndarray, *, remember: bool
    ) -> np.ndarray:
        """Evidence [H, W] float32 in units, at the photo's size.

        Args:
            view: which photo.
            image: [h, w, 3] render of its camera, any size.
            alpha: [h, w] its opacity; below `least_alpha` the model is not learnt yet: no evidence.
            depth: [h, w] sum of weight times z.
            remember: whether the evidence is stored for other views.
        """
        photo = self.photos[view]
        size = (photo.shape[1], photo.shape[0])
        judged = _resized(alpha, size) >= self.least_alpha
        unseen = self.unseen(view)
        if unseen is not None:
            judged &= ~unseen
        evidence = structure_residual(photo, _resized(image, size), self.base)
        evidence[~judged] = 0.0
        if self.memory > 0 and view in self.before:
            evidence = self.memory * self.before[view].astype(np.float32) + (1.0 - self.memory) * evidence
        normal = float(np.quantile(evidence[judged], STATIC_QUANTILE)) if judged.any() else 0.0
        others = None
        if self.config.strength > 0:
            mean_depth = np.where(alpha > 1e-3, depth / np.maximum(alpha, 1e-3), 0.0)
            others = self._others(view, evidence, mean_depth, remember)
        if remember:
            if judged.any():
                self.normal[view] = normal
            if self.memory > 0:
                self.before[view] = evidence.astype(np.float16)
        unit = self._unit(normal)
        return discount(evidence, others, unit, self.config) / unit

    def unseen(self, view: int) -> np.ndarray | None:
        """Pixels that too few other views see, which are never masked, [H, W] bool; None: there are none."""
        if view not in self.alone:
            return None
        size = self.photos[view].shape[1::-1]
        return cv2.resize(self.alone[view], size, interpolation=cv2.INTER_NEAREST) > 0

    def ceiling(self, view: int, share: float, least: float = 0.0) -> float:
        """That share of the residual of unrelated pictures, in the unit that `look` divided by; 0 = inf.

        Never below `least`: while the model is hardly learnt, every pixel has such a residual.
        """
        if share <= 0 or self.unrelated <= 0:
            return math.inf
        return max(share * self.unrelated / self._unit(self.normal.get(view, 0.0)), least)

    def _unit(self, normal: float) -> float:
        return max(self.unit or normal, 1e-4)  # a perfect render of a synthetic scene has no noise at all

    def _others(
        self, view: int, evidence: np.ndarray, depth: np.ndarray, remember: bool
    ) -> MultiViewEvidence | None:
        others = self.other_views
        before = others.evidence.get(view), others.depth.get(view)
        others.remember(view, evidence, depth)
        found = others.ask(view)
        if not remember:
            for kept, old in zip((others.evidence, others.depth), before):
                if old is None:
                    del kept[view]
                else:
                    kept[view] = old
        return found

    def state_dict(self) -> dict[str, Any]:
        return {
            "normal": {str(v): x for v, x in self.normal.items()},
            "before": {str(v): torch.from_numpy(x) for v, x in self.before.items()},
            "evidence": {str(v): torch.from_numpy(x) for v, x in self.other_views.evidence.items()},
            "depth": {str(v): torch.from_numpy(x) for v, x in self.other_views.depth.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.normal = {int(v): float(x) for v, x in state["normal"].items()}
        self.before = {int(v): x.numpy() for v, x in state["before"].items()}
        self.other_views.evidence = {int(v): x.numpy() for v, x in state["evidence"].items()}
        self.other_views.depth = {int(v): x.numpy() for v, x in state["depth"].items()}


def _resized(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """[h, w] or [h, w, 3] at (width, height), bilinear."""
    if x.shape[1::-1] == size:
        return x
    return cv2.resize(np.ascontiguousarray(x), size, interpolation=cv2.INTER_LINEAR)
