"""Medians and quantiles that ignore missing values, on the device; the host never reads their number."""

from __future__ import annotations

import torch
from torch import Tensor


def median(x: Tensor) -> Tensor:
    """Median over the last axis, ignoring NaN; NaN if all are NaN.

    As numpy's, the mean of the middle two of an even number; torch gives the lower one.
    """
    return 0.5 * (torch.nanmedian(x, -1).values - torch.nanmedian(-x, -1).values)


def low_quantile(x: Tensor, left_out: Tensor, quantile: float) -> tuple[Tensor, Tensor]:
    """Quantile of the pixels of x [H, W] that are not left out (bool), linear between ranks; 0 of none.

    Returns:
        The quantile, 0-d float64, and how many pixels it is of, 0-d int64.
    """
    ordered = x.masked_fill(left_out, torch.inf).flatten().sort().values
    count = x.numel() - left_out.sum()
    rank = (count.double() - 1.0).clamp_(min=0.0) * quantile
    low = rank.floor()
    below, above = ordered.double().gather(0, torch.stack([low, rank.ceil()]).long())
    # with no pixel both are infinite and their difference is NaN
    return (below + (rank - low) * (above - below)).nan_to_num_(nan=0.0), count


def spread_of(values: Tensor) -> tuple[Tensor, Tensor]:
    """Median and robust spread as in `threshold.robust_floor`, 0-d; NaN among values [n] is ignored."""
    middle = median(values)
    deviation = 1.4826 * median((values - middle).abs_())
    return middle, torch.maximum(deviation, 0.05 * middle.abs()).clamp_(min=1e-12)
