import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ambiguous_wild.builder.downsample import (
    _TO_LINEAR,
    _TO_SRGB,
    auto_factor,
    downsample_mask,
    downsample_photo,
    downsampled_size,
)


def test_tables_invert_each_other():
    values = np.arange(256)
    assert np.array_equal(_TO_SRGB[np.round(_TO_LINEAR * 65535).astype(int)], values)


def test_a_fine_grid_becomes_the_mean_of_light_not_of_codes():
    """Half black, half white is half the light: sRGB 188, and not 128."""
    grid = (np.indices((64, 64)).sum(0) % 2 * 255).astype(np.uint8)
    small = downsample_photo(np.repeat(grid[..., None], 3, 2), 8, 8)
    expected = 255 * (1.055 * 0.5 ** (1 / 2.4) - 0.055)
    assert np.abs(small[2:-2, 2:-2] - expected).max() <= 2


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 255), st.integers(9, 40), st.integers(9, 40))
def test_a_flat_photo_stays_flat(value, width, height):
    flat = np.full((height, width, 3), value, np.uint8)
    small = downsample_photo(flat, max(1, width // 3), max(1, height // 3))
    assert np.abs(small.astype(int) - value).max() <= 1


def test_edges_of_both_images_coincide():
    """A blob at x of the photo lies at x * w / W of the copy: what the intrinsics assume."""
    image = np.zeros((240, 320, 3), np.uint8)
    cv2.circle(image, (100, 60), 12, (255, 255, 255), -1)  # centre of pixel 100 = 100.5
    small = downsample_photo(image, 107, 80)
    weight = _TO_LINEAR[small[..., 0]].astype(float)
    x = (weight.sum(0) * (np.arange(107) + 0.5)).sum() / weight.sum()
    y = (weight.sum(1) * (np.arange(80) + 0.5)).sum() / weight.sum()
    assert (x, y) == pytest.approx((100.5 * 107 / 320, 60.5 * 80 / 240), abs=0.02)


def test_no_aliasing_of_what_the_copy_cannot_show():
    """A stripe pattern above the copy's Nyquist limit turns to grey, not to false stripes."""
    x = np.arange(512)
    stripes = 127.5 + 127 * np.sin(2 * np.pi * x / 3.1)
    photo = np.repeat(np.tile(stripes.astype(np.uint8), (64, 1))[..., None], 3, 2)
    small = downsample_photo(photo, 128, 16)[4:-4, 8:-8, 0]
    assert small.std() < 8
    naive = photo[::4, ::4, 0]
    assert naive.std() > 60


def test_masks_go_by_area():
    mask = np.zeros((40, 40), np.uint8)
    mask[:, :18] = 255  # columns 0-3 white, column 4 half white
    assert np.array_equal(downsample_mask(mask, 10, 10)[0], [255] * 5 + [0] * 5)
    assert set(np.unique(downsample_mask(mask, 7, 9))) == {0, 255}


def catmull_rom(source: int, target: int) -> np.ndarray:
    """[target, source] weights of the textbook cubic (a = -1/2), stretched by the scale; rows sum to 1."""
    scale = source / target
    x = np.abs((np.arange(source) + 0.5 - (np.arange(target)[:, None] + 0.5) * scale) / scale)
    near, far = 1.5 * x**3 - 2.5 * x**2 + 1, -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
    weights = np.where(x < 1, near, np.where(x < 2, far, 0.0))
    return weights / weights.sum(axis=1, keepdims=True)


@pytest.mark.parametrize(("width", "height"), [(53, 41), (160, 120), (40, 30)])
def test_it_is_the_antialiased_cubic_in_linear_light(width, height):
    """The textbook filter as matrices is the oracle; borders, which each treats otherwise, are left out."""
    rng = np.random.default_rng(0)
    photo = cv2.GaussianBlur(rng.integers(0, 256, (240, 320, 3), dtype=np.uint8), (0, 0), 1.0)
    light = _TO_LINEAR[photo].astype(np.float64)
    expected = 255 * np.einsum(
        "hr,rcx,wc->hwx", catmull_rom(240, height), light, catmull_rom(320, width), optimize=True
    )
    found = 255 * _TO_LINEAR[downsample_photo(photo, width, height)]
    assert np.abs(found - expected)[4:-4, 4:-4].max() < 1.5  # of 255, the rounding to 8-bit sRGB


def test_sizes_and_factors():
    assert downsampled_size(4032, 3024, 8) == (504, 378)
    assert downsampled_size(3, 3, 8) == (1, 1)
    assert [auto_factor([(w, 9)]) for w in (300, 480, 959, 960, 1920, 4032, 12000)] == [1, 1, 1, 2, 4, 8, 8]
