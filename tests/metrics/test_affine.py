"""PSNR after an affine colour map, against numpy's least squares on the whole design matrix."""

import math

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.image import psnr, psnr_affine


def pair(seed=0, size=(23, 31), noise=0.05):
    rng = np.random.default_rng(seed)
    photo = rng.random((*size, 3))
    return np.clip(0.7 * photo[..., [1, 0, 2]] + 0.1 + noise * rng.standard_normal(photo.shape), 0, 1), photo


@pytest.mark.parametrize("seed", range(5))
def test_it_equals_least_squares_on_all_pixels(seed):
    render, photo = pair(seed)
    design = np.column_stack([render.reshape(-1, 3), np.ones(render.size // 3)])
    fit = np.linalg.lstsq(design, photo.reshape(-1, 3), rcond=None)[0]
    oracle = peak_signal_noise_ratio(photo.reshape(-1, 3), np.clip(design @ fit, 0, 1), data_range=1.0)
    assert psnr_affine(render, photo) == pytest.approx(oracle, abs=1e-6)
    bytes_ = [np.uint8(255 * picture + 0.5) for picture in (render, photo)]
    assert psnr_affine(*bytes_) == pytest.approx(psnr_affine(*(b / 255 for b in bytes_)), abs=1e-9)


def test_exposure_and_white_balance_do_not_count():
    photo = 0.2 + 0.6 * pair()[1]
    render = 0.1 + 0.5 * photo * [0.8, 1.0, 1.2]
    assert psnr(render, photo) < 20 and psnr_affine(render, photo) > 100
    other = photo.copy()
    other[:12] = 0.5  # but what is elsewhere does
    assert psnr_affine(other, photo) < 25


@pytest.mark.parametrize(
    "render", [np.full((8, 9, 3), 0.3), np.repeat(pair(size=(8, 9))[0][..., :1], 3, axis=2)]
)
def test_flat_and_grey_renders_are_fitted_too(render):
    photo = pair(size=(8, 9))[1]
    assert math.isfinite(psnr_affine(render, photo)) and psnr_affine(render, photo) >= psnr(render, photo)


def test_one_pixel_is_always_fitted_and_a_copy_is_told_by_infinity():
    photo = pair(size=(4, 5))[1]
    assert psnr_affine(photo, photo) == math.inf
    assert psnr_affine(np.full((1, 1, 3), 0.2), np.full((1, 1, 3), 0.7)) > 100


def test_it_is_never_below_psnr():
    for seed in range(20):
        render, photo = pair(seed, (5, 6), noise=0.4)
        assert psnr_affine(render, photo) >= psnr(render, photo)


def test_other_sizes_are_refused():
    with pytest.raises(AwError, match="different size"):
        psnr_affine(np.zeros((4, 4, 3)), np.zeros((4, 5, 3)))
