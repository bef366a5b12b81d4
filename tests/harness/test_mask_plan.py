"""Whether distractors call for masks: what probes leave out, what they measure, what is decided from them."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
import torch

from ambiguous_wild.harness.effects_plan import Evidence, decide
from ambiguous_wild.harness.mask_plan import (
    CERTAIN,
    HELD_OUT_SHARE,
    MASK_LINES,
    MIN_DB,
    MIN_PHOTOS,
    MaskComparison,
    MaskingGain,
    Occlusion,
    held_out_blocks,
    masking_gain,
    sample_photos,
    with_gain,
    with_occlusion,
    without_blocks,
)
from ambiguous_wild.io.scene_folder import load_scene
from tests.harness.test_planning import synthetic
from tests.tiny_scene import TRAIN, write_tiny_scene

PLAN = decide("dots", Evidence(0.0, 0.0, 1.0, 0.0, observations=1000))


def psnr(*values):
    return {f"{k}.png": value for k, value in enumerate(values)}


def test_a_gain_is_the_mean_over_photos_and_its_standard_error():
    gain = masking_gain(psnr(21.0, 22.0, 23.0, 24.0), psnr(20.0, 22.0, 22.0, 22.0))  # differences 1, 0, 1, 2
    assert gain.db == pytest.approx(1.0)
    assert gain.error_db == pytest.approx(math.sqrt(2 / 3) / 2)
    assert masking_gain(psnr(*[20.0] * (MIN_PHOTOS - 1)), psnr(*[20.0] * 9)) is None


def test_masks_are_off_where_leaving_the_patches_out_does_not_pay():
    plan = with_occlusion(PLAN, Occlusion(0.02, 0.02, 0.1))
    for gain, answer in (
        (MaskingGain(0.2, 0.05), "on"),
        (MaskingGain(0.01, 0.005), "off"),
        (MaskingGain(0.1, 0.2), "off"),
    ):
        found = {d.effect: d for d in with_gain(plan, gain).decisions}
        assert {found[name].decision for name in MASK_LINES} == {answer}
        assert found["masks"].gain_db == gain.db
    assert with_gain(plan, None) == plan
    much = with_occlusion(PLAN, Occlusion(2 * CERTAIN, 0.02, 0.1))
    found = with_gain(much, MaskingGain(-0.1, 0.05)).decisions[0]
    assert found.decision == "on" and found.gain_db == -0.1


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(write_tiny_scene(tmp_path_factory.mktemp("data") / "scene", distractors=False))


def test_blocks_are_a_share_of_every_photo_and_not_under_its_mask(scene, tmp_path):
    bench = MaskComparison(scene, tmp_path)
    for block in bench.blocks:
        assert block.double().mean().item() == pytest.approx(HELD_OUT_SHARE, abs=0.06)
    again, other = held_out_blocks(bench.data, 0), held_out_blocks(bench.data, 1)
    assert all(torch.equal(a, b) for a, b in zip(bench.blocks, again))
    assert not all(torch.equal(a, b) for a, b in zip(bench.blocks, other))
    keep = torch.ones(bench.blocks[0].shape)
    keep[:, :32] = 0
    masked = dataclasses.replace(bench.data, user_keep=[keep] * 6)
    assert not any(block[:, :32].any() for block in held_out_blocks(masked, 0))


def test_nothing_of_the_blocks_is_learnt(scene, tmp_path, monkeypatch):
    kept = []

    def gaussians(change):
        bench = MaskComparison(scene, tmp_path)
        if change:
            for photo, block in zip(bench.data.photos, bench.blocks):
                photo[block] = 1 - photo[block]
        monkeypatch.setattr(
            "ambiguous_wild.harness.mask_plan.Trainer",
            lambda *args, **more: kept.append(trainer(*args, **more)) or kept[-1],
        )
        bench.train((), [block & False for block in bench.blocks], False, lambda: None, 20)
        return kept[-1].gaussians

    from ambiguous_wild.splat.trainer import Trainer as trainer

    for (name, a), (_, b) in zip(gaussians(False).items(), gaussians(True).items()):
        assert torch.equal(a, b), name


def test_points_say_nothing_of_held_back_pixels():
    found, photos = synthetic()
    blocks = [torch.zeros(photo.shape[:2], dtype=torch.bool) for photo in photos]
    for block in blocks:
        block[:, :80] = True
    points = without_blocks(found, blocks)
    hidden = points.track_views == -1
    assert np.array_equal(hidden, found.points.track_xy[:, 0] < 80)
    assert np.array_equal(points.track_views[~hidden], found.points.track_views[~hidden])


def test_a_long_capture_is_sampled_evenly():
    found = synthetic()[0]
    many = dataclasses.replace(found, views=found.views * 10)
    few, places = sample_photos(many)
    assert len(few.train) == len(places) == 60 and places[0] == 0 and places[-1] == 119
    assert set(np.diff(places)) <= {2, 3}
    assert sample_photos(found) == (found, list(range(12)))


def test_leaving_distractors_out_helps_and_leaving_the_scene_out_harms(scene, tmp_path):
    root = write_tiny_scene(tmp_path / "scene")
    truth = [cv2.imread(str(root / "truth" / "distractor" / name), 0) > 0 for name in TRAIN]
    patches = [torch.from_numpy(patch) for patch in truth]

    def gain(found):
        bench = MaskComparison(found, tmp_path)
        arms = [bench.train((), patches, masked, lambda: None, 120) for masked in (True, False)]
        return masking_gain(*arms)

    static, spoilt = gain(scene), gain(load_scene(root))
    assert static.db < MIN_DB and static.db < 0 < spoilt.db
