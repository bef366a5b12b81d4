"""Scores of masks where distractors also cast shadows. Oracle: pixels counted one by one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import Scene
from ambiguous_wild.harness.evaluate import write_keeps
from ambiguous_wild.io.images import read_gray
from ambiguous_wild.io.scene_folder import load_scene
from tests.tiny_scene import HEIGHT, SQUARE, TRAIN, WIDTH, write_tiny_scene

SHADOW = (slice(20, 34), slice(0, 50))  # it darkens a part of each distractor and what is below


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    root = write_tiny_scene(tmp_path / "scene")
    (root / "truth" / "shadow").mkdir()
    for name in TRAIN[:-1]:  # in the last photo there is none
        shadow = np.zeros((HEIGHT, WIDTH), np.uint8)
        shadow[SHADOW] = 255
        cv2.imwrite(str(root / "truth" / "shadow" / name), shadow)
    return load_scene(root)


def truth(scene: Scene, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Distractor and shadow of a photo, [H, W] bool."""
    path = scene.root / "truth" / "shadow" / name
    shadow = read_gray(path) > 0 if path.is_file() else np.zeros((HEIGHT, WIDTH), bool)
    return read_gray(scene.root / "truth" / "distractor" / name) > 0, shadow


def guesses(scene: Scene) -> dict[str, np.ndarray]:
    """A mask for each photo, True = masked: half of the distractor, and a corner that has none."""
    found = {}
    for view in scene.train:
        distractor, _ = truth(scene, view.name)
        found[view.name] = distractor & (np.arange(HEIGHT)[:, None] < 22)
        found[view.name][:10, :8] = True
    return found


def scores(scene: Scene, masks: dict[str, np.ndarray], folder: Path) -> dict[str, float]:
    found = write_keeps(scene, [(view, ~masks[view.name]) for view in scene.train], folder)
    assert found is not None and found["images"] == len(TRAIN)
    return {key: found[key] for key in ("iou", "precision", "recall")}


def counted(scene: Scene, masks: dict[str, np.ndarray]) -> dict[str, float]:
    """The same from every pixel that is distractor, or no shadow."""
    hit = wrong = missed = 0
    for name, mask in masks.items():
        for masked, distractor, shadow in zip(mask.flat, *(t.flat for t in truth(scene, name))):
            hit += masked and distractor
            wrong += masked and not distractor and not shadow
            missed += distractor and not masked
    return {
        "iou": hit / (hit + wrong + missed),
        "precision": hit / (hit + wrong),
        "recall": hit / (hit + missed),
    }


def test_to_mask_a_shadow_is_as_right_as_not_to(scene: Scene, tmp_path: Path) -> None:
    without = guesses(scene)
    alone = {name: truth(scene, name)[1] & ~truth(scene, name)[0] for name in without}
    assert all(alone[name].any() for name in TRAIN[:-1])
    masked = {name: mask | alone[name] for name, mask in without.items()}
    expected = counted(scene, without)
    assert scores(scene, without, tmp_path / "a") == pytest.approx(expected)
    assert scores(scene, masked, tmp_path / "b") == pytest.approx(expected)
    written = read_gray(tmp_path / "b" / TRAIN[0]) == 0
    np.testing.assert_array_equal(written, masked[TRAIN[0]])  # as it was masked, not as it is scored


def test_a_distractor_in_the_shadow_counts_and_so_does_what_is_in_no_shadow(
    scene: Scene, tmp_path: Path
) -> None:
    masks = guesses(scene)
    before = scores(scene, masks, tmp_path / "a")
    name = TRAIN[0]
    shaded = truth(scene, name)[0] & truth(scene, name)[1]
    assert (shaded & ~masks[name]).sum() == 4 * (SQUARE.stop - SQUARE.start)  # rows 22 to 25
    more = {**masks, name: masks[name] | shaded}
    after = scores(scene, more, tmp_path / "b")
    assert after == pytest.approx(counted(scene, more)) and after["recall"] > before["recall"]
    last = masks[TRAIN[-1]].copy()
    last[SHADOW] = True  # in this photo no shadow lies there
    worse = {**masks, TRAIN[-1]: last}
    found = scores(scene, worse, tmp_path / "c")
    assert found == pytest.approx(counted(scene, worse)) and found["precision"] < before["precision"]
