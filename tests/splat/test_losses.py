"""The fused loss against autograd, against scikit-image, and at its edges."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.losses import photometric, ssim_map
from ambiguous_wild.splat.reference import photometric_reference


def pictures(height, width, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(size=(height, width, 3)).astype(np.float32)
    b = (a + 0.2 * rng.normal(size=a.shape)).clip(0, 1).astype(np.float32)
    keep = rng.uniform(size=(height, width)).astype(np.float32)
    return torch.from_numpy(a), torch.from_numpy(b), torch.from_numpy(keep)


@pytest.mark.parametrize("weighting", ["map", "images"])
@pytest.mark.parametrize("size", [(1, 1), (3, 2), (17, 23), (40, 21)])
@pytest.mark.parametrize("masked", [False, True])
def test_value_and_gradient_equal_autograd_in_float64(weighting, size, masked):
    a, b, keep = pictures(*size)
    keep = keep if masked else None
    loss = photometric(a, b, keep, lambda_dssim=0.3, weighting=weighting)
    used = None if keep is None else keep.double()
    l1, dssim, gradient = photometric_reference(a.double(), b.double(), used, 0.3, weighting)
    assert loss.l1 == pytest.approx(l1, rel=1e-6)
    assert loss.dssim == pytest.approx(dssim, rel=1e-5, abs=1e-6)
    assert loss.value == pytest.approx(0.7 * l1 + 0.3 * dssim, rel=1e-5, abs=1e-6)
    assert (loss.d_image - gradient).abs().max() < 2e-6 * gradient.abs().max()


def test_the_map_is_the_one_of_scikit_image_away_from_the_border():
    a, b, _ = pictures(30, 34)
    _, expected = structural_similarity(
        a.numpy().astype(np.float64), b.numpy().astype(np.float64), channel_axis=2, data_range=1.0,
        gaussian_weights=True, sigma=1.5, truncate=3.5, use_sample_covariance=False, full=True,
    )  # fmt: skip
    inner = np.s_[5:-5, 5:-5]
    np.testing.assert_allclose(ssim_map(a, b).numpy()[inner], expected[inner], atol=5e-6)


def test_a_photo_that_is_all_masked_teaches_nothing():
    a, b, keep = pictures(9, 11)
    for weighting in ("map", "images"):
        loss = photometric(a, b, torch.zeros_like(keep), weighting=weighting)
        assert loss.value == pytest.approx(0.0, abs=1e-6)
        assert not loss.d_image.any()


def test_equal_pictures_have_loss_zero_and_no_pull():
    a, _, keep = pictures(20, 20)
    for picture in (a, torch.zeros_like(a), torch.ones_like(a)):
        loss = photometric(picture, picture.clone(), keep)
        assert loss.value == pytest.approx(0.0, abs=1e-6)
        assert loss.d_image.abs().max() < 1e-6


def test_a_masked_pixel_does_not_move_the_l1_of_others():
    a, b, _ = pictures(16, 16)
    keep = torch.ones(16, 16)
    keep[4:8, 4:8] = 0
    changed = b.clone()
    changed[4:8, 4:8] = 1 - changed[4:8, 4:8]
    one = photometric(a, b, keep, lambda_dssim=0.0)
    two = photometric(a, changed, keep, lambda_dssim=0.0)
    assert one.value == two.value
    assert torch.equal(one.d_image, two.d_image)
    assert not one.d_image[4:8, 4:8].any()
    # "images" hides the content from SSIM's windows as well; "map" only hides the windows' centres
    hidden = [photometric(a, p, keep, lambda_dssim=1.0, weighting="images").value for p in (b, changed)]
    seen = [photometric(a, p, keep, lambda_dssim=1.0, weighting="map").value for p in (b, changed)]
    assert hidden[0] == hidden[1]
    assert seen[0] != seen[1]


def test_bool_keep_maps_count_as_zero_and_one():
    a, b, keep = pictures(10, 10)
    assert photometric(a, b, keep > 0.5).value == photometric(a, b, (keep > 0.5).float()).value


def test_wrong_input_is_named():
    a, b, keep = pictures(5, 6)
    with pytest.raises(AwError, match="render and photo"):
        photometric(a, b[:4])
    with pytest.raises(AwError, match="keep must be"):
        photometric(a, b, keep.T)
    with pytest.raises(AwError, match="did you mean 'images'"):
        photometric(a, b, keep, weighting="image")
