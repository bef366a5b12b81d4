"""Reference rows read the exact truth, and say so where there is none."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from click.testing import CliRunner
from scipy import ndimage

from ambiguous_wild.cli.bench import command as bench
from ambiguous_wild.core import AwError
from ambiguous_wild.methods.truth import TruthConfig, TruthMask, clean_data, keep_outside
from ambiguous_wild.splat.method_hooks import MethodHooks
from tests.methods.baselines import data_of, parts_of, step_of, trained
from tests.splat.scenes import bits
from tests.tiny_scene import TRAIN, write_tiny_scene


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The tiny scene with distractors and, in truth/clean, its photos without; and that scene itself."""
    folder = tmp_path_factory.mktemp("data")
    dirty, clean = write_tiny_scene(folder / "scene"), write_tiny_scene(folder / "clean", distractors=False)
    (dirty / "truth" / "clean").mkdir()
    for name in TRAIN:
        shutil.copy(clean / "images" / name, dirty / "truth" / "clean" / name)
    return dirty, clean


def test_the_keep_maps_are_the_truth(scenes, tmp_path):
    data = data_of(scenes[0], tmp_path / "cache")
    policy = TruthMask(TruthConfig())
    policy.setup(data)
    shares = []
    for view, name in enumerate(TRAIN):
        truth = cv2.imread(str(scenes[0] / "truth" / "distractor" / name), cv2.IMREAD_GRAYSCALE) > 0
        keep = policy.keep(step_of(data, view, data.photos[view], iteration=1, nominal=0.0))
        assert np.array_equal(keep.numpy() == 0, truth)
        shares.append(truth.mean())
    assert policy.facts()["masked_share"] == pytest.approx(np.mean(shares))


def test_shadows_of_distractors_are_masked_too(scenes, tmp_path):
    scene = shutil.copytree(scenes[0], tmp_path / "scene")
    (scene / "truth" / "shadow").mkdir()
    for at, name in enumerate(TRAIN):
        shadow = np.zeros((48, 64), np.uint8)
        shadow[24:30, 4 * at : 4 * at + 20] = 255  # in part on the distractor
        cv2.imwrite(str(scene / "truth" / "shadow" / name), shadow)
    data = data_of(scene, tmp_path / "cache")
    policy = parts_of("3dgs@mask=truth").mask
    policy.setup(data)
    for view, name in enumerate(TRAIN):
        both = [cv2.imread(str(scene / "truth" / part / name), 0) > 0 for part in ("distractor", "shadow")]
        assert (both[0] & both[1]).any() and (both[1] & ~both[0]).any()
        keep = policy.keep(step_of(data, view, data.photos[view], iteration=1, nominal=0.0))
        assert np.array_equal(keep.numpy() == 0, both[0] | both[1])
    (scene / "truth" / "shadow" / TRAIN[1]).unlink()
    with pytest.raises(AwError, match=f"1 of 6 .*shadow: {TRAIN[1]}"):
        policy.setup(data)


@pytest.mark.parametrize("dilation", [0, 1, 4])
def test_dilation_grows_every_side(dilation):
    mask = np.zeros((20, 30), bool)
    mask[3:6, 10:12] = mask[18, 29] = True
    want = ndimage.binary_dilation(mask, np.ones((3, 3)), iterations=dilation) if dilation else mask
    assert np.array_equal(keep_outside(mask, dilation).numpy() == 0, want)


def test_clean_photos_give_what_the_clean_scene_gives(scenes, tmp_path):
    dirty, clean = scenes
    reference = trained(dirty, tmp_path / "a" / "run", parts_of("3dgs-clean"), 60)
    assert bits(reference) == bits(trained(clean, tmp_path / "b" / "run", MethodHooks(), 60))
    assert bits(reference) != bits(trained(dirty, tmp_path / "c" / "run", MethodHooks(), 60))


def test_a_users_masks_are_not_laid_over_clean_photos(scenes, tmp_path):
    data = data_of(scenes[0], tmp_path / "cache")
    data = replace(data, user_keep=[torch.zeros(48, 64)] * len(TRAIN))
    assert clean_data(data).user_keep == [None] * len(TRAIN)


@pytest.mark.parametrize(("method", "kind"), [("3dgs+truth", "distractor"), ("3dgs-clean", "clean")])
def test_a_scene_without_truth_is_one_line_and_exit_code_2(scenes, tmp_path, method, kind):
    bare = shutil.copytree(scenes[0], tmp_path / "bare")
    shutil.rmtree(bare / "truth" / kind)
    arguments = ["--method", method, "--scene", bare, "-o", tmp_path / "runs", "--iterations", "5"]
    result = CliRunner().invoke(bench, [str(a) for a in arguments])
    assert isinstance(result.exception, AwError)
    assert result.exception.exit_code == 2
    assert "has no exact truth" in str(result.exception)
    assert "\n" not in str(result.exception)


def test_what_is_missing_or_of_another_size_is_named(scenes, tmp_path):
    scene = shutil.copytree(scenes[0], tmp_path / "scene")
    cv2.imwrite(str(scene / "truth" / "distractor" / TRAIN[2]), np.zeros((24, 32), np.uint8))
    (scene / "truth" / "clean" / TRAIN[3]).unlink()
    data = data_of(scene, tmp_path / "cache")
    with pytest.raises(AwError, match=f"size: {TRAIN[2]}"):
        TruthMask(TruthConfig()).setup(data)
    with pytest.raises(AwError, match=f"1 of 6 .* {TRAIN[3]}"):
        clean_data(data)
    with pytest.raises(AwError, match="dilation"):
        TruthConfig(dilation=-1)
