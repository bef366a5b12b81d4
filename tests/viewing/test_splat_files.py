"""Splat files of any tool where runs are taken: page, video, export; files that are turned upright."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import SceneTransform
from ambiguous_wild.harness.trained_models import read_models
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_files import FORMATS, read_splats
from ambiguous_wild.metrics.image import psnr
from ambiguous_wild.viewing.model import (
    AXES,
    Renderer,
    RenderSettings,
    ViewedModel,
    moved,
    space_of,
)
from ambiguous_wild.viewing.model_export import export
from tests.command_line import aw
from tests.io.test_scene_transform import UTM
from tests.io.test_scene_transform import moved as moved_scene
from tests.tiny_scene import write_tiny_scene
from tests.viewing.wall_runs import wall_model, write_shown_run


def lively(rest: int) -> dict[str, np.ndarray]:
    """The wall with strong harmonics and Gaussians of all shapes."""
    rng, wall = np.random.default_rng(1), wall_model(1200)
    wall["quats"] = rng.normal(size=(1200, 4)).astype(np.float32)
    return wall | {"sh_rest": rng.normal(0, 0.25, (1200, rest, 3)).astype(np.float32)}


@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize(("shift", "scale"), [(np.zeros(3), 1.0), (UTM, 3.0)])
def test_our_exports_show_what_the_run_shows(
    tmp_path: Path, form: str, shift: np.ndarray, scale: float
) -> None:
    scene = load_scene(moved_scene(tmp_path / "scene", shift, scale))
    wall = wall_model()
    offset = (shift - scene.transform.centre) * scene.transform.scale
    times = scale * scene.transform.scale
    inner = {**wall, "means": (wall["means"] * times + offset).astype(np.float32)}
    inner["log_scales"] = wall["log_scales"] + np.float32(np.log(times))
    write_splat_ply(tmp_path / "m.ply", inner, scene.transform)
    model = ViewedModel("m", tmp_path / "m.ply")
    ((made,), _) = export(model, tmp_path / "out", [form], scene.test, name="x")
    shown = read_models([made.path], scene_folder=tmp_path / "scene")
    assert shown.scene.transform == scene.transform and [m.label for m in shown.models] == [made.path.name]
    camera = scene.test[0].camera
    before, after = (
        Renderer(inner, RenderSettings())(camera),
        Renderer(shown.models[0].read(), RenderSettings())(camera),
    )
    assert before.std() > 10 and psnr(after, before) > (60 if form in ("ply", "gltf") else 35)


@pytest.mark.parametrize("axis", ["z", "-y", "x"])
@pytest.mark.parametrize("rest", [0, 3, 8, 15])
def test_an_upright_export_renders_the_same_from_turned_cameras(tmp_path: Path, axis: str, rest: int) -> None:
    scene, wall = load_scene(write_tiny_scene(tmp_path / "scene")), lively(rest)
    write_splat_ply(tmp_path / "m.ply", wall)
    model, space = ViewedModel("m", tmp_path / "m.ply"), space_of(scene)
    made, _ = export(model, tmp_path, ["ply", "gltf", "spz"], scene.test, name="up", space=space, up=axis)
    for file in made:
        assert file.psnr_to_model is not None and file.psnr_to_model > (35 if file.format == "spz" else 50)
        up = AXES["y" if file.format == "gltf" else axis]
        splats = read_splats(file.path)
        assert splats.transform.quat == pytest.approx(file.transform.quat) and splats.transform.centre != (
            0,
            0,
            0,
        )
        np.testing.assert_allclose(file.transform.rotation @ [0, -1, 0], up, atol=1e-9)  # y is down in photos
        heights = splats.gaussians["means"][splats.gaussians["opacity_logits"] > 0] @ up
        assert 0.01 < (heights < 0).mean() < 0.04 and heights.max() > 3  # the floor, and the wall above it
        if file.format != "spz":
            camera = scene.test[1].camera
            there = Renderer(splats.gaussians, RenderSettings())(splats.transform.inside(camera))
            assert psnr(there, Renderer(wall, RenderSettings())(camera)) > 50


def test_the_commands_take_files_beside_runs_and_alone(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "porch")
    run = write_shown_run(tmp_path / "runs", scene, "3dgs")
    wall = wall_model()
    wall["means"][7] = np.nan
    stranger = tmp_path / "stranger.ply"
    write_splat_ply(stranger, wall)
    done = aw("view", run, stranger, "-o", tmp_path / "both")
    assert done.returncode == 0 and "1 Gaussians with values" in done.stderr, done.stderr
    page = (tmp_path / "both" / "index.html").read_text()
    assert '"label":"stranger.ply"' in page and '"label":"3dgs"' in page

    done = aw("view", stranger, "-o", tmp_path / "alone")
    assert done.returncode == 0 and "no --scene" in done.stderr, done.stderr
    page = (tmp_path / "alone" / "index.html").read_text()
    assert page.count("data:image/jpeg") == 8 and '"split":""' in page
    film = tmp_path / "a.mp4"
    done = aw("video", stranger, "-o", film, "--seconds", 0.5, "--fps", 8, "--threads", 1)
    assert done.returncode == 0, done.stderr
    frames = cv2.VideoCapture(str(film))
    first, later = (frames.read()[1].astype(int) for _ in range(2))
    assert first[200:340, 400:560].std() > 5 and np.abs(first - later).mean() > 1  # the model, and it turns

    words = ("export", stranger, "--threads", 1, "--format", "ply", "--format", "spz")
    done = aw(*words, "--scene", scene, "--json")
    assert done.returncode == 0, done.stderr
    ply, spz = json.loads(done.stdout)
    assert Path(ply["path"]) == tmp_path / "export" / "stranger.ply" and ply["psnr_to_model"] == "inf"
    assert ply["gaussians"] == 2499 and spz["psnr_to_model"] > 35
    assert aw(*words).returncode == 2  # the user's files stay
    assert "--up needs the cameras" in aw(*words, "-o", tmp_path / "turned", "--up", "z").stderr
    assert not (tmp_path / "turned").exists()


def test_what_is_no_splat_file_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nend_header\n1"
    )
    for name in ("a.ply", "gone.ply"):
        for command in ("view", "video", "export"):
            out = tmp_path / ("o.mp4" if command == "video" else "o")
            done = aw(command, tmp_path / name, "-o", out)
            assert done.returncode == 2 and done.stderr.count("\n") == 1 and name in done.stderr, done.stderr
            assert [p.name for p in tmp_path.rglob("*")] == ["a.ply"]


def test_a_scene_around_a_model_is_upright_for_a_turned_file(tmp_path: Path) -> None:
    wall = wall_model()
    place = SceneTransform((5e5, 4e6, 10.0), 1.0, (0.5**0.5, 0.5**0.5, 0.0, 0.0))
    write_splat_ply(tmp_path / "m.ply", moved(wall, SceneTransform(place.centre), place), place)
    shown = read_models([tmp_path / "m.ply"])
    assert np.abs(shown.models[0].read()["means"]).max() < 1000
    camera = shown.scene.test[0].camera
    assert camera.cam_from_world[1, :3] @ [0, 1, 0] > 0.9  # y is down
    assert Renderer(shown.models[0].read(), RenderSettings())(replace(camera)).std() > 5
