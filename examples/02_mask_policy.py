"""A mask policy: which pixels of a photo show the static scene?

    aw bench --method 3dgs --method examples/02_mask_policy.py:trimmed --scene SCENE -o runs
    aw table runs

A distractor is not in the render, so its residual is large: keep the pixels with the smallest residuals,
smoothed so that single noisy pixels do not flicker.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.step import Step


@dataclass(frozen=True)
class Config:
    share: float = 0.85  # of every photo's pixels that are kept
    start: float = 1000.0  # nominal iteration (of 30 000) at which masks begin


class TrimmedMask(MaskPolicy):
    def __init__(self, config: Config):
        self.config = config

    def keep(self, step: Step) -> torch.Tensor | None:
        if step.nominal < self.config.start:
            return None  # the render shows too little yet: keep everything
        residual = (step.rendered.image - step.photo).abs().mean(dim=2)  # [H, W]
        smooth = F.avg_pool2d(residual[None, None], 5, stride=1, padding=2)[0, 0]
        return (smooth <= torch.quantile(smooth, self.config.share)).float()  # 1 = static, 0 = distractor


def trimmed(config: Config) -> MethodHooks:
    """The rest of the loop is that of 3DGS."""
    return MethodHooks(mask=TrimmedMask(config))
