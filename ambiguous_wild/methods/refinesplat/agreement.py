"""Whether two photos show the same colours, and the combined evidence of several views. Pure functions."""

from __future__ import annotations

import numpy as np

FAR_MORE = 1.5  # times as many pixels


def agree(difference: np.ndarray, same: np.ndarray, most: float, offset: np.ndarray) -> np.ndarray:
    """Pixels where two pictures show the same colour, bool [h, w].

    Args:
        difference: [h, w, 3] of their colours (`colour_difference`).
        same: [h, w] bool, where they show the same surface.
        most: difference in [0, 1] up to which two colours are the same.
        offset: [3], their common colour offset (`common_offset`).
    """
    return same & (np.abs(difference - offset).mean(axis=2) < most)


def colour_difference(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """[h, w, 3] float32 in [-1, 1] of two uint8 pictures."""
    return np.subtract(ours, theirs, dtype=np.float32) / np.float32(255.0)


def common_offset(difference: np.ndarray, same: np.ndarray, most: float = 0.06) -> np.ndarray:
    """The colour offset between two pictures of the same surfaces, [3] float32; zeros if there is none.

    The median difference is an offset (exposure, weather) only if far more pixels agree once it is
    subtracted; behind a crowd it is chance.

    Args:
        difference: [h, w, 3] of their colours in [0, 1].
        same: [h, w] bool, where they show the same surface.
        most: difference up to which two colours are the same.
    """
    some = difference[::2, ::2][same[::2, ::2]]
    if len(some):
        common = np.median(some, axis=0)
        as_they_are = np.count_nonzero(np.abs(some).mean(axis=1) < most)
        if np.count_nonzero(np.abs(some - common).mean(axis=1) < most) > FAR_MORE * as_they_are:
            return common.astype(np.float32)
    return np.zeros(3, np.float32)


def agreement_weight(seen: np.ndarray, agreeing: np.ndarray, enough: float, always: np.ndarray) -> np.ndarray:
    """Weight of the evidence of n views, [h, w] float32 in [0, 1].

    Args:
        seen: [n, h, w] bool, the views that see the surface.
        agreeing: [n, h, w] bool, those that see it in the same colour.
        enough: above 0, share of the seeing views that must agree for a weight of 1.
        always: [h, w] bool, pixels whose weight is 1 in any case.
    """
    share = agreeing.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    weight = np.minimum(share / enough, 1.0)
    return np.where(always, 1.0, weight).astype(np.float32)


def quantile_of(stack: np.ndarray, quantile: float) -> np.ndarray:
    """Quantile over the first axis of [n, h, w] ignoring NaN, linear between ranks; NaN if all are NaN.

    One sort: numpy's nanquantile takes fifty times as long on such a stack.
    """
    ordered = np.sort(stack, axis=0)  # NaN goes last
    last = np.maximum((~np.isnan(stack)).sum(axis=0) - 1, 0)
    rank = quantile * last
    low = np.floor(rank).astype(np.int64)
    high = np.minimum(low + 1, last)
    share = (rank - low).astype(np.float32)
    below = np.take_along_axis(ordered, low[None], axis=0)[0]
    above = np.take_along_axis(ordered, high[None], axis=0)[0]
    return below + share * (above - below)
