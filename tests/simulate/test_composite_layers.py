"""Layers of a composite: place, size, light, shadow, and which covers which."""

from __future__ import annotations

import numpy as np
import pytest

from ambiguous_wild.core import Camera
from ambiguous_wild.simulate.cutouts import (
    Cutout,
    CutoutPlacement,
    blend_layer,
    draw_layer,
    layer_mask,
    premultiplied,
    resized,
)


def test_half_of_white_over_black_is_188() -> None:
    """Light adds up, sRGB values do not."""
    over = np.full((2, 2, 4), 0.5, np.float32)
    assert (blend_layer(np.zeros((2, 2, 3), np.uint8), over) == 188).all()
    assert (blend_layer(np.full((2, 2, 3), 77, np.uint8), 0 * over) == 77).all()
    assert layer_mask(over).min() == 255 and layer_mask(0.4 * over).max() == 0


def square(side: int = 40) -> Cutout:
    return Cutout("square", premultiplied(np.ones((side, side, 4), np.float32)))


CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0, np.eye(4))


@pytest.mark.parametrize("depth", [2.0, 4.0, 9.0])
@pytest.mark.parametrize("turn", [0.0, 30.0, 135.0])
def test_a_lying_thing_has_its_place_and_size(depth: float, turn: float) -> None:
    position = (0.1 * depth, -0.05 * depth, depth)
    over = draw_layer([square()], [0.5], [CutoutPlacement(0, position, turn, standing=False)], CAMERA)
    alpha = over[..., 3].astype(float)
    rows, columns = np.mgrid[:240, :320] + 0.5
    assert (alpha * columns).sum() / alpha.sum() == pytest.approx(160 + 30, abs=0.02)
    assert (alpha * rows).sum() / alpha.sum() == pytest.approx(120 - 15, abs=0.02)
    side = 300 * 0.5 / depth  # px, the transparent rim included
    assert alpha.sum() == pytest.approx((side * 40 / 42) ** 2, rel=0.03)


def test_a_standing_thing_has_its_foot_at_its_place() -> None:
    over = draw_layer([square()], [0.6], [CutoutPlacement(0, (0.0, 0.3, 3.0), 0.0, standing=True)], CAMERA)
    rows, columns = np.nonzero(over[..., 3] > 0.5)
    tall = 300 * 0.6 / 3.0
    assert rows.max() + 1 == pytest.approx(120 + 30, abs=2) and np.ptp(rows) + 1 == pytest.approx(
        tall * 40 / 42, abs=1.5
    )
    assert (columns.mean() + 0.5) == pytest.approx(160, abs=0.5)


def test_the_nearer_thing_covers_the_farther_whatever_the_order() -> None:
    red, blue = (
        Cutout(n, square().light * np.float32(c)) for n, c in (("r", [1, 0, 0, 1]), ("b", [0, 0, 1, 1]))
    )
    stands = [CutoutPlacement(0, (0, 0, 2.0), 0, False), CutoutPlacement(1, (0, 0, 4.0), 0, False)]
    for order in (stands, stands[::-1]):
        over = draw_layer([red, blue], [0.3, 3.0], order, CAMERA)
        assert over[120, 160].tolist() == [1, 0, 0, 1] and over[120, 100].tolist() == [0, 0, 1, 1]


def test_a_smaller_layer_keeps_its_light_and_alpha() -> None:
    over = draw_layer([square()], [0.5], [CutoutPlacement(0, (0.1, 0, 3.0), 20, False)], CAMERA)
    small = resized(over, 107, 80)  # not a whole factor
    np.testing.assert_allclose(small.mean((0, 1)), over.mean((0, 1)), rtol=1e-4)


@pytest.mark.parametrize("standing", [True, False])
def test_a_shadow_only_darkens_and_is_part_of_the_truth(standing: bool) -> None:
    stand = [CutoutPlacement(0, (0.0, 0.2, 3.0), 0.0, standing)]
    bare, dark = (draw_layer([square()], [0.6], stand, CAMERA, shadow=s) for s in (0.0, 0.7))
    photo = np.full((240, 320, 3), 200, np.uint8)
    outside = bare[..., 3] == 0
    assert (blend_layer(photo, dark)[outside] <= 200).all() and (
        blend_layer(photo, dark)[outside] < 150
    ).sum() > 30
    assert ((layer_mask(dark) > 0) >= (layer_mask(bare) > 0)).all() and layer_mask(dark).sum() > layer_mask(
        bare
    ).sum()
