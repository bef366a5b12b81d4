"""Agreement of colours between views, and their combined evidence: agreement.py with torch.

Colours are as uint8 holds them, 0 to 255, in float32.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.methods.refinesplat.agreement import FAR_MORE
from ambiguous_wild.methods.refinesplat.on_device.ranks import median

_WHITE = 255.0


def agree(difference: Tensor, same: Tensor, most: float, offset: Tensor) -> Tensor:
    """Where pictures show the same colour, bool [n, s, h, w].

    Args:
        difference: [n, 3, s, h, w] of the colours of n views, on s surfaces.
        same: [n, s, h, w] bool, where they show the same surface.
        most: difference in [0, 1] up to which two colours are the same.
        offset: [n, 3], from `common_offset`.
    """
    apart = (difference - offset[:, :, None, None, None]).abs_().mean(1)
    return (apart < most * _WHITE) & same


def common_offset(difference: Tensor, same: Tensor, most: float) -> Tensor:
    """As `agreement.common_offset` of every second pixel, of n views at once: [n, 3].

    Args:
        difference: [n, 3, h, w] of their colours.
        same: [n, h, w] bool, where they show the same surface.
        most: difference in [0, 1] up to which two colours are the same.
    """
    some = torch.where(same[:, None], difference, torch.nan).flatten(2)  # [n, 3, pixels]
    common = median(some)
    apart = torch.stack([some, some - common[..., None]]).abs_().mean(2)  # [2, n, pixels]
    # comparisons with NaN are false: pixels of other surfaces, and views without any, do not agree
    as_they_are, shifted = (apart < most * _WHITE).sum(2)
    return common.masked_fill((shifted <= FAR_MORE * as_they_are)[:, None], 0.0)


def agreement_weight(seen: Tensor, agreed: Tensor, enough: float, always: Tensor) -> Tensor:
    """As `agreement.agreement_weight`, from counts of seeing and agreeing views, [h, w] int64."""
    share = agreed / seen.clamp(min=1)
    return (share / enough).clamp_(max=1.0).masked_fill_(always, 1.0)


class Ranks:
    """Quantiles over n views of which any number may be missing: ranks by the number present."""

    def __init__(self, views: int, quantile: float, device: torch.device | str) -> None:
        last = np.maximum(np.arange(views + 1) - 1, 0)
        low = np.floor(quantile * last)
        share = (quantile * last - low).astype(np.float32)
        pair = np.stack([low, np.minimum(low + 1, last)]).astype(np.int64)
        self.pair = torch.from_numpy(pair).to(device)  # [2, views + 1]
        self.share = torch.from_numpy(share).to(device)  # [views + 1]

    def quantile_of(self, stack: Tensor, there: Tensor) -> Tensor:
        """As `agreement.quantile_of`, [h, w] of [n, h, w], of which `there` [h, w] are not NaN."""
        ordered = stack.sort(0).values  # NaN goes last
        below, above = ordered.gather(0, self.pair[:, there])
        return below + self.share[there] * (above - below)
