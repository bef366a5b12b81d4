"""PSNR and SSIM against scikit-image (valid region) and a plain double loop (zero padding)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.image import METRICS, psnr, ssim, ssim_inria


def pair(
    height: int = 23, width: int = 31, noise: float = 0.1, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    a = rng.random((height, width, 3))
    return a, np.clip(a + noise * rng.standard_normal(a.shape), 0.0, 1.0)


def test_zero_padding_raises_ssim_of_a_noisy_picture() -> None:
    # The reason the variants have two names: windows at the border agree on their zeros.
    a, b = pair(60, 60)
    assert 0.0005 < ssim_inria(a, b) - ssim(a, b) < 0.1


def test_psnr_of_a_known_error() -> None:
    a = np.zeros((4, 4, 3))
    assert psnr(a, a + 0.1) == pytest.approx(20.0, abs=1e-9)
    assert psnr(a, a + 1.0) == 0.0


def test_uint8_and_float_of_the_same_picture_agree() -> None:
    rng = np.random.default_rng(3)
    a, b = (rng.integers(0, 256, (16, 16, 3), dtype=np.uint8) for _ in range(2))
    for metric in METRICS.values():
        assert metric(a, b) == pytest.approx(metric(a / 255.0, b / 255.0), abs=1e-12)
        assert metric(a, b / 255.0) == metric(a / 255.0, b)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_identical_and_constant_pictures(level: float) -> None:
    flat = np.full((20, 20, 3), level)
    assert psnr(flat, flat) == math.inf
    assert ssim(flat, flat) == 1.0 and ssim_inria(flat, flat) == 1.0


def test_ssim_of_two_constant_pictures_is_the_luminance_term() -> None:
    a, b = np.full((15, 15, 3), 0.25), np.full((15, 15, 3), 0.75)
    expected = (2 * 0.25 * 0.75 + 1e-4) / (0.25**2 + 0.75**2 + 1e-4)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1), noise=st.floats(0.0, 1.0))
def test_metrics_are_symmetric_and_bounded(seed: int, noise: float) -> None:
    a, b = pair(13, 12, noise, seed)
    for metric in METRICS.values():
        assert metric(a, b) == metric(b, a)
    assert -1.0 <= ssim(a, b) <= 1.0 + 1e-12
    assert psnr(a, b) >= 0.0


def test_ssim_of_a_picture_below_the_window_is_a_named_error() -> None:
    a, b = pair(10, 40)
    with pytest.raises(AwError, match=r"40x10 px is smaller than SSIM's 11x11 window"):
        ssim(a, b)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        (np.zeros((4, 4)), r"\[H, W, 3\]"),
        (np.zeros((4, 4, 4)), r"\[H, W, 3\]"),
        (np.zeros((0, 4, 3)), "not empty"),
        (np.zeros((4, 4, 3), np.int32), "int32"),
        (np.full((4, 4, 3), 1.001), "outside"),
        (np.full((4, 4, 3), np.nan), "outside"),
        (np.zeros((4, 5, 3)), "different size"),
    ],
)
def test_unusable_pictures_are_named(bad: np.ndarray, words: str) -> None:
    for metric in METRICS.values():
        with pytest.raises(AwError, match=words):
            metric(np.zeros((4, 4, 3)), bad)
