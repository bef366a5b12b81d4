"""What holds for the metrics of any picture.

test_oracles.py has the values of other people's code, stress/mask_cases.py identical and constant pictures.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage.metrics import peak_signal_noise_ratio

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.image import flip, flip_map, psnr, psnr_affine, ssim, ssim_inria


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


def test_uint8_and_float_of_the_same_picture_agree() -> None:
    rng = np.random.default_rng(3)
    a, b = (rng.integers(0, 256, (16, 16, 3), dtype=np.uint8) for _ in range(2))
    for metric in (psnr, ssim, ssim_inria):
        assert metric(a, b) == pytest.approx(metric(a / 255.0, b / 255.0), abs=1e-12)
        assert metric(a, b / 255.0) == metric(a / 255.0, b)


@given(seed=st.integers(0, 2**32 - 1), noise=st.floats(0.0, 1.0))
def test_metrics_are_symmetric_and_bounded(seed: int, noise: float) -> None:
    a, b = pair(13, 12, noise, seed)
    for metric in (psnr, ssim, ssim_inria):
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
    for metric in (psnr, ssim, ssim_inria, flip, psnr_affine):
        with pytest.raises(AwError, match=words):
            metric(np.zeros((4, 4, 3)), bad)


def codes(seed: int = 0, size: tuple[int, int] = (20, 24)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


def test_identity_symmetry_range_and_kinds_of_numbers() -> None:
    a, b = codes(0), codes(1)
    assert flip(a, a) == 0.0
    assert flip(a, b) == pytest.approx(flip(b, a), abs=1e-12)
    error = flip_map(a, b)
    assert error.shape == (20, 24) and error.min() >= 0.0 and 0.1 < error.max() <= 1.0
    assert flip(a / 255.0, b) == pytest.approx(flip(a, b), abs=1e-12)


def test_the_error_lies_where_the_pictures_differ_and_grows_with_the_difference() -> None:
    grey = np.full((60, 60, 3), 128, np.uint8)
    errors = []
    for level in (132, 150, 200):
        changed = grey.copy()
        changed[25:35, 25:35] = level
        error = flip_map(grey, changed)
        assert error[28:32, 28:32].min() > 5 * max(error[:8].max(), 1e-9)
        errors.append(error.mean())
    assert errors == sorted(errors)


def recoloured(seed=0, size=(23, 31), noise=0.05):
    rng = np.random.default_rng(seed)
    photo = rng.random((*size, 3))
    return np.clip(0.7 * photo[..., [1, 0, 2]] + 0.1 + noise * rng.standard_normal(photo.shape), 0, 1), photo


@pytest.mark.parametrize("seed", range(5))
def test_it_equals_least_squares_on_all_pixels(seed):
    render, photo = recoloured(seed)
    design = np.column_stack([render.reshape(-1, 3), np.ones(render.size // 3)])
    fit = np.linalg.lstsq(design, photo.reshape(-1, 3), rcond=None)[0]
    oracle = peak_signal_noise_ratio(photo.reshape(-1, 3), np.clip(design @ fit, 0, 1), data_range=1.0)
    assert psnr_affine(render, photo) == pytest.approx(oracle, abs=1e-6)
    bytes_ = [np.uint8(255 * picture + 0.5) for picture in (render, photo)]
    assert psnr_affine(*bytes_) == pytest.approx(psnr_affine(*(b / 255 for b in bytes_)), abs=1e-9)


def test_exposure_and_white_balance_do_not_count():
    photo = 0.2 + 0.6 * recoloured()[1]
    render = 0.1 + 0.5 * photo * [0.8, 1.0, 1.2]
    assert psnr(render, photo) < 20 and psnr_affine(render, photo) > 100
    other = photo.copy()
    other[:12] = 0.5  # but what is elsewhere does
    assert psnr_affine(other, photo) < 25


@pytest.mark.parametrize(
    "render", [np.full((8, 9, 3), 0.3), np.repeat(recoloured(size=(8, 9))[0][..., :1], 3, axis=2)]
)
def test_flat_and_grey_renders_are_fitted_too(render):
    photo = recoloured(size=(8, 9))[1]
    assert math.isfinite(psnr_affine(render, photo)) and psnr_affine(render, photo) >= psnr(render, photo)


def test_one_pixel_is_always_fitted_and_a_copy_is_told_by_infinity():
    photo = recoloured(size=(4, 5))[1]
    assert psnr_affine(photo, photo) == math.inf
    assert psnr_affine(np.full((1, 1, 3), 0.2), np.full((1, 1, 3), 0.7)) > 100


def test_it_is_never_below_psnr():
    for seed in range(20):
        render, photo = recoloured(seed, (5, 6), noise=0.4)
        assert psnr_affine(render, photo) >= psnr(render, photo)
