"""Means, their intervals and tests by Student's t; a missing value makes the result missing.

A missing value is NaN (``None`` in a result file). A mean with one missing value is missing, so that a method
does not gain by failing on a hard scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambiguous_wild.core import AwError

LEVEL = 0.95  # coverage of intervals


@dataclass(frozen=True)
class Interval:
    """A mean, its 95 % interval, and the p that the true mean is zero; NaN = missing or not defined."""

    mean: float
    low: float
    high: float
    count: int  # number of values
    p: float = math.nan  # two-sided

    def within(self, low: float, high: float) -> Interval:
        """Return the part of the interval that is possible; it holds the truth as often."""
        return replace(self, low=max(self.low, low), high=min(self.high, high))


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


def mean_interval(
    values: Sequence[float] | np.ndarray,  # [n], of independent units: images of a scene, or scenes
) -> Interval:
    """Student's t interval of the mean.

    One value has a mean but no interval. If any value is NaN or infinite, so is the mean; it has no interval.

    Raises:
        AwError: no value.
    """
    array = _checked(values)
    if not len(array):
        raise AwError("an interval needs at least one value, got none")
    if not np.isfinite(array).all():
        return Interval(float(array.mean()) if not np.isnan(array).any() else math.nan, math.nan, math.nan,
                        len(array))  # fmt: skip
    if len(array) == 1:
        return Interval(float(array[0]), math.nan, math.nan, 1)
    return _t_interval(float(array.mean()), array.var(ddof=1) / len(array), len(array) - 1, len(array))


def paired_interval(
    a: Sequence[float] | np.ndarray,  # [n], one per image
    b: Sequence[float] | np.ndarray,  # [n], the same images in the same order
) -> Interval:
    """Interval of mean(a - b) over the same images: narrower than two separate intervals.

    Raises:
        AwError: different lengths, or see `mean_interval`.
    """
    first, second = _checked(a), _checked(b)
    if len(first) != len(second):
        raise AwError(f"paired values must be of the same images, got {len(first)} and {len(second)} values")
    # inf - inf is 0 here: both images are identical to the truth.
    with np.errstate(invalid="ignore"):
        difference = np.where(first == second, 0.0, first - second)
    return mean_interval(difference)


def difference_interval(
    scenes: Sequence[tuple[np.ndarray, np.ndarray]],  # of each: a [n, seeds of a] and b [n, seeds of b]
) -> Interval:
    """Interval of the mean over these scenes of the mean over images of a - b, for other images and seeds.

    Images of a scene are random and paired. Seeds are random too, and each affects all images of a scene (a
    crossed random effect): their variance is that of the means over seeds without what images explain. It is
    unknown for a method with one seed, whose training is taken as it is. The degrees of freedom are those of
    Satterthwaite (1946).

    The interval is NaN if a value is missing or a scene has less than two images.
    """
    means: list[float] = []
    terms: list[tuple[float, int]] = []  # (variance of the scene's mean, degrees of freedom)
    for a, b in scenes:
        images = a.mean(axis=1) - b.mean(axis=1)
        means.append(float(images.mean()) if len(images) else math.nan)
        if len(images) < 2:
            terms.append((math.nan, 1))
            continue
        terms.append((float(images.var(ddof=1)) / len(images), len(images) - 1))
        terms += [(_seed_variance(m), m.shape[1] - 1) for m in (a, b) if m.shape[1] > 1]
    average = float(np.mean(means)) if means else math.nan
    count = sum(len(a) for a, _ in scenes)
    variances = np.array([variance for variance, _ in terms])
    if not math.isfinite(average) or not np.isfinite(variances).all():
        return Interval(average, math.nan, math.nan, count)
    spread = float((variances**2 / [freedom for _, freedom in terms]).sum())
    freedom = variances.sum() ** 2 / spread if spread else math.inf
    return _t_interval(average, float(variances.sum()) / len(scenes) ** 2, freedom, count)


def _seed_variance(values: np.ndarray) -> float:
    """Return the variance that seeds give to the mean of values [n, seeds]; 0 where images explain it."""
    seeds = values.mean(axis=0)
    rest = values - values.mean(axis=1, keepdims=True) - seeds + values.mean()
    n, k = values.shape
    noise = float((rest**2).sum()) / ((n - 1) * (k - 1))
    return max(float(seeds.var(ddof=1)) - noise / n, 0.0) / k


def _t_interval(mean: float, variance: float, freedom: float, count: int) -> Interval:
    if not variance:  # all values are equal
        return Interval(mean, mean, mean, count, p=float(mean == 0.0))
    from scipy.special import stdtr, stdtrit

    error = math.sqrt(variance)
    half = float(stdtrit(freedom, (1.0 + LEVEL) / 2.0)) * error
    return Interval(mean, mean - half, mean + half, count, p=2.0 * float(stdtr(freedom, -abs(mean) / error)))


def holm(ps: Sequence[float]) -> list[float]:
    """Return p values corrected for their number (Holm 1979); NaN is no comparison and stays NaN."""
    order = sorted((p, i) for i, p in enumerate(ps) if not math.isnan(p))
    corrected, highest = [math.nan] * len(ps), 0.0
    for rank, (p, i) in enumerate(order):
        highest = max(highest, min(1.0, (len(order) - rank) * p))
        corrected[i] = highest
    return corrected


def _checked(values: Sequence[float] | np.ndarray) -> np.ndarray:
    array = np.asarray([math.nan if v is None else v for v in values], dtype=np.float64)
    if array.ndim != 1:
        raise AwError(f"values must be one per image, got shape {list(array.shape)}")
    return array
