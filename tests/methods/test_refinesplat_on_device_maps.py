"""Filters, ranks and what other views show, on an accelerator: every function against the host's."""

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.methods.refinesplat import agreement, multiview, structure
from ambiguous_wild.methods.refinesplat.on_device import agreement as device_agreement
from ambiguous_wild.methods.refinesplat.on_device import (
    filters,
    ranks,
)
from ambiguous_wild.methods.refinesplat.on_device import multiview as device_multiview
from ambiguous_wild.methods.refinesplat.threshold import robust_floor
from tests.methods.on_device import (
    noise,
    tensor,
)
from tests.methods.test_refinesplat_pixels import camera as side_camera


@pytest.mark.parametrize("shape", [(40, 51), (9, 3), (1, 7)])
@pytest.mark.parametrize("size", [3, 7])
def test_boxes_are_opencvs(shape, size):
    x = noise(0, *shape)
    expected = cv2.blur(x, (size, size), borderType=cv2.BORDER_REPLICATE)
    # sums of `size` float32 in [0, 1], twice: at most 2 * size roundings of 2^-24
    assert np.allclose(filters.box(tensor(x)[None], size)[0], expected, atol=2 * size * 2**-24)


@pytest.mark.parametrize("shape", [(40, 50), (41, 51), (7, 3)])  # halves are whole, or not
def test_blurred_halves_and_sizes_are_opencvs(shape):
    x = noise(1, *shape)
    h, w = shape[0] // 2, shape[1] // 2
    wide = cv2.blur(x, (9, 9), borderType=cv2.BORDER_REPLICATE)
    expected = cv2.resize(wide, (w, h), interpolation=cv2.INTER_AREA)
    rows, columns = (filters.blur_and_shrink(n, n // 2, 9) for n in shape)
    assert np.allclose(rows @ x @ columns.T, expected, atol=2e-6)  # some 30 products of float32 a sum
    small = cv2.resize(x, (w, h), interpolation=cv2.INTER_NEAREST)
    assert np.array_equal(filters.nearest(tensor(x), (h, w)), small)
    large = cv2.resize(small, shape[::-1], interpolation=cv2.INTER_LINEAR)
    # places to 2^-24 of the width, times differences of up to 1 from pixel to pixel
    assert np.allclose(filters.resized(tensor(small), shape), large, atol=shape[1] * 2**-22)


def pictures(kind: str) -> tuple[np.ndarray, np.ndarray]:
    a, b = noise(2, 40, 51, 3), noise(3, 40, 51, 3)
    return {
        "noise": (a, b),
        "same": (a, a.copy()),
        "plain": (np.full_like(a, 0.97), np.full_like(a, 0.95)),
        "almost plain": (0.9 + 0.01 * a, 0.9 + 0.01 * b),
        "black": (np.zeros_like(a), b),
    }[kind]


@pytest.mark.parametrize("kind", ["noise", "same", "plain", "almost plain", "black"])
def test_the_structure_residual_is_the_hosts(kind):
    a, b = pictures(kind)
    grey = filters.grey_weights("cpu")
    found = filters.structure_residual(tensor(a), tensor(b), grey, 0.3).numpy()
    # variances are off by some roundings of 1, 2^-23, and are divided by 5e-4 at least: 2.4e-4 each
    assert np.allclose(found, structure.structure_residual(a, b, 0.3), atol=5e-4 * np.abs(a - b).max() + 1e-7)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8])
def test_medians_and_quantiles_are_numpys(count):
    x = noise(count, 8).astype(np.float64)
    x[count:] = np.nan
    expected = np.median(x[:count]) if count else np.nan
    assert np.allclose(ranks.median(tensor(x)), expected, equal_nan=True, rtol=1e-15)
    there = np.zeros((6, 9), bool)
    there.ravel()[np.random.default_rng(count).permutation(54)[:count]] = True
    image = noise(9, 6, 9)
    found, number = ranks.low_quantile(tensor(image), tensor(~there), 0.25)
    assert int(number) == count
    assert float(found) == pytest.approx(float(np.quantile(image[there], 0.25)) if count else 0.0, rel=1e-6)
    if count:
        middle, spread = ranks.spread_of(tensor(x))
        assert float(middle + 3 * spread) == pytest.approx(robust_floor(x[:count], 3.0), rel=1e-12)


@pytest.mark.parametrize("quantile", [0.0, 0.3, 0.5, 1.0])
def test_quantiles_over_views_are_the_hosts(quantile):
    stack = noise(4, 7, 5, 6)
    stack[noise(5, 7, 5, 6) < 0.5] = np.nan
    stack[:, 0, 0] = np.nan
    there = tensor((~np.isnan(stack)).sum(axis=0))
    found = device_agreement.Ranks(7, quantile, "cpu").quantile_of(tensor(stack), there)
    assert np.allclose(found, agreement.quantile_of(stack, quantile), atol=1e-6, equal_nan=True)


