"""Box filters, resizing and the structure residual: structure.py with torch."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.methods.refinesplat.structure import GREY, NOISE, RESIDUAL_BOX, STRUCTURE_BOX


def box(maps: Tensor, size: int) -> Tensor:
    """Box filter of maps [n, H, W], `size` odd; the border is replicated (cv2.blur)."""
    padded = F.pad(maps[None], (size // 2,) * 4, mode="replicate")
    # one axis after the other: 2 * size sums a pixel instead of size^2
    return F.avg_pool2d(F.avg_pool2d(padded, (size, 1), 1), (1, size), 1)[0]


def resized(x: Tensor, size: tuple[int, int]) -> Tensor:
    """[h, w] or [h, w, 3] at (height, width), bilinear."""
    if tuple(x.shape[:2]) == size:
        return x
    maps = x[None] if x.ndim == 2 else x.permute(2, 0, 1)
    large = F.interpolate(maps[None], size=size, mode="bilinear", align_corners=False)[0]
    return large[0] if x.ndim == 2 else large.permute(1, 2, 0)


def nearest(x: Tensor, size: tuple[int, int]) -> Tensor:
    """[h, w] at (height, width), the pixel that contains each upper left corner (cv2.INTER_NEAREST)."""
    return F.interpolate(x[None, None], size=size, mode="nearest")[0, 0]


def blur_and_shrink(length: int, parts: int, size: int) -> np.ndarray:
    """One axis of a box filter, border replicated, and then of cv2.INTER_AREA: [parts, length] float32.

    Both are linear: `rows @ x @ columns.T` applies them in two products.
    """
    edges = np.arange(parts + 1) * (length / parts)
    cells = np.arange(length)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    area = np.maximum(overlap, 0.0) * (parts / length)
    both = np.zeros_like(area)
    for away in range(-(size // 2), size // 2 + 1):
        np.add.at(both.T, np.clip(cells + away, 0, length - 1), area.T / size)
    return both.astype(np.float32)


def grey_weights(device: torch.device | str) -> Tensor:
    """BT.601 luma, [3]."""
    return torch.from_numpy(GREY).to(device)


def structure_residual(photo: Tensor, render: Tensor, grey: Tensor, base: float) -> Tensor:
    """As `structure.structure_residual`, [H, W]; photo and render [H, W, 3], `grey` from `grey_weights`."""
    residual = box((photo - render).abs_().mean(2)[None], RESIDUAL_BOX)[0]
    a, b = (torch.stack([photo, render]) * grey).sum(3)
    return residual * (1.0 + base - correlation(a, b))


def correlation(a: Tensor, b: Tensor) -> Tensor:
    """As `structure.correlation`, grey [H, W] each."""
    both = torch.stack([a, b])
    products = torch.cat([both, both * both, (a * b)[None]])
    # OpenCV sums in float64 and rounds once: variances are small differences of these means
    means = box(products.double(), STRUCTURE_BOX).float()
    variances = torch.addcmul(means[2:4], means[:2], means[:2], value=-1.0).clamp_(min=0.0).add_(NOISE)
    common = torch.addcmul(means[4], means[0], means[1], value=-1.0).add_(NOISE)
    return (common / (variances[0] * variances[1]).sqrt_()).clamp_(-1.0, 1.0)
