"""What must hold for FLIP whatever the pictures; its values are held to the authors' in test_oracles.py."""

from __future__ import annotations

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.image import flip, flip_map


def picture(seed: int = 0, size: tuple[int, int] = (20, 24)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)


def test_identity_symmetry_range_and_kinds_of_numbers() -> None:
    a, b = picture(0), picture(1)
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


def test_unusable_input_is_named() -> None:
    with pytest.raises(AwError, match="different size"):
        flip(picture(), picture(size=(20, 25)))
