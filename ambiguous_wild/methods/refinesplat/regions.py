"""Regions of masks: hysteresis, gaps, growth and the limit of a mask's size.

Connected components are OpenCV's on the CPU; on an accelerator a fixed number of rounds finds them, without
loops that depend on values. Every pixel points to a pixel of its own component, at first to the largest among
itself and its neighbours. A round takes the largest pointer among each pixel's neighbours, points the pixel's
own target to it, and follows all pointers three times (FastSV: Zhang, Azad, Buluc 2020). Pointers only grow,
so unconnected pixels are never joined; too few rounds would leave a component in two parts.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.splat.backend import backend_of

GAPS = 1.25  # times its limit: as large may a mask be whose gaps are filled
_JUMPS = 3  # need half as many rounds as one; more do not help
# Needed at 504 x 378 px, 4 or 8 neighbours, mirrored or not: 7 by 6 of 49 mazes and 6 by the others and by
# Hilbert curves, 5 by spirals, serpentines, combs and stairs, 5 by random pixels of any density, 4 by blobs;
# 7 by a maze of four times the pixels. A round leaves the local maxima of the parts that touch, so the number
# grows with the logarithm of the pixels at most.
_ROUNDS = 8
_ROUNDS_PIXELS = 504 * 378
_FLOAT32_EXACT = 1 << 24


def rounds_for(pixels: int) -> int:
    """Rounds that suffice for a photo of so many pixels."""
    return _ROUNDS + max(math.ceil(math.log(pixels / _ROUNDS_PIXELS, 4)), 0)


def components(masks: Tensor, connectivity: int) -> Tensor:
    """Components of masks [n, H, W] bool: [n * H * W] int64, a number from 1 on for each; 0 = in no mask."""
    if backend_of(masks.device).kernels:
        found = [cv2.connectedComponents(m, connectivity=connectivity)[1] for m in masks.byte().numpy()]
        stack = np.stack(found).astype(np.int64)
        stack += np.arange(len(stack))[:, None, None] * masks[0].numel() * (stack > 0)
        return torch.from_numpy(stack.ravel())
    pixels = masks.numel()
    # pooling needs floating point
    dtype = torch.float32 if pixels < _FLOAT32_EXACT else torch.float64
    inside = masks.reshape(-1).long()
    own = torch.arange(1, pixels + 1, dtype=dtype, device=masks.device) * inside
    slots = torch.arange(1, pixels + 1, device=masks.device)
    labels = F.pad(_largest_around(own.view(masks.shape), connectivity, dtype) * inside, (1, 0))
    for _ in range(rounds_for(masks[0].numel())):
        for _ in range(_JUMPS):
            labels = labels.take(labels)
        around = _largest_around(labels[1:].view(masks.shape), connectivity, dtype) * inside
        # pixels without a larger label write to themselves: thousands would wait for the slot of one root
        target = torch.where(around > labels[1:], labels[1:], slots)
        labels = labels.scatter_reduce(0, target, around, "amax")
    for _ in range(_JUMPS):
        labels = labels.take(labels)
    return labels[1:]


def hysteresis(values: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Connected regions above `low` that somewhere exceed `high` (Canny's rule).

    Args:
        values: [n, H, W].
        low: 0-d, at most `high`.
        high: 0-d.

    Returns:
        [n, H, W] bool.
    """
    labels = components(values > low, 8)
    # a strong pixel is also weak, so it lies in a component; all others write to slot 0
    reached = torch.zeros(labels.numel() + 1, dtype=torch.bool, device=values.device)
    reached.scatter_(0, labels * (values > high).view(-1), True)
    reached[:1] = False
    return reached[labels].view(values.shape)


def fill_holes(mask: Tensor, share: float) -> Tensor:
    """The mask [H, W] bool with every enclosed gap filled that is smaller than `share` of the photo."""
    if share <= 0:
        return mask
    labels = components(~mask[None], 4)
    areas = labels.new_zeros(labels.numel() + 1).scatter_add_(0, labels, torch.ones_like(labels))
    return mask | (areas[labels] < share * mask.numel()).view(mask.shape)


def dilate(mask: Tensor, size: int) -> Tensor:
    """The mask [H, W] bool grown by a size x size square, `size` odd; 1 leaves it alone."""
    if size <= 1:
        return mask
    return F.max_pool2d(mask[None].float(), size, 1, size // 2)[0] > 0.5


def grown(transient: Tensor, config: MaskConfig, evidence: Tensor) -> Tensor:
    """M_final [H, W] bool of what passed the threshold: no larger than allowed, gaps filled, dilated.

    Of a too large mask the surest pixels are masked. Their gaps are filled too, because a mask with specks
    lets a distractor through; the mask may be a quarter larger then (`GAPS`).

    Args:
        transient: [H, W] bool.
        config: `most`, the largest share of the photo that is masked; `fill`, `dilation`.
        evidence: [H, W], larger = surer.
    """
    size = transient.numel()
    surest = torch.where(transient, evidence, -torch.inf).flatten()
    cut = surest.kthvalue(size + 1 - max(int(config.most * size), 1)).values
    too_many = transient.sum() > config.most * size
    chosen = transient & ((evidence > cut) | ~too_many)
    larger = dilate(fill_holes(chosen, config.fill), config.dilation)
    return torch.where(too_many & (larger.sum() > GAPS * config.most * size), chosen, larger)


def _largest_around(labels: Tensor, connectivity: int, dtype: torch.dtype) -> Tensor:
    """The largest label [n, H, W] among each pixel and its 4 or 8 neighbours, flat int64."""
    x = labels.to(dtype)
    if connectivity == 8:
        return F.max_pool2d(x, 3, 1, 1).long().view(-1)
    upright, level = F.max_pool2d(x, (3, 1), 1, (1, 0)), F.max_pool2d(x, (1, 3), 1, (0, 1))
    return torch.maximum(upright, level).long().view(-1)
