"""GS-W's U-Net, small and without pretrained weights: maps of a photo, and which of its pixels are static."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.splat.effects.learnt import Leaf
from ambiguous_wild.splat.effects.placing import conv_leaves

CHANNELS, FREE = 16, 2  # of a map; maps sampled at learnt places
DYNAMIC = (FREE + 1) * CHANNELS


def unet_leaves(width: int, rng: np.random.Generator, rate: float) -> dict[str, Leaf]:
    """Encoder of three levels, decoder of two, and the mask's head on the last level of the encoder."""
    w = width
    widths = {
        "down": (3, w, 2 * w, 4 * w),
        "up": (6 * w, 2 * w),
        "top": (3 * w, DYNAMIC),
        "mask": (4 * w, w, 1),
    }
    return {k: v for n, c in widths.items() for k, v in conv_leaves(n, c, rng, rate, final=0.1).items()}


def coded(photo: Tensor, leaf: Mapping[str, Tensor], side: int) -> list[Tensor]:
    """The photo at `side` and the three levels of the encoder, [1, C, h, w] each."""
    share = min(side / max(photo.shape[:2]), 1.0)
    size = [max(8 * round(side * share / 8), 8) for side in photo.shape[:2]]
    found = [F.interpolate(photo.permute(2, 0, 1)[None], size=size, mode="area") - 0.5]
    for i in range(3):
        found.append(_normal(_conv(found[-1], leaf, "down", i, stride=2)))
    return found


def maps_of(photo: Tensor, leaf: Mapping[str, Tensor], side: int) -> Tensor:
    """[3, 16, h, w]: two that are sampled at learnt places, one at the Gaussian's pixel."""
    _, fine, middle, coarse = coded(photo, leaf, side)
    x = torch.cat([F.interpolate(coarse, size=middle.shape[2:]), middle], dim=1)
    x = _normal(_conv(x, leaf, "up"))
    x = torch.cat([F.interpolate(x, size=fine.shape[2:]), fine], dim=1)
    return _conv(x, leaf, "top").reshape(FREE + 1, CHANNELS, *fine.shape[2:])


def visibility(photo: Tensor, leaf: Mapping[str, Tensor], side: int) -> Tensor:
    """M [H, W] in (0, 1), 1 = static, from the encoder's last level."""
    x = F.interpolate(_normal(_conv(coded(photo, leaf, side)[3], leaf, "mask")), scale_factor=2.0)
    x = torch.sigmoid(_conv(x, leaf, "mask", 1))
    return F.interpolate(x, size=photo.shape[:2])[0, 0]


def _conv(x: Tensor, leaf: Mapping[str, Tensor], name: str, i: int = 0, stride: int = 1) -> Tensor:
    return F.conv2d(x, leaf[f"{name}_weight{i}"], leaf[f"{name}_bias{i}"], stride=stride, padding=1)


def _normal(x: Tensor) -> Tensor:
    return F.relu(F.group_norm(x, 1))


def sample(maps: Tensor, at: Tensor) -> Tensor:
    """[M, C] of a map [C, h, w] at (x, y) [M, 2] in [-1, 1]^2, bilinear, the border's value outside."""
    found = F.grid_sample(maps[None], at[None, None], padding_mode="border", align_corners=False)
    return found[0, :, 0].T
