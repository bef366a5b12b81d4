"""Mask scores against sets of pixels; PSNR on kept pixels against an explicit loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.metrics.mask_scores import Confusion, confusion, pooled, psnr_valid


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 1.0))
def test_scores_equal_set_arithmetic(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    keep, truth = rng.random((6, 7)) >= share, rng.random((6, 7)) >= 0.4
    masked = {tuple(p) for p in np.argwhere(~keep)}
    transient = {tuple(p) for p in np.argwhere(~truth)}
    counts = confusion(keep, truth)
    for value, part, whole in (
        (counts.iou, masked & transient, masked | transient),
        (counts.precision, masked & transient, masked),
        (counts.recall, masked & transient, transient),
    ):
        assert math.isnan(value) if not whole else value == len(part) / len(whole)


def test_extremes() -> None:
    keep, drop = np.ones((3, 4), bool), np.zeros((3, 4), bool)
    assert confusion(drop, drop).iou == 1.0
    assert confusion(keep, drop) == Confusion(false_negative=12)
    assert confusion(keep, drop).iou == 0.0 and math.isnan(confusion(keep, drop).precision)
    nothing = confusion(keep, keep)
    assert math.isnan(nothing.iou) and math.isnan(nothing.recall)


def test_pooling_weighs_pixels_and_survives_a_photo_without_distractors() -> None:
    truth = np.ones((4, 4), bool)
    truth[0] = False
    found, clean = confusion(truth, truth), confusion(np.ones((4, 4), bool), np.ones((4, 4), bool))
    assert pooled([found, clean]).iou == 1.0
    slip = np.ones((4, 4), bool)
    slip[0, :2] = False
    assert pooled([found, confusion(slip, np.ones((4, 4), bool))]).iou == 4 / 6
    assert pooled([]) == Confusion()


def test_kinds_of_maps_agree() -> None:
    keep = np.array([[True, False, True]])
    truth = np.array([[True, True, False]])
    expected = confusion(keep, truth)
    assert confusion(keep.astype(np.uint8) * 255, truth.astype(np.float32)) == expected


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (np.ones((2, 2, 1), bool), r"\[H, W\]"),
        (np.ones((2, 2), np.uint8), "values 0 and 1"),
        (np.full((2, 2), 2.0), "outside"),
        (np.full((2, 2), np.nan), "outside"),
        (np.ones((2, 2), np.int64), "int64"),
        (np.ones((3, 2), bool), "different size"),
    ],
)
def test_unusable_maps_are_named(bad: np.ndarray, words: str) -> None:
    with pytest.raises(AwError, match=words):
        confusion(bad, np.ones((2, 2), bool))


def test_psnr_valid_divides_by_the_kept_pixels() -> None:
    rng = np.random.default_rng(1)
    a, b, keep = rng.random((9, 8, 3)), rng.random((9, 8, 3)), rng.random((9, 8)) > 0.6
    errors = [(a[i, j] - b[i, j]) ** 2 for i in range(9) for j in range(8) if keep[i, j]]
    assert psnr_valid(a, b, keep) == pytest.approx(-10 * math.log10(np.mean(errors)), abs=1e-12)
    # What the other convention would report: higher by the kept share alone.
    product = psnr(a * keep[..., None], b * keep[..., None])
    assert product - psnr_valid(a, b, keep) == pytest.approx(-10 * math.log10(keep.mean()), abs=1e-10)


def test_psnr_valid_at_its_ends() -> None:
    a = np.full((5, 5, 3), 0.5)
    b = a.copy()
    b[2, 2] = 0.6
    keep = np.zeros((5, 5), bool)
    assert math.isnan(psnr_valid(a, b, keep))
    keep[2, 2] = True
    assert psnr_valid(a, b, keep) == pytest.approx(20.0, abs=1e-9)
    assert psnr_valid(a, b, ~keep) == math.inf
    assert psnr_valid(a, b, np.ones((5, 5), bool)) == psnr(a, b)
    with pytest.raises(AwError, match="different size"):
        psnr_valid(a, b, np.ones((5, 4), bool))
