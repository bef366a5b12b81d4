"""What the mask policies of several methods share: warm-up, pause after an opacity reset, masked shares."""

from __future__ import annotations

from typing import Protocol

import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.methods.deferred import deferred
from ambiguous_wild.splat.parts import MaskPolicy
from ambiguous_wild.splat.step import Step


class WarmUp(Protocol):
    """Options that say when masks begin."""

    @property
    def mask_start(self) -> float: ...  # nominal iterations
    @property
    def min_mask_start(self) -> int: ...  # iterations of the run: an earlier render shows too little


class Pause(WarmUp, Protocol):
    """Options that also say how long masks rest after an opacity reset."""

    @property
    def reset_pause(self) -> float: ...  # nominal iterations
    @property
    def min_reset_pause(self) -> int: ...  # iterations of the run


class WarmUpMask(MaskPolicy):
    """A mask policy that keeps every pixel until the renders show something."""

    config: WarmUp

    def begun(self, step: Step) -> bool:
        """Whether masks are in force at this step."""
        return step.nominal >= self.config.mask_start and step.iteration >= self.config.min_mask_start


class PausingMask(WarmUpMask):
    """A mask policy that also rests after every opacity reset: renders are too dark to be judged by."""

    config: Pause
    last_reset = 0  # iteration, 0 = never

    def on_opacity_reset(self, step: Step) -> None:
        self.last_reset = step.iteration

    def paused(self, step: Step) -> bool:
        """Whether the last opacity reset is too recent."""
        if not self.last_reset:
            return False
        pause = max(self.pause_iterations(step), self.config.min_reset_pause)
        return step.iteration - self.last_reset < pause

    def pause_iterations(self, step: Step) -> float:
        """`reset_pause` in iterations of the run."""
        return self.config.reset_pause / (step.nominal / step.iteration)


class MaskedShares(dict[int, float | Tensor]):
    """View: the share of its pixels that was masked when it was last seen."""

    def take(self, view: int, keep: Tensor) -> None:
        """Note the share of a keep map [H, W]; on an accelerator it is read later."""
        self[view] = deferred(1.0 - keep.mean())

    def mean(self) -> float:
        """Over the views seen so far, 0 before the first."""
        shares = [float(self[view]) for view in sorted(self)]
        return sum(shares) / len(shares) if shares else 0.0

    def state_dict(self) -> dict[str, float]:
        return {str(view): float(share) for view, share in self.items()}

    @classmethod
    def from_state(cls, state: dict[str, float]) -> MaskedShares:
        """What `state_dict` returned."""
        return cls({int(view): float(share) for view, share in state.items()})


def upsampled(image: Tensor, height: int, width: int) -> Tensor:
    """A render [h, w, 3] at [height, width, 3], bilinear; the render itself where it has that size."""
    if image.shape[:2] == (height, width):
        return image
    chw = image.permute(2, 0, 1)[None]
    return F.interpolate(chw, size=(height, width), mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
