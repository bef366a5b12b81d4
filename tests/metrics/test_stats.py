"""Means, spreads, intervals and tests; stress/mask_cases.py has missing, infinite and equal values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import bootstrap, f_oneway, ttest_1samp

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.stats import (
    difference_interval,
    holm,
    mean,
    mean_interval,
    paired_interval,
    sample_std,
)

NAN, INF = math.nan, math.inf


def test_a_mean_over_a_missing_cell_is_missing() -> None:
    assert mean([1.0, 2.0, 4.5]) == 2.5
    assert math.isnan(mean([1.0, NAN])) and math.isnan(mean([1.0, None]))  # type: ignore[list-item]
    assert math.isnan(mean([]))
    assert mean([1.0, INF]) == 1.0 and math.isnan(mean([INF])) and math.isnan(mean([INF, NAN]))


def test_spread_is_the_sample_deviation() -> None:
    assert sample_std([1.0, 3.0]) == pytest.approx(math.sqrt(2.0))
    assert sample_std([5.0, 5.0, 5.0]) == 0.0
    for values in ([], [1.0], [1.0, NAN], [1.0, INF]):
        assert math.isnan(sample_std(values))


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=12).filter(lambda v: np.std(v) > 1e-3))
def test_interval_and_p_are_those_of_scipy(values: list[float]) -> None:
    found, expected = mean_interval(values), ttest_1samp(values, 0.0)
    low, high = expected.confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((low, high), rel=1e-7, abs=1e-7)
    assert found.p == pytest.approx(expected.pvalue, rel=1e-7) and found.count == len(values)
    # one scene and one seed: the same, image by image
    a, b = np.array(values)[:, None], np.zeros((len(values), 1))
    nested = difference_interval([(a, b)])
    assert (nested.low, nested.high, nested.p) == pytest.approx((found.low, found.high, found.p), rel=1e-6)


def test_equal_values_have_no_width() -> None:
    assert mean_interval([0.25] * 4) == paired_interval([1.25] * 4, [1.0] * 4)
    assert (mean_interval([0.25] * 4).low, mean_interval([0.25] * 4).p) == (0.25, 0.0)
    assert mean_interval([0.0, 0.0]).p == 1.0


def crossed(rng: np.random.Generator, images: int, seeds: int, seed_sd: float) -> np.ndarray:
    """Values [images, seeds] of one method beside what methods share: an effect of the seed, and noise."""
    return seed_sd * rng.standard_normal((1, seeds)) + 0.15 * rng.standard_normal((images, seeds))


def shared(rng: np.random.Generator, images: int, skewed: bool) -> np.ndarray:
    """By how much images differ in a difference of methods: deviation 1, mean 0."""
    one = rng.gamma(4.0, 0.5, (images, 1)) - 2.0 if skewed else rng.standard_normal((images, 1))
    return np.asarray(one)


@pytest.mark.parametrize("skewed", [False, True], ids=["normal", "skewness 1"])
@pytest.mark.parametrize(
    ("scenes", "images", "seeds", "seed_sd"),
    [(1, 5, 1, 0.0), (1, 5, 3, 0.3), (1, 20, 2, 0.3), (3, 8, 3, 0.3), (9, 5, 1, 0.0), (9, 5, 3, 0.3)],
)
def test_intervals_over_images_and_seeds_hold_the_truth_as_often_as_they_say(
    scenes: int, images: int, seeds: int, seed_sd: float, skewed: bool
) -> None:
    rng, hits, count = np.random.default_rng(11), 0, 1200
    for _ in range(count):
        of = [
            (
                shared(rng, images, skewed) + crossed(rng, images, seeds, seed_sd),
                crossed(rng, images, seeds, seed_sd),
            )
            for _ in range(scenes)
        ]
        found = difference_interval(of)
        hits += found.low <= 0.0 <= found.high
    assert 0.93 <= hits / count <= 0.97


@pytest.mark.parametrize("skewed", [False, True], ids=["normal", "skewness 1"])
@pytest.mark.parametrize("scenes", [2, 3, 9, 20])
def test_intervals_over_scenes_hold_the_truth_and_p_is_uniform(scenes: int, skewed: bool) -> None:
    """Scenes have effects, and 5 to 40 images each, whose means know them more or less well."""
    rng, hits, rejected, count = np.random.default_rng(12), 0, 0, 4000
    images = np.resize([5, 8, 20, 40], scenes)
    for _ in range(count):
        means = shared(rng, scenes, skewed)[:, 0] + rng.standard_normal(scenes) / np.sqrt(images)
        found = mean_interval(means)
        hits += found.low <= 0.0 <= found.high
        rejected += found.p < 0.05
    assert hits + rejected == count
    assert 0.93 <= hits / count <= 0.97


@pytest.mark.parametrize("method", ["percentile", "BCa"])
def test_bootstraps_of_few_values_are_too_short(method: str) -> None:
    """Why intervals are Student's t; docs/tables.md has these shares."""
    values = np.random.default_rng(14).standard_normal((1000, 5))
    found = bootstrap((values,), np.mean, axis=1, n_resamples=499, method=method, batch=100, rng=1)
    low, high = found.confidence_interval
    assert ((low <= 0.0) & (high >= 0.0)).mean() < 0.88