@pytest.mark.parametrize("shift", [0, 40, 90])
@pytest.mark.parametrize("share", [0.0, 0.2, 0.8])  # of the pixels that show the same surface
def test_colours_agree_as_on_the_host(shift, share):
    ours = (noise(6, 22, 27, 3) * 150).astype(np.uint8)
    theirs = np.stack([ours + np.uint8(shift), 255 - ours, (noise(7, 22, 27, 3) * 255).astype(np.uint8)])
    theirs[0, :4] = 200
    same = noise(8, 3, 22, 27) < share
    difference = tensor(ours).float() - tensor(theirs).float()
    maps = difference.permute(0, 3, 1, 2)
    found = device_agreement.common_offset(maps[:, :, ::2, ::2], tensor(same)[:, ::2, ::2], 0.06)
    agreeing = device_agreement.agree(maps[:, :, None], tensor(same)[:, None], 0.06, found)[:, 0]
    for view in range(3):
        apart = agreement.colour_difference(ours, theirs[view])
        expected = agreement.common_offset(apart, same[view], 0.06)
        assert np.allclose(found[view], 255 * expected, atol=1e-4)
        # 0.06 is no third of a multiple of 1 / 255: nothing lies on the bound
        assert np.array_equal(agreeing[view], agreement.agree(apart, same[view], 0.06, expected))
    assert bool(found.any()) == (shift > 0 and share > 0)


def test_words_weigh_what_they_do_on_the_host():
    seen, agreed = noise(1, 8, 9, 11) < 0.4, noise(2, 8, 9, 11) < 0.3
    agreed &= seen
    few = seen.sum(axis=0) < 3
    found = device_agreement.agreement_weight(tensor(seen).sum(0), tensor(agreed).sum(0), 0.35, tensor(few))
    assert np.allclose(found, agreement.agreement_weight(seen, agreed, 0.35, few), atol=1e-6)


def test_discounts_are_the_hosts():
    config = multiview.MultiViewConfig()
    heard = noise(3, 20, 25) * 10
    heard[noise(4, 20, 25) < 0.3] = np.nan
    weight, own = noise(5, 20, 25), noise(6, 41, 51)
    unit = torch.tensor(0.7, dtype=torch.float64)
    found = device_multiview.discount(
        tensor(own), device_multiview.MultiViewEvidence(tensor(heard), tensor(weight)), unit, config
    )
    expected = multiview.discount(own, multiview.MultiViewEvidence(heard, weight), 0.7, config)
    assert np.allclose(found, expected, atol=1e-5)
    assert device_multiview.discount(tensor(own), None, unit, config).numpy() is not None


@pytest.mark.parametrize("setting", [{}, {"agree": 0.0}, {"sparse": False}, {"quantile": 0.3, "known_by": 5}])
@pytest.mark.parametrize("sizes", ["one", "many"])
def test_other_views_say_what_they_say_on_the_host(setting, sizes):
    """Six views of a wall, one of them with nothing to say yet; half of the depths are wrong."""
    rng = np.random.default_rng(0)
    h, w, plane = 40, 64, 5.0
    cameras, photos, surfaces = [], [], []
    for view in range(6):
        cam = side_camera(0.15 * view)
        if sizes == "many" and view % 2:
            cam = cam.resized(w - 9, h - 6)
        cameras.append(cam)
        photos.append(noise(view // 3, cam.height, cam.width, 3))
        known = np.full((cam.height // 3, cam.width // 3), 1 / plane, np.float32)
        known[:4] = np.nan
        surfaces.append(None if view == 5 else known)
    config = multiview.MultiViewConfig(**setting)
    host = multiview.OtherViews(cameras, photos, config, surfaces)
    device = device_multiview.OtherViews(cameras, photos, config, surfaces, "cpu")
    for view in [0, 1, 2, 3, 5]:
        shape = photos[view].shape[:2]
        said = rng.random(shape).astype(np.float32)
        depth = np.where(rng.random(shape) < 0.5, plane, 2.5 * plane).astype(np.float32)
        depth[:, :3] = 0.0
        host.remember(view, said, depth)
        halved = device.halved(view, tensor(depth))
        device.remember(view, tensor(said), halved)
        assert np.allclose(device.stored.of(view)[0], host.evidence[view], atol=2e-6)
        assert np.array_equal(halved, host.depth[view])
        expected = host.ask(view)
        found = device.ask(view, halved)
        if expected is None:
            assert np.isnan(found.evidence.numpy()).all()
            continue
        # a place half way between two pixels of random depth may fall to the other
        off = np.isfinite(found.evidence.numpy()) != np.isfinite(expected.evidence)
        close = np.isclose(found.evidence, expected.evidence, atol=1e-4, equal_nan=True)
        assert off.mean() < 0.005 and close.mean() > 0.99
        assert np.isclose(found.weight, expected.weight, atol=1e-5).mean() > 0.99
    assert np.isfinite(expected.evidence).mean() > 0.3  # or there was nothing to compare
