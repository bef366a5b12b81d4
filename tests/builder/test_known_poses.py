"""Scenes with exact cameras. Oracle: truth/cameras.json of the simulator, which the photos were made with."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.builder.known_poses import read_known_cameras
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.regions import exact_shadow
from ambiguous_wild.io.images import image_size, pillow, read_gray
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.simulate.capture_writer import simulate
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.spec import Effects, ExposureDrift, LensDistortion

SETTINGS = BuildSettings(factor=1, mapper="truth", max_features=1500)
SPEC = replace(resized(preset("tiny"), 6, 240), detail_px_per_m=40.0)
SPECS = {
    "plain": SPEC,
    "lens": replace(SPEC, effects=Effects(lens_distortion=LensDistortion(-0.12))),
    "zoom": replace(SPEC, zoom=(1.0, 1.4)),
}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("known")
    for name, spec in SPECS.items():
        simulate(spec, base / name, seed=1)
    return {name: base / name for name in SPECS}


@pytest.mark.parametrize("name", SPECS)
def test_every_photo_has_its_exact_pose(name: str, captures: dict[str, Path], tmp_path: Path) -> None:
    result = build_scene(captures[name], tmp_path / "scene", SETTINGS, jobs=2)
    assert result.info["chosen"]["mapper"] == "truth" and result.info["lost"] == []
    assert result.info["chosen"]["camera"] == ("per-image" if name == "zoom" else "single")
    truth = json.loads((captures[name] / "truth" / "cameras.json").read_text())
    scene = load_scene(result.scene, raw=True)
    assert len(scene.views) == len(truth)
    for view in scene.views:
        exact = truth[Path(view.name).stem + ".jpg"]
        assert np.allclose(view.camera.cam_from_world, exact["cam_from_world"], rtol=0, atol=1e-9)
        assert image_size(view.image_path) == (view.camera.width, view.camera.height)
        if name != "lens":
            lens = [view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy]
            assert np.allclose(lens, [exact[key] for key in ("fx", "fy", "cx", "cy")], rtol=1e-12)
    # the points are where the poses see them
    assert result.info["counts"]["points"] > 50 and result.info["reprojection_error_px"] < 1.0
    assert all(photo["partners"] > 0 for photo in result.info["photos"].values())
    assert (result.scene / "motion.npz").is_file()
    assert "evaluation" not in result.info  # the colours of all photos are the same


def test_points_lie_on_the_surfaces(tmp_path: Path) -> None:
    """Oracle: the depth that the simulator writes, at the pixels where a photo observes the points."""
    raw = tmp_path / "raw"
    simulate(replace(SPEC, distractors=()), raw, seed=1, depth=True)
    scene = load_scene(build_scene(raw, tmp_path / "scene", SETTINGS, jobs=2).scene, raw=True)
    errors = []
    for index, view in enumerate(scene.views):
        metres = np.asarray(pillow().open(raw / "truth" / "depth" / f"{Path(view.name).stem}.png")) / 1000.0
        points = scene.points
        seen = points.track_views == index
        owners = np.repeat(np.arange(len(points.xyz)), np.diff(points.track_offsets))[seen]
        depth = view.camera.to_camera(points.xyz[owners])[:, 2]
        x, y = points.track_xy[seen].astype(int).T
        exact = metres[np.clip(y, 0, metres.shape[0] - 1), np.clip(x, 0, metres.shape[1] - 1)]
        errors += list(np.abs(depth / exact - 1.0))
    assert len(errors) > 100 and np.median(errors) < 0.01


def test_a_scene_carries_its_protocol_and_the_shadows_of_its_distractors(tmp_path: Path) -> None:
    spec = replace(SPEC, cast_shadows=True, effects=Effects(exposure_drift=ExposureDrift()))
    simulate(spec, tmp_path / "raw", seed=1)
    scene = build_scene(tmp_path / "raw", tmp_path / "scene", SETTINGS, jobs=2).scene
    assert json.loads((scene / "scene.json").read_text())["evaluation"] == {"protocol": "half"}
    assert json.loads((scene / "nb-info.json").read_text())["evaluation_protocol"] == "nerfw"
    opened = load_scene(scene)
    for view in opened.train:
        shadow = exact_shadow(opened, view)
        before = read_gray(tmp_path / "raw" / "truth" / "shadow" / f"{Path(view.name).stem}.png")
        assert shadow is not None and shadow.any()
        np.testing.assert_array_equal(shadow, before > 0)


@pytest.mark.parametrize("name", ["plain", "lens"])
def test_numbers_of_the_truth_are_not_averaged(name: str, captures: dict[str, Path], tmp_path: Path) -> None:
    scene = build_scene(captures[name], tmp_path / "scene", replace(SETTINGS, factor=2), jobs=2).scene
    for view in load_scene(scene).train:
        for part in ("instances", "objects"):
            before = read_gray(captures[name] / "truth" / part / f"{Path(view.name).stem}.png")
            after = read_gray(scene / "truth" / part / f"{Path(view.name).stem}.png")
            assert after.shape == (view.camera.height, view.camera.width)
            assert len(np.unique(before)) > 2 and np.isin(after, before).all()
            if name == "plain":  # one of the four that lie in the pixel
                height, width = after.shape
                four = before[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
                assert (four == after[:, None, :, None]).any((1, 3)).all()


def photos_of(capture: Path) -> list[ScreenedPhoto]:
    paths = sorted([*capture.glob("train/*.jpg"), *capture.glob("test/*.jpg")])
    width, height = image_size(paths[0])
    return [
        ScreenedPhoto(p.relative_to(capture).as_posix(), f"{p.stem}.png", width=width, height=height)
        for p in paths
    ]


def test_equal_lenses_are_one_camera(captures: dict[str, Path]) -> None:
    assert len(read_known_cameras(captures["plain"] / "truth", photos_of(captures["plain"])).cameras) == 1
    zoomed = read_known_cameras(captures["zoom"] / "truth", photos_of(captures["zoom"]))
    assert len(zoomed.cameras) == len(zoomed.images)
    (lens,) = read_known_cameras(captures["lens"] / "truth", photos_of(captures["lens"])).cameras.values()
    assert lens.model == "SIMPLE_RADIAL" and lens.params[3] == -0.12


def spoilt(change, captures: dict[str, Path], tmp_path: Path) -> Path:
    raw = shutil.copytree(captures["plain"], tmp_path / "raw")
    path = raw / "truth" / "cameras.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    return raw


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("IMG_0002.jpg"), r"no camera of 1 photo: train/IMG_0002.jpg"),
        (
            lambda c: c["IMG_0002.jpg"].update(distortion={"k1": -0.1, "k2": 0.01}),
            "k2 is 0.01.*SIMPLE_RADIAL",
        ),
        (lambda c: c["IMG_0002.jpg"].update(fy=1.0), "fy 1, which COLMAP's SIMPLE_RADIAL"),
        (lambda c: c["IMG_0002.jpg"].update(width=99), r"99x\d+, but the photo 240x"),
        (
            lambda c: c["IMG_0002.jpg"].update(cam_from_world=[[1.0] * 4] * 4),
            "no rotation with a translation",
        ),
        (lambda c: c["IMG_0002.jpg"].update(cam_from_world=[[1.0]]), "no matrix of 4x4"),
        (
            lambda c: c["IMG_0002.jpg"]["cam_from_world"].__setitem__(3, [0.0, 0.0, 0.0, 2.0]),
            "no rotation with a translation",
        ),
        (lambda c: c["IMG_0002.jpg"].update(fx=0.0, fy=0.0), "fx above 0"),
        (lambda c: c["IMG_0002.jpg"].update(fx=-200.0, fy=-200.0), "fx above 0"),
        (lambda c: c["IMG_0002.jpg"].update(cx=241.0), "a centre in the photo"),
        (lambda c: c["IMG_0002.jpg"].update(cy=-1.0), "a centre in the photo"),
        (lambda c: c["IMG_0002.jpg"].update(distortion={"k1": -0.1, "p1": 0.0}), "a distortion of k1 and k2"),
        (lambda c: c["IMG_0002.jpg"].pop("fx"), "holds no cameras of 'aw simulate'"),
    ],
)
def test_cameras_that_cannot_be_used_are_one_line(change, message, captures, tmp_path: Path) -> None:
    raw = spoilt(change, captures, tmp_path)
    with pytest.raises(AwError, match=message) as error:
        read_known_cameras(raw / "truth", photos_of(raw))
    assert "\n" not in str(error.value)


def test_a_capture_without_truth_is_refused(captures: dict[str, Path], tmp_path: Path) -> None:
    raw = shutil.copytree(captures["plain"], tmp_path / "raw", ignore=shutil.ignore_patterns("truth"))
    with pytest.raises(AwError, match=r"the capture has no truth/cameras\.json"):
        build_scene(raw, tmp_path / "scene", SETTINGS, jobs=2)
    assert [p.name for p in tmp_path.iterdir()] == ["raw"]
    with pytest.raises(AwError, match="leave out --camera and --part"):
        replace(SETTINGS, camera="single")


def test_another_truth_is_another_scene(captures: dict[str, Path], tmp_path: Path) -> None:
    """Moving a camera by hand changes the scene, though photos and settings are the same."""
    raw = shutil.copytree(captures["plain"], tmp_path / "raw")
    build_scene(raw, tmp_path / "scene", SETTINGS, jobs=2)
    assert build_scene(raw, tmp_path / "scene", SETTINGS, jobs=2).up_to_date
    path = raw / "truth" / "cameras.json"
    data = json.loads(path.read_text())
    data["IMG_0002.jpg"]["cam_from_world"][0][3] += 0.01
    path.write_text(json.dumps(data))
    with pytest.raises(AwError, match="built from other truth"):
        build_scene(raw, tmp_path / "scene", SETTINGS, jobs=2)
