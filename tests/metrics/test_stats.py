"""Means, spreads and bootstrap intervals; stress/mask_cases.py has missing, infinite and equal values."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.stats import bootstrap_interval, mean, paired_interval, sample_std

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


def test_interval_against_every_resample_of_three_values() -> None:
    # All 27 resamples are equally likely: the exact distribution of the mean is known.
    values = [1.0, 2.0, 6.0]
    exact = sorted(float(np.mean(r)) for r in itertools.product(values, repeat=3))
    found = bootstrap_interval(values, level=0.8, resamples=20_000)
    assert found.mean == 3.0
    assert found.low == pytest.approx(exact[2]) and found.high == pytest.approx(exact[-3])
    assert found.count == 3


def test_interval_covers_the_mean_about_as_often_as_it_says() -> None:
    rng = np.random.default_rng(7)
    hits = 0
    for k in range(200):
        found = bootstrap_interval(rng.normal(1.0, 2.0, 40), level=0.9, resamples=400, seed=k)
        hits += found.low <= 1.0 <= found.high
    assert 0.82 <= hits / 200 <= 0.96


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=12), st.integers(0, 1000))
def test_interval_is_ordered_within_the_values_and_repeats(values: list[float], seed: int) -> None:
    found = bootstrap_interval(values, resamples=100, seed=seed)
    again = bootstrap_interval(values, resamples=100, seed=seed)
    if len(values) == 1:
        assert found.mean == values[0] and math.isnan(found.low) and math.isnan(found.high)
        return
    slack = 1e-9 * max(1.0, *(abs(v) for v in values))
    assert min(values) - slack <= found.low <= found.high <= max(values) + slack
    assert found == again


def test_pairing_takes_the_common_part_away() -> None:
    rng = np.random.default_rng(2)
    common = rng.normal(20.0, 5.0, 30)
    a, b = common + 0.5 + 0.05 * rng.standard_normal(30), common
    paired = paired_interval(a, b)
    assert 0.4 < paired.low < paired.mean < paired.high < 0.6
    alone = bootstrap_interval(a)
    assert alone.high - alone.low > 10 * (paired.high - paired.low)
    assert paired_interval([INF, 1.0], [INF, 1.0]).mean == 0.0
    with pytest.raises(AwError, match="2 and 1"):
        paired_interval([1.0, 2.0], [1.0])


def test_nonsense_is_named() -> None:
    with pytest.raises(AwError, match="level"):
        bootstrap_interval([1.0, 2.0], level=1.0)
    with pytest.raises(AwError, match="resamples"):
        bootstrap_interval([1.0, 2.0], resamples=3)
