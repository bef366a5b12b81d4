"""Medians and quantiles of what is there, on the device: how many that is, the host never learns."""

from __future__ import annotations

import torch
from torch import Tensor


def median(x: Tensor) -> Tensor:
    """Median over the last axis of what is not NaN; NaN where all is.

    As numpy's: of an even number the mean of the middle two. torch gives the lower of them.
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
    # of none both are infinite, and their difference is no number
    return (below + (rank - low) * (above - below)).nan_to_num_(nan=0.0), count


def spread_of(values: Tensor) -> tuple[Tensor, Tensor]:
    """Median and robust spread as in `threshold.robust_floor`, 0-d; NaN among values [n] is not there."""
    middle = median(values)
    deviation = 1.4826 * median((values - middle).abs_())
    return middle, torch.maximum(deviation, 0.05 * middle.abs()).clamp_(min=1e-12)
