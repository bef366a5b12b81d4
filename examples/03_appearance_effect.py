"""An appearance effect: photos of one scene under different light.

    aw bench --method 3dgs --method examples/03_appearance_effect.py:lamps --scene SCENE --protocol half
    aw table runs

Every photo has two lamps with a colour each, and every Gaussian learns how much each lamp lights it. What
is learnt per photo is a leaf, what is learnt per Gaussian a row; density control copies and drops rows
with their Gaussians. `--protocol half` fits the lamps of a test photo on its left half and measures the
right one.
"""

import torch

from ambiguous_wild.splat.effects.autograd_effect import AutogradEffect, Leaf
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.method_hooks import MethodHooks

LAMPS = 2


class Lamps(AutogradEffect):
    """colour' = colour (1 + sum of lamps: what the Gaussian takes of it, times the lamp's colour)."""

    name = "lamps"

    def leaves(self, data, rng):
        lamps = torch.zeros(len(data.photos), LAMPS, 3)
        return {"lamps": Leaf(lamps, rate=0.01, lr_decay=0.1, per_photo=True, fit_rate=0.05)}

    def rows(self, gaussians):
        share = torch.zeros(len(gaussians), LAMPS, device=gaussians.device)
        share[:, 0] = 1.0  # the first lamp starts as light that falls on everything
        return {"lit": GaussianAttribute(share, rate=0.005)}

    def forward(self, visible, leaf, context):
        light = visible.attributes["lit"] @ leaf["lamps"]  # [M, 3]; zero lamps leave the colours as they are
        return visible.base * (1.0 + light)


def lamps() -> MethodHooks:
    """The rest of the loop is that of 3DGS."""
    return MethodHooks(effects=(Lamps(),))
