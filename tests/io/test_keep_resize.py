"""Keep maps made smaller, by each rule."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ambiguous_wild.builder.resample import downsample_mask
from ambiguous_wild.io.keep_resize import smaller_keep


def drawn(seed: int, height: int, width: int) -> np.ndarray:
    return (np.random.default_rng(seed).random((height, width)) > 0.3).astype(np.float32)


@given(st.integers(0, 99), st.integers(1, 4), st.integers(1, 4))
def test_whole_factors_have_the_least_value_or_the_majority_of_each_block(seed, rows, columns):
    keep, size = drawn(seed, 6 * rows, 5 * columns), (6, 5)
    blocks = keep.reshape(6, rows, 5, columns)
    np.testing.assert_array_equal(smaller_keep(keep, size, "any masked"), blocks.min(axis=(1, 3)))
    share = blocks.mean(axis=(1, 3))
    clear = np.abs(share - 0.5) > 1e-6  # half of a block may round to either side
    np.testing.assert_array_equal(smaller_keep(keep, size, "majority")[clear], (share >= 0.5)[clear])


@pytest.mark.parametrize("rule", ["any masked", "majority"])
def test_tensors_and_arrays_have_the_same_result(rule):
    keep = drawn(0, 37, 53)
    of_tensor = smaller_keep(torch.from_numpy(keep), (11, 17), rule)
    np.testing.assert_array_equal(of_tensor.numpy(), smaller_keep(keep, (11, 17), rule))


def test_no_masked_pixel_is_lost_where_any_masks():
    keep = np.ones((31, 47), np.float32)
    keep[13, 29] = 0.0
    assert smaller_keep(keep, (7, 9), "any masked").min() == 0.0
    assert smaller_keep(keep, (7, 9), "majority").min() == 1.0


def test_the_builder_halves_masks_by_majority():
    keep = drawn(1, 90, 66)
    written = downsample_mask((keep * 255).astype(np.uint8), 22, 30)
    np.testing.assert_array_equal(written, 255 * smaller_keep(keep, (30, 22), "majority").astype(np.uint8))
