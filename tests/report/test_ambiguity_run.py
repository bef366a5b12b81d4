"""The background as a run renders it: what it knows, what it does not, and runs that do not fit."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.ambiguity_report import command
from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics.ambiguity import COLOUR_METRIC
from ambiguous_wild.report.ambiguity_sources import RunBackground, find_masks, sees
from tests.tiny_scene import TRAIN, WALL_Z, wall_colour, write_tiny_scene


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return write_tiny_scene(tmp_path / "scene")


@pytest.fixture
def run(scene: Path, tmp_path: Path) -> Path:
    """A run whose Gaussians are the wall itself, and whose masks are the truth."""
    folder = tmp_path / "run"
    (folder / "masks").mkdir(parents=True)
    x, y = np.meshgrid(np.arange(-2.6, 4.2, 0.05), np.arange(-2.0, 2.0, 0.05))
    n = x.size
    colour = wall_colour(x.ravel(), y.ravel())
    write_splat_ply(
        folder / "point_cloud.ply",
        {
            "means": np.column_stack([x.ravel(), y.ravel(), np.full(n, WALL_Z)]).astype(np.float32),
            "quats": np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
            "log_scales": np.full((n, 3), np.log(0.03), np.float32),
            "opacity_logits": np.full(n, 5.0, np.float32),
            "sh0": ((colour - 0.5) / 0.28209479).astype(np.float32),
            "sh_rest": np.zeros((n, 0, 3), np.float32),
        },
    )
    identity = scene_identity(load_scene(scene))
    (folder / "config.yaml").write_text(yaml.safe_dump({"scene": {"sha256": identity, "name": "scene"}}))
    for name in TRAIN:
        truth = cv2.imread(str(scene / "truth/distractor" / name), 0)
        cv2.imwrite(str(folder / "masks" / name), 255 - truth)
    return folder


def test_scores_of_a_good_render_are_those_of_the_clean_photos(
    scene: Path, run: Path, tmp_path: Path
) -> None:
    words = [
        str(scene),
        "--run",
        str(run),
        "-o",
        str(tmp_path / "out"),
        "--distractor-masks",
        "run",
        "--json",
    ]
    facts = json.loads(CliRunner().invoke(command, words, catch_exceptions=False).stdout)
    assert (facts["masks"], facts["background"]) == ("run", "run")
    clean = write_tiny_scene(tmp_path / "clean", distractors=False)
    away = []
    for name in TRAIN:
        mask = cv2.imread(str(scene / "truth/distractor" / name), 0) > 0
        pair = [cv2.imread(str(r / "images" / name))[mask] / 255 for r in (scene, clean)]
        away.append(np.linalg.norm(pair[0] - pair[1], axis=1))
    score = facts[COLOUR_METRIC]
    assert score["unknown_px"] < 0.1 * score["distractor_px"]
    assert score["mean_residual"] == pytest.approx(np.concatenate(away).mean(), abs=0.03)


def test_what_no_two_other_photos_saw_is_unknown(scene: Path, run: Path) -> None:
    # The same patch of the wall is masked in all photos but one.
    loaded = load_scene(scene)
    for name in TRAIN:
        x = 0.25 * TRAIN.index(name)
        left, right = ((1.0 + edge - x) / WALL_Z * 60 + 32 for edge in (-0.5, 0.5))
        keep = np.full((48, 64), 255, np.uint8)
        keep[10:30, round(left) : round(right)] = 255 * (name == TRAIN[1])
        cv2.imwrite(str(run / "masks" / name), keep)
    masks = find_masks(loaded, "run", run)
    background = RunBackground(loaded, run, masks)
    view = loaded.train[0]
    _, known = background.load(0, view)
    assert known is not None
    inside = cv2.erode(masks.load(view).astype(np.uint8), np.ones((7, 7))) > 0
    assert inside.sum() > 20 and not known[inside].any()
    assert known[~masks.load(view)].all()


def test_points_go_there_and_back() -> None:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.array([0.2, -0.3, 0.1]))[0]
    pose[:3, 3] = (0.3, -0.2, 0.5)
    camera = Camera(64, 48, 60.0, 61.0, 31.0, 25.0, pose)
    rows, cols, depth = np.array([0, 20, 47]), np.array([0, 33, 63]), np.array([2.0, 3.0, 4.0])
    points = camera.unproject(np.column_stack([cols, rows]) + 0.5, depth)
    surface = np.full((48, 64), 9.0)
    surface[rows, cols] = depth
    assert sees(camera, surface, surface > 0, points).all()
    assert not sees(camera, 1.2 * surface, surface > 0, points).any()  # something else is in front
    assert not sees(camera, surface, surface < 0, points).any()  # masked
    behind = 2 * camera.center - points
    assert not sees(camera, surface, surface > 0, behind).any()


def test_runs_that_do_not_fit_are_refused(scene: Path, run: Path, tmp_path: Path) -> None:
    def error(*more: str) -> str:
        words = [str(scene), "--run", str(run), "-o", str(tmp_path / "out"), *more]
        raised = CliRunner().invoke(command, words).exception
        assert isinstance(raised, AwError), raised
        return str(raised)

    (run / "config.yaml").write_text("scene: {sha256: other, name: yard}")
    assert "'yard'" in error()
    assert "'yard'" in error("--distractor-masks", "run", "--background", "none")
    (scene / "truth/clean").mkdir()
    for name in TRAIN:  # with a truth the run is not even read, and is still the wrong one
        (scene / "truth/clean" / name).write_bytes((scene / "images" / name).read_bytes())
    assert "'yard'" in error()
    (run / "failed.json").write_text("{}")
    assert "no finished run" in error()
    (run / "failed.json").unlink()
    (run / "config.yaml").write_text("scene: [")
    assert "damaged" in error()
    (run / "point_cloud.ply").unlink()
    assert "no finished run" in error() and not (tmp_path / "out").exists()


@pytest.mark.parametrize("folder", ["masks/train", "masks"])
def test_masks_of_the_scene_are_those_that_training_takes(scene: Path, run: Path, folder: str) -> None:
    shutil.rmtree(scene / "truth")
    shutil.copytree(run / "masks", scene / folder)
    masks = find_masks(load_scene(scene), None, None)
    assert (masks.source, masks.keep) == ("scene", True)
    assert masks.paths == {name: scene / folder / name for name in TRAIN}
    (scene / folder / TRAIN[0]).unlink()
    with pytest.raises(AwError, match=f"1 of 6 train photos have no mask in .*masks: {TRAIN[0]}"):
        find_masks(load_scene(scene), "scene", None)
