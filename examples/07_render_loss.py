"""A mask policy with a loss of its own on the render: total variation of the picture.

aw bench --method 3dgs --method examples/07_render_loss.py:smooth --scene SCENE -o runs
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks, RenderLeaves
from ambiguous_wild.splat.step import Step


@dataclass(frozen=True)
class Config:
    weight: float = 0.01  # of the loss; the photometric loss is a mean over all pixels and channels


class Smooth(MaskPolicy):
    def __init__(self, config: Config):
        self.config = config

    def loss(self, render: RenderLeaves, step: Step, keep: torch.Tensor | None) -> torch.Tensor:
        image = render.image  # [H, W, 3]
        return self.config.weight * (image.diff(dim=0).abs().mean() + image.diff(dim=1).abs().mean())


def smooth(config: Config) -> MethodHooks:
    return MethodHooks(mask=Smooth(config))
