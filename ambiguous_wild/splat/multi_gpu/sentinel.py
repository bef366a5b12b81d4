"""The sentinel of several ranks: a step that one of them finds broken is called off on all."""

from __future__ import annotations

import torch
from torch import Tensor

from ambiguous_wild.splat.gpu.sentinel import Sentinel
from ambiguous_wild.splat.multi_gpu.ranks import Ranks


class SharedSentinel(Sentinel):
    """Of one rank; its numbers are the same on all, so that all look back at the same step."""

    def __init__(self, device: torch.device, views: int, ranks: Ranks) -> None:
        """
        Args:
            device: of this rank.
            views: number of train photos.
            ranks: that share the model.
        """
        super().__init__(device, views)
        self._ranks = ranks

    def _called_off(self, nothing: Tensor | None) -> Tensor:
        """Of all ranks at once: off where one is broken, or no photo shows anything."""
        something = self._one if nothing is None else 1.0 - nothing
        # One small message a step, and no host waits for it.
        broken, anything = self._ranks.largest(torch.cat([self._broken, something])).split(1)
        self._broken.copy_(broken)
        self._sound += 1.0 - broken
        return torch.maximum(broken, 1.0 - anything)
