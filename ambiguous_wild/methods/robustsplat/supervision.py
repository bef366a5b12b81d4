"""The targets and the loss of RobustSplat's mask net: cosine target, residual bounds. Pure functions.

Maps are [H, W] float32, 1 = static.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.splat.backend import backend_of


def cosine_target(cosine: Tensor) -> Tensor:
    """T_cos = 1 - clip(1 - (c - 0.5) / 0.5, 0, 1): 1 where photo and render agree, 0 from 0.5 down."""
    return 1.0 - (1.0 - (cosine - 0.5) / 0.5).clamp(0.0, 1.0)


def calibrated(cosine: Tensor, unit: float, normal: float) -> Tensor:
    """The cosine stretched to its whole range: 0 at a distance of `normal` units, -1 from twice that.

    Cosines of hand-made features stay above 0.99, where the published target is 1 everywhere. The unit is
    the cosine distance that blur and noise alone make (`Features.unit`).
    """
    return 1.0 - ((1.0 - cosine) / (unit * normal)).clamp(0.0, 2.0)


def relative_target(distance: Tensor, usual: float | Tensor, reach: float) -> Tensor:
    """1 up to the `usual` distance of features, 0 from `reach` times that on, linear between.

    What a render that is still blurred lacks everywhere is usual; what it lacks here alone is not.
    """
    usual = max(usual, 1e-6) if isinstance(usual, float) else usual.clamp(min=1e-6)
    return 1.0 - ((distance / usual - 1.0) / (reach - 1.0)).clamp(0.0, 1.0)


def residual(photo: Tensor, render: Tensor) -> Tensor:
    """Mean over channels of |photo - render|, [H, W], of pictures [H, W, 3]; at most 1."""
    return (photo - render).abs().mean(dim=2).clamp(max=1.0)


def update_histogram(histogram: Tensor, values: Tensor, decay: float) -> Tensor:
    """h <- decay h + hist(values); `histogram` [bins] float64 over [0, 1], values in [0, 1]."""
    bins = len(histogram)
    index = (values.reshape(-1).double() * bins).long().clamp(0, bins - 1)
    return decay * histogram + backend_of(histogram.device).label_sums(index, bins)


def percentile(histogram: Tensor, share: float) -> float | Tensor:
    """The smallest bin edge with at least `share` of all counts below it; 1 for an empty histogram.

    As `Backend.number`: a 0-d tensor on a GPU, so that the host does not wait for it.
    """
    total = histogram.sum()
    # a little below the target for rounding, so that 0.6 of 10 equal counts is six of them
    reached = torch.cumsum(histogram, 0) >= share * total * (1.0 - 1e-12)
    first = reached.int().argmax()  # of equal values the first
    edge = ((first + 1).to(histogram) / len(histogram)).masked_fill(total <= 0, 1.0)
    return backend_of(histogram.device).number(edge)


def bound(e: Tensor, threshold: float | Tensor) -> Tensor:
    """1 where e < threshold for the pixel or for over half of its 3x3 neighbourhood; outside counts as 0."""
    inlier = (e < threshold).float()
    near = F.avg_pool2d(inlier[None, None], 3, stride=1, padding=1)[0, 0]
    return ((inlier > 0) | (near > 0.5)).float()


def resized(grid: Tensor, height: int, width: int) -> Tensor:
    """A map [h, w] at [height, width], bilinear."""
    if grid.shape == (height, width):
        return grid
    return F.interpolate(grid[None, None], size=(height, width), mode="bilinear", align_corners=False)[0, 0]


def mask_loss(
    mask: Tensor,  # [H, W] of the net, in (0, 1)
    target: Tensor,  # [H, W] T_cos
    lower: Tensor,  # [H, W] bound below
    upper: Tensor,  # [H, W] bound above
    nominal: float,
    *,
    lambda_cosine: float = 0.5,
    lambda_residual: float = 0.5,
    lambda_pull: float = 2.0,
    beta: float = 2000.0,
) -> Tensor:
    """0.5 mean|M - T_cos| + 0.5 mean(relu(M - u) + relu(l - M)) + 2 exp(-it / beta) mean(1 - M).

    The authors' last term, 0.5 max|W1| max|W2|, is made from detached weights, hence constant and left out.
    """
    pull = lambda_pull * math.exp(-nominal / beta)
    bounds = (F.relu(mask - upper) + F.relu(lower - mask)).mean()
    return (
        lambda_cosine * (mask - target).abs().mean() + lambda_residual * bounds + pull * (1.0 - mask).mean()
    )


def keep_of(mask: Tensor, threshold: float, erosion: int) -> Tensor:
    """[M > threshold], the static region eroded by a min-pool of side `erosion`."""
    kept = (mask > threshold).float()
    return -F.max_pool2d(-kept[None, None], erosion, stride=1, padding=erosion // 2)[0, 0]