def test_without_the_seeds_an_interval_is_too_short() -> None:
    rng, hits = np.random.default_rng(13), 0
    for _ in range(400):
        a, b = (crossed(rng, 5, 3, 1.0) for _ in range(2))
        found = mean_interval((a + shared(rng, 5, False) - b).mean(axis=1))
        hits += found.low <= 0.0 <= found.high
    assert hits / 400 < 0.85


def test_the_variance_of_seeds_is_that_of_an_analysis_of_variance() -> None:
    rng = np.random.default_rng(4)
    values = rng.standard_normal((6, 4)) + 2.0 * rng.standard_normal(4)
    centred = values - values.mean(axis=1, keepdims=True)  # images explain nothing
    found = difference_interval([(centred, np.zeros((6, 1)))])
    # one-way F with 3 and 20 degrees of freedom; images took 5 of the 20
    ratio = f_oneway(*centred.T).statistic
    between = 6 * centred.mean(axis=0).var(ddof=1)
    within = between / ratio * 20 / 15
    half = 3.182446 * math.sqrt((between - within) / 6 / 4)  # Student's t of 3 degrees of freedom
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=1e-6)


def test_a_difference_without_an_interval() -> None:
    one, two = np.array([[1.0]]), np.array([[2.0], [3.0]])
    found = difference_interval([(one, one - 1.0), (two, two - 2.0)])
    assert found.mean == 1.5 and math.isnan(found.low) and found.count == 3
    gap = np.array([[1.0], [NAN]])
    assert math.isnan(difference_interval([(gap, two)]).mean) and math.isnan(difference_interval([]).mean)


def test_holm_corrects_as_in_a_worked_example() -> None:
    # of R's p.adjust(c(0.01, 0.04, 0.03, 0.005), "holm")
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, NAN, 0.9])[0] == 1.0 and math.isnan(holm([0.6, NAN, 0.9])[1]) and holm([0.2]) == [0.2]


def test_pairing_takes_the_common_part_away() -> None:
    rng = np.random.default_rng(2)
    common = rng.normal(20.0, 5.0, 30)
    a, b = common + 0.5 + 0.05 * rng.standard_normal(30), common
    paired = paired_interval(a, b)
    assert 0.4 < paired.low < paired.mean < paired.high < 0.6
    alone = mean_interval(a)
    assert alone.high - alone.low > 10 * (paired.high - paired.low)
    assert paired_interval([INF, 1.0], [INF, 1.0]).mean == 0.0
    with pytest.raises(AwError, match="2 and 1"):
        paired_interval([1.0, 2.0], [1.0])


def test_nonsense_is_named() -> None:
    with pytest.raises(AwError, match="at least one value"):
        mean_interval([])
    with pytest.raises(AwError, match="one per image"):
        mean_interval(np.zeros((2, 2)))
