"""Every metric against somebody else's code, on random and on hard pairs."""

from __future__ import annotations

import flip_evaluator
import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import (
    peak_signal_noise_ratio as torchmetrics_psnr,
)
from torchmetrics.functional.image import (
    structural_similarity_index_measure as torchmetrics_ssim,
)

from ambiguous_wild.metrics.image import flip, flip_map, psnr, ssim, ssim_inria
from ambiguous_wild.metrics.mask_scores import psnr_valid
from tests.metrics.pairs import Pair, pairs

ANY_SIZE, WINDOWED = pairs(1), pairs(11)
each_of_any_size = pytest.mark.parametrize("pair", ANY_SIZE.values(), ids=ANY_SIZE)
each_windowed = pytest.mark.parametrize("pair", WINDOWED.values(), ids=WINDOWED)


def as_tensor(image: np.ndarray) -> torch.Tensor:
    """[1, 3, H, W] float64 in [0, 1]."""
    return torch.from_numpy(image / 255.0).permute(2, 0, 1)[None]


@each_of_any_size
def test_psnr_equals_scikit_image_and_torchmetrics(pair: Pair) -> None:
    a, b = pair
    with np.errstate(divide="ignore"):
        assert psnr(a, b) == pytest.approx(peak_signal_noise_ratio(a, b, data_range=255), abs=1e-6)
    other = torchmetrics_psnr(as_tensor(a), as_tensor(b), data_range=1.0)
    assert psnr(a, b) == pytest.approx(float(other), abs=1e-4)  # theirs sums in float32


@each_of_any_size
def test_psnr_valid_equals_scikit_image_on_the_kept_pixels_alone(pair: Pair) -> None:
    a, b = pair
    keep = np.random.default_rng(7).random(a.shape[:2]) < 0.4
    keep[0, 0] = True
    with np.errstate(divide="ignore"):
        expected = peak_signal_noise_ratio(a[keep], b[keep], data_range=255)
    assert psnr_valid(a, b, keep) == pytest.approx(expected, abs=1e-6)


@each_windowed
def test_ssim_equals_scikit_image_and_torchmetrics(pair: Pair) -> None:
    a, b = pair
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    expected = structural_similarity(a / 255.0, b / 255.0, data_range=1.0, channel_axis=2, **settings)
    assert ssim(a, b) == pytest.approx(expected, abs=1e-9)  # both are float64
    # 1.9 averages over a border of reflected pixels too: its map is cut to the windows inside the picture
    _, full = torchmetrics_ssim(as_tensor(a), as_tensor(b), data_range=1.0, sigma=1.5, return_full_image=True)
    assert ssim(a, b) == pytest.approx(float(full[..., 5:-5, 5:-5].mean()), abs=1e-4)


@each_of_any_size
def test_ssim_inria_equals_a_convolution_with_zero_padding(pair: Pair) -> None:
    a, b = (as_tensor(image) for image in pair)
    line = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    plane = torch.outer(line, line) / line.sum() ** 2

    def blur(x: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.conv2d(x, plane.expand(3, 1, 11, 11), padding=5, groups=3)

    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma**2, blur(b * b) - mb**2, blur(a * b) - ma * mb
    top, bottom = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4), (ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)
    assert ssim_inria(*pair) == pytest.approx(float((top / bottom).mean()), abs=1e-9)


@each_of_any_size
def test_flip_equals_the_authors_package(pair: Pair) -> None:
    a, b = ((image / 255.0).astype(np.float32) for image in pair)
    theirs, mean, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=False)
    assert flip(*pair) == pytest.approx(mean, abs=1e-4)
    assert np.abs(flip_map(*pair) - theirs[..., 0]).max() < 1e-3  # theirs is float32
