"""Masks that were made before training, by a first pass."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.data import shrink_keep
from ambiguous_wild.splat.parts import MaskPolicy
from ambiguous_wild.splat.step import Step, TrainData


class FixedMasks(MaskPolicy):
    """The same keep map in every step of a photo."""

    def __init__(self, keeps: Sequence[Tensor]) -> None:
        """
        Args:
            keeps: of the train views, [H, W] in [0, 1] at the photos' size, 1 = static.
        """
        self.keeps = list(keeps)

    def setup(self, data: TrainData) -> None:
        self.keeps = [keep.to(data.device, torch.float32) for keep in self.keeps]

    def keep(self, step: Step) -> Tensor:
        return shrink_keep(self.keeps[step.view], step.divisor)

    def facts(self) -> dict[str, Any]:
        shares = [1.0 - float(keep.mean()) for keep in self.keeps]
        return {"masked_share": sum(shares) / max(len(shares), 1)}
