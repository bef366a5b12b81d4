"""Means and bootstrap intervals; a missing value makes the result missing.

A missing value is NaN (``None`` in a result file). A mean with one missing value is missing, so that a method
does not gain by failing on a hard scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.core import AwError


@dataclass(frozen=True)
class Interval:
    """A mean and its percentile bootstrap interval; NaN = missing or not defined."""

    mean: float
    low: float
    high: float
    count: int  # number of values


def mean(values: Sequence[float] | np.ndarray) -> float:
    """Arithmetic mean of the finite values; NaN if any value is NaN or none is finite.

    Infinite values are left out: the PSNR of a few equal pixels would decide every mean.
    """
    array = _checked(values)
    finite = array[np.isfinite(array)]
    return float(finite.mean()) if len(finite) and not np.isnan(array).any() else math.nan


def sample_std(values: Sequence[float] | np.ndarray) -> float:
    """Sample standard deviation (n - 1); NaN for fewer than two values or if one is not finite."""
    array = _checked(values)
    if len(array) < 2 or not np.isfinite(array).all():
        return math.nan
    return float(array.std(ddof=1))


def bootstrap_interval(
    values: Sequence[float] | np.ndarray,  # [n], one per image
    *,
    level: float = 0.95,  # coverage
    resamples: int = 2000,
    seed: int = 0,
) -> Interval:
    """Percentile bootstrap interval of the mean over images (Efron 1979).

    The ends are resampled means, not interpolated, so that ``inf`` needs no special case. One image has a
    mean but no interval. If any value is NaN, the result is NaN.

    Args:
        values: one per image.
        level: in (0, 1).
        resamples: at least 100.
        seed: the same values and seed give the same interval.

    Raises:
        AwError: no value, or an invalid level or number of resamples.
    """
    array = _checked(values)
    if not len(array):
        raise AwError("a bootstrap interval needs at least one value, got none")
    if not 0.0 < level < 1.0 or resamples < 100:
        raise AwError(f"level must be in (0, 1) and resamples at least 100, got {level} and {resamples}")
    if np.isnan(array).any():
        return Interval(math.nan, math.nan, math.nan, len(array))
    if len(array) == 1:
        return Interval(float(array[0]), math.nan, math.nan, 1)
    rows = np.random.default_rng(seed).integers(0, len(array), size=(resamples, len(array)))
    means = np.sort(array[rows].mean(axis=1))
    tail = (1.0 - level) / 2.0
    low = means[math.floor(tail * (resamples - 1))]
    high = means[math.ceil((1.0 - tail) * (resamples - 1))]
    return Interval(float(array.mean()), float(low), float(high), len(array))


def paired_interval(
    a: Sequence[float] | np.ndarray,  # [n], one per image
    b: Sequence[float] | np.ndarray,  # [n], the same images in the same order
) -> Interval:
    """Bootstrap interval of mean(a - b) over the same images: narrower than two separate intervals.

    Raises:
        AwError: different lengths, or see `bootstrap_interval`.
    """
    first, second = _checked(a), _checked(b)
    if len(first) != len(second):
        raise AwError(f"paired values must be of the same images, got {len(first)} and {len(second)} values")
    # inf - inf is 0 here: both images are identical to the truth.
    with np.errstate(invalid="ignore"):
        difference = np.where(first == second, 0.0, first - second)
    return bootstrap_interval(difference)


def _checked(values: Sequence[float] | np.ndarray) -> np.ndarray:
    array = np.asarray([math.nan if v is None else v for v in values], dtype=np.float64)
    if array.ndim != 1:
        raise AwError(f"values must be one per image, got shape {list(array.shape)}")
    return array
