"""DroneSplat's local masks against loops and hand computation."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from ambiguous_wild.methods.dronesplat import (
    DroneSplatConfig,
    DroneSplatMask,
    combined_residual,
    heat_map,
    threshold,
)
from ambiguous_wild.splat.step import TrainData
from tests.methods.baselines import data_of, step_of


def test_instances_take_the_mean_of_their_pixels():
    rng = np.random.default_rng(0)
    residual, labels = rng.random((20, 30)), rng.integers(0, 6, (20, 30))
    labels[labels == 4] = 5  # a number that no pixel has
    got = heat_map(torch.from_numpy(residual), torch.from_numpy(labels)).numpy()
    want = np.zeros((20, 30))
    for k in (1, 2, 3, 5):
        total, count = 0.0, 0
        for y in range(20):
            for x in range(30):
                if labels[y, x] == k:
                    total, count = total + residual[y, x], count + 1
        want[labels == k] = total / count
    want = (want - want.min()) / (want.max() - want.min())
    assert np.allclose(got, want)


def test_the_threshold_by_hand():
    heat = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)  # mean 1/4, deviation sqrt(3)/4
    sd = 3**0.5 / 4
    assert threshold(heat, 0.0, 0.4) == pytest.approx(0.25 + 1.4 * sd)
    assert threshold(heat, 15_000.0, 0.4) == pytest.approx(0.25 + 1.2 * sd)
    assert threshold(heat, 30_000.0, 0.4) == pytest.approx(0.25 + sd)
    assert threshold(heat, 40_000.0, 0.4) == pytest.approx(0.25 + sd)


def test_the_residual_mixes_four_to_one():
    rng = np.random.default_rng(1)
    photo, render = rng.random((2, 24, 32, 3)).astype(np.float32)
    got = combined_residual(torch.from_numpy(render), torch.from_numpy(photo), 4.0).numpy()
    a = np.abs(render - photo).mean(2)
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, ssim = structural_similarity(photo, render, channel_axis=2, full=True, truncate=3.5, **settings)
    s = 1.0 - ssim.mean(2)
    inner = (slice(6, -6), slice(6, -6))  # borders are padded differently

    def over(x, like):
        return (x - like.min()) / (like.max() - like.min())

    from ambiguous_wild.splat.losses import ssim_map

    ours = 1.0 - ssim_map(torch.from_numpy(render), torch.from_numpy(photo)).mean(2).numpy()
    assert np.allclose(ours[inner], s[inner], atol=1e-4)
    assert np.allclose(got[inner], ((4 * over(a, a) + over(s, ours)) / 5)[inner], atol=1e-4)


class Halves:
    """Left and right half of the photo, a square of its own, and a margin without a label."""

    name = "halves"

    def labels(self, photo):
        labels = np.ones(photo.shape[:2], np.int32)
        labels[:, 32:] = 2
        labels[14:26, 14:26] = 3
        labels[:4] = 0
        return labels


def policy_on(scene, tmp_path) -> tuple[DroneSplatMask, TrainData]:
    policy, data = DroneSplatMask(DroneSplatConfig()), data_of(scene, tmp_path / "cache")
    policy.instances = Halves()
    policy.setup(data)
    return policy, data


def test_the_object_goes_whole_and_unlabelled_pixels_stay(scene, tmp_path):
    policy, data = policy_on(scene, tmp_path)
    photo = data.photos[0]
    wrong = photo.clone()
    wrong[18:22, 18:22] += 0.5  # only a part of the square disagrees
    wrong[:4] += 0.5  # and the margin does as much
    keep = policy.keep(step_of(data, 0, wrong)).numpy()
    want = np.ones((48, 64))
    want[14:26, 14:26] = 0
    assert np.array_equal(keep, want)
    panels = list(policy.panels(step_of(data, 0, wrong)).values())
    assert [p.shape for p in panels] == [(48, 64, 3)] * 2
    hot = panels[0].astype(int)
    assert (hot[14:26, 14:26, 0] > hot[14:26, 14:26, 1]).all() and (hot[0, 0, 0] < hot[0, 0, 1]).all()
    assert policy.facts()["masked_share"] == pytest.approx(144 / (48 * 64))
    assert policy.keep(step_of(data, 0, wrong[::2, ::2].contiguous())).shape == (24, 32)


def test_a_photo_in_which_nothing_stands_out_is_kept(scene, tmp_path):
    policy, data = policy_on(scene, tmp_path)
    assert bool(policy.keep(step_of(data, 0, data.photos[0])).all())


def test_masks_begin_when_the_render_means_something(scene, tmp_path):
    policy, data = policy_on(scene, tmp_path)
    for kw in ({"nominal": 499.0}, {"iteration": 299}):
        assert policy.keep(step_of(data, 0, data.photos[1], **kw)) is None
