"""Ambiguity scores against plain loops and planted answers; stress/mask_cases.py has the edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics import ambiguity as am


def pictures(seed: int = 0, size: tuple[int, int] = (7, 9)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    photo, background = rng.random((*size, 3)), rng.random((*size, 3))
    background = np.where(rng.random(size)[..., None] < 0.5, np.clip(photo + 0.1, 0, 1), background)
    return photo.astype(np.float32), background.astype(np.float32), rng.random(size) < 0.4


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6))
def test_counts_equal_a_loop_over_pixels(seed: int) -> None:
    photo, background, mask = pictures(seed)
    known = np.random.default_rng(seed + 1).random(mask.shape) < 0.8
    close = measured = 0
    total = 0.0
    for i, j in zip(*np.nonzero(mask)):
        if known[i, j]:
            d = math.dist(photo[i, j].astype(float), background[i, j].astype(float))
            measured, close, total = measured + 1, close + (d < am.COLOUR_THRESHOLD), total + d
    got = am.colour_counts(photo, background, mask, known=known)
    assert (got.distractor, got.known, got.close) == (mask.sum(), measured, close)
    assert got.residual_sum == pytest.approx(total) and got.unknown == mask.sum() - measured


def test_unknown_background_is_counted_and_left_out() -> None:
    photo, background, mask = pictures()
    lost = am.colour_counts(photo, None, mask)
    assert lost.unknown == mask.sum() and math.isnan(lost.close_share)
    seen = am.colour_counts(photo, background, mask)
    both = am.pooled([lost, seen])
    assert both.close_share == seen.close_share and both.unknown == mask.sum()
    assert both.occlusion == pytest.approx(mask.mean())
    assert math.isnan(am.pooled([]).occlusion)
    assert am.verdict(0.31, 0.3) and not am.verdict(0.3, 0.3)


def test_black_against_white_is_the_farthest() -> None:
    black, white = np.zeros((2, 2, 3), np.float32), np.ones((2, 2, 3), np.float32)
    np.testing.assert_allclose(am.colour_residual(black, white), math.sqrt(3))


def test_wrong_inputs_are_named() -> None:
    photo, background, mask = pictures()
    for pictures_, message in (
        ((photo, background[:3], mask), "must both be"),
        ((photo, background, mask.astype(np.uint8)), "must be bool"),
        ((photo * 255, background, mask), r"in \[0, 1\]"),
    ):
        with pytest.raises(AwError, match=message):
            am.colour_counts(*pictures_)
    with pytest.raises(AwError, match="one per photo"):
        am.ratio_interval([1, 2], [1])


def test_interval_of_the_pooled_ratio() -> None:
    rng = np.random.default_rng(0)
    whole = rng.integers(50, 500, 40)
    part = rng.binomial(whole, rng.beta(4, 6, 40))
    got = am.ratio_interval(part, whole, seed=3)
    assert got.mean == pytest.approx(part.sum() / whole.sum()) and got.low < got.mean < got.high
    assert got == am.ratio_interval(part, whole, seed=3)
    # Linearised variance of a ratio estimator, an independent estimate of the same width.
    error = math.sqrt(((part - got.mean * whole) ** 2).sum()) / whole.sum()
    assert got.high - got.low == pytest.approx(2 * 1.96 * error, rel=0.15)


def test_interval_edges() -> None:
    constant = am.ratio_interval([2, 4, 6], [4, 8, 12])
    assert (constant.low, constant.mean, constant.high) == (0.5, 0.5, 0.5)
    one = am.ratio_interval([1], [4])
    assert one.mean == 0.25 and math.isnan(one.low)
    empty = am.ratio_interval([0, 0], [0, 0])
    assert math.isnan(empty.mean) and empty.count == 0
    # Photos without distractors may be all that a resample draws: it has no ratio and is left out.
    sparse = am.ratio_interval([1, 0], [2, 0])
    assert (sparse.low, sparse.mean, sparse.high) == (0.5, 0.5, 0.5)
