"""The whole path on rendered photos of two walls, whose cameras are known exactly."""

import errno
import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder import scene_record
from ambiguous_wild.builder.pipeline import build_scene
from ambiguous_wild.builder.records import SceneRecord
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core import AwError
from ambiguous_wild.io.images import image_size, read_gray, read_png_rgb, write_png
from ambiguous_wild.io.safe_pycolmap import pycolmap
from ambiguous_wild.io.scene_folder import load_scene
from tests.builder.capture_maker import COUNT, HEIGHT, SETTINGS, WIDTH, eyes, write_capture


def hashes(scene: Path) -> dict[str, str]:
    """Every file but scene.json, which holds timings; of that, all the rest."""
    found = {
        p.relative_to(scene).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(scene.rglob("*"))
        if p.is_file() and p.name != "scene.json"
    }
    info = json.loads((scene / "scene.json").read_text())
    info.pop("seconds")
    info.pop("capture")  # the way from the scene to its photos
    return {**found, "scene.json": json.dumps(info)}


@pytest.fixture(scope="module")
def raw(built):
    return built / "raw"


@pytest.fixture(scope="module")
def scene(built):
    return built / "scene"


def copy_of(built: Path, out: Path) -> Path:
    """The scene with the finished stages of its build, to go on from."""
    shutil.copytree(built / "scene", out)
    shutil.copytree(built / ".scene.build", out.with_name(f".{out.name}.build"), symlinks=True)
    return out


def test_every_photo_is_placed_where_it_was_taken(scene):
    """Oracle: the eyes the photos were rendered from, up to the similarity SfM leaves open."""
    loaded = load_scene(scene)
    assert len(loaded.views) == COUNT
    found = np.array([v.camera.center for v in loaded.views])
    truth = np.array(eyes(COUNT))
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(sign)).sum() / (a**2).sum()
    residual = np.linalg.norm(scale * a @ (u @ sign @ vt).T - b, axis=1)
    assert residual.max() < 0.02 * np.linalg.norm(b, axis=1).max()


def test_folder_is_what_design_says(scene):
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert model.num_reg_images() == COUNT
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert str(camera.model_name) == "PINHOLE"
        assert image_size(scene / "images" / image.name) == (camera.width, camera.height)
        small = image_size(scene / "images_2" / image.name)
        assert small == (round(camera.width / 2), round(camera.height / 2))
    assert (scene / "test_list.txt").read_text().split() == ["p01.png", "p04.png"]
    assert len((scene / "train_list.txt").read_text().split()) == 4
    assert image_size(scene / "map.png") == (1300, 860)
    nb = json.loads((scene / "nb-info.json").read_text())
    assert nb["loader_kwargs"] == {"images_path": "images_2"}


def test_scene_json_tells_what_was_done(scene):
    info = json.loads((scene / "scene.json").read_text())
    assert info["counts"]["registered"] == info["counts"]["photos"] == COUNT
    assert info["license"] == "CC0-1.0"
    assert info["split"] == "folders"
    assert info["chosen"]["camera"] == "single"
    assert info["settings"]["max_features"] == 800
    assert set(info["files"]) | {"scene.json"} == set(hashes(scene))
    assert info["photos"]["p01.png"]["source"] == "test/p01.jpg"
    assert set(info["seconds"]) >= {"screen", "features", "matches", "mapping", "undistort", "package"}
    assert 0 < scene_record.sfm_time_share(info) < 1
    assert "6 of 6" in scene_record.verdict(info, (160, 120), scene)


def test_scene_json_keeps_its_keys_and_their_order(scene):
    info = json.loads((scene / "scene.json").read_text())
    assert list(info) == [
        "schema", "schema_version", "name", "license", "factor", "images", "split", "seed", "settings",
        "chosen", "counts", "reprojection_error_px", "mean_track_length", "cameras", "lost", "skipped",
        "warnings", "photos", "masks", "fixed_to_camera", "truth", "build_key", "inputs",
        "capture", "seconds", "files",
    ]  # fmt: skip
    assert set(info) == SceneRecord.__annotations__.keys() - {"evaluation"}  # of simulated captures alone
    assert list(info["inputs"]) == ["photos", "masks", "truth", "test_list", "settings", "versions"]
    assert list(info["chosen"]) == ["camera", "sfm", "matcher", "mapper"]
    assert list(info["counts"]) == [
        "photos", "readable", "registered", "train", "test", "cameras", "points", "points_seen_in_test_only",
        "points_of_track_length_2", "pairs", "pairs_verified", "features_that_stay",
        "features_that_move",
        "photos_of_sequence",
    ]  # fmt: skip
    lens = ["model", "width", "height", "params"]
    assert list(info["cameras"][0]) == ["photos", "focal_px", "focal_sd_px", *lens]
    assert list(info["photos"]["p01.png"]) == [
        "source", "sha256", "split", "width", "height", "sharpness", "mean_luma", "features", "partners",
        "provisional", "notes", "exif",
    ]  # fmt: skip


def test_truth_comes_along_at_the_size_of_the_photos(scene):
    size = image_size(scene / "images_2" / "p03.png")
    mask = read_gray(scene / "truth" / "distractor" / "p03.png")
    assert mask.shape == size[::-1]
    assert set(np.unique(mask)) == {0, 255}
    # 60 of 320 columns, half the height, give or take the undistortion's border
    assert (mask > 0).mean() == pytest.approx(60 / 320 / 2, abs=0.02)
    assert np.abs(read_png_rgb(scene / "truth" / "clean" / "p03.png").astype(int) - 120).max() <= 1
    assert json.loads((scene / "truth" / "capture.json").read_text()) == {"seed": 1}


def test_the_photos_survive_the_path(scene, raw):
    """The full-size photo is the input again, up to the lens COLMAP found (there is none) and its border."""
    photo, ours = (
        cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        for path in (raw / "train" / "p02.jpg", scene / "images" / "p02.png")
    )
    assert abs(ours.shape[1] - WIDTH) <= 4
    window = np.s_[90:150, 130:190]
    (dx, dy), _ = cv2.phaseCorrelate(photo[window], ours[window])
    assert max(abs(dx), abs(dy)) < 1.0  # a pixel less on one side moves the centre by a half
    moved = cv2.warpAffine(photo, np.array([[1, 0, dx], [0, 1, dy]]), photo.shape[::-1])
    centre = np.s_[100:140, 140:180]
    assert np.corrcoef(moved[centre].ravel(), ours[centre].ravel())[0, 1] > 0.9


def test_same_input_same_bits_for_any_number_of_threads_and_nothing_is_left_beside(scene, raw, tmp_path):
    again = build_scene(raw, tmp_path / "scene", SETTINGS, jobs=1)
    assert again.reused == () and hashes(again.scene) == hashes(scene)
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


def test_second_call_has_nothing_to_do(scene, raw):
    before = (scene / "scene.json").stat().st_mtime_ns
    result = build_scene(raw, scene, SETTINGS, keep_work=True)
    assert result.up_to_date
    assert (scene / "scene.json").stat().st_mtime_ns == before


def test_other_settings_are_refused_by_name_until_overwrite(built, raw, tmp_path):
    out = copy_of(built, tmp_path / "scene")
    with pytest.raises(AwError, match=r"settings \(factor 2 -> 1\).*--overwrite"):
        build_scene(raw, out, replace(SETTINGS, factor=1))
    other = replace(SETTINGS, factor=4)
    result = build_scene(raw, out, other, overwrite=True, keep_work=True)
    # Only what depends on the factor ran again.
    assert set(result.reused) == {"screen", "features", "matches", "mapping", "motion", "map"}
    assert (out / "images_4").is_dir()
    assert not (out / "images_2").exists()
    # The scene deleted, the work kept: packaging runs again, nothing else.
    expected = hashes(out)
    shutil.rmtree(out)
    assert "package" not in build_scene(raw, out, other).reused
    assert hashes(out) == expected
    assert sorted(p.name for p in tmp_path.iterdir()) == ["scene"]


def test_a_folder_of_something_else_is_never_replaced(raw, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    with pytest.raises(AwError, match="is no scene"):
        build_scene(raw, tmp_path / "out", SETTINGS, overwrite=True)
    assert (tmp_path / "out" / "thesis.txt").read_text() == "mine"
    with pytest.raises(AwError, match="holds the photos themselves"):
        build_scene(raw, raw, SETTINGS, overwrite=True)


def test_a_damaged_scene_is_noticed_and_mended(scene, raw, tmp_path):
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy)
    (copy / "images_2" / "p02.png").write_bytes(b"short")
    with pytest.raises(AwError, match=r"images_2/p02\.png \(changed\)"):
        build_scene(raw, copy, SETTINGS)


@pytest.mark.parametrize("alpha", [False, True])
def test_masks_are_used_and_carried_to_their_photos(raw, tmp_path, alpha):
    """And similar photos are matched, not all. Alpha is a mask."""
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :100] = 0
    masks, noise = (
        None if alpha else tmp_path / "masks",
        np.random.default_rng(0).integers(0, 255, (240, 100, 3)),
    )
    if alpha:
        raw = shutil.copytree(raw, tmp_path / "raw")
    for i in range(COUNT):
        name = f"p{i:02d}.png"
        if masks is not None:
            write_png(masks / name, mask)
            continue
        (source,) = raw.glob(f"*/p{i:02d}.jpg")
        photo = np.dstack([cv2.imread(str(source)), mask])
        photo[:, :100, :3] = noise
        source.unlink()
        cv2.imwrite(str(source.with_suffix(".png")), photo)
    settings = replace(SETTINGS, matcher="retrieval")
    result = build_scene(raw, tmp_path / "scene", settings, masks=masks, keep_work=True)
    tests = [p.name for p in (result.scene / "masks").glob("test/*")]
    assert sorted(tests) == ["p01.png", "p04.png"]
    assert any("alpha of 6 photos" in w for w in result.info["warnings"]) == alpha
    assert result.info["chosen"]["matcher"] == "retrieval" and 0 < result.info["counts"]["pairs"] <= 15
    carried = sorted(p.name for p in (result.scene / "masks" / "train").iterdir())
    assert carried == ["p00.png", "p02.png", "p03.png", "p05.png"]
    loaded = load_scene(result.scene)
    assert {v.name for v in loaded.train if v.keep_path} == set(carried)
    keep = read_gray(loaded.train[0].keep_path)
    assert keep.shape[::-1] == image_size(loaded.train[0].image_path)
    assert keep[60, 5] == 0
    assert keep[60, -5] == 255
    # No feature was taken where the mask is black.
    for image in pycolmap.Reconstruction(str(result.scene / "sparse" / "0")).images.values():
        assert min(p.xy[0] for p in image.points2D) > 90


def test_photos_of_different_places_fail_cleanly_with_the_figures(tmp_path):
    from tests.builder.capture_maker import texture

    (tmp_path / "raw").mkdir()
    for i in range(4):
        cv2.imwrite(str(tmp_path / "raw" / f"{i}.png"), texture(10 + i)[:240, :320])
    with pytest.raises(AwError, match=r"registered \d of 4 photos.*median \d+ features.*overlap too little"):
        build_scene(tmp_path / "raw", tmp_path / "scene", BuildSettings(max_features=500))
    assert [p.name for p in tmp_path.iterdir()] == ["raw"]


def test_the_second_part_of_a_capture_is_built_on_demand(tmp_path):
    """Two places, 6 and 4 photos: --part 2 builds the smaller one, with a warning that names both."""
    write_capture(tmp_path / "raw", 6)
    write_capture(tmp_path / "raw", 4, "q", seeds=(3, 4))
    settings = BuildSettings(factor=1, max_features=500, sfm="fast", part=2)
    info = build_scene(tmp_path / "raw", tmp_path / "scene", settings, jobs=2).info
    sources = {photo["source"] for photo in info["photos"].values() if photo["split"]}
    assert sources == {f"q{k:02d}.jpg" for k in range(4)}
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    assert {image.name[0] for image in model.images.values()} == {"q"} and model.num_points3D() > 40
    assert {photo["reason"].partition(":")[0] for photo in info["lost"]} == {"in part 1"}
    (warning,) = (text for text in info["warnings"] if "fall into 2 parts" in text)
    assert "part 1 of 6 (p00.jpg" in warning and "part 2 of 4 (q00.jpg" in warning


def test_identical_photos_fail_cleanly(tmp_path):
    path = write_capture(tmp_path / "raw", 1)[0]
    for level in (1, 9):  # the same pixels in other bytes: no copies that could be left out beforehand
        cv2.imwrite(
            str(path.with_name(f"q{level}.png")), cv2.imread(str(path)), [cv2.IMWRITE_PNG_COMPRESSION, level]
        )
    with pytest.raises(AwError, match=r"registered \d of 3 photos"):
        build_scene(tmp_path / "raw", tmp_path / "scene", BuildSettings(max_features=500))
    assert [p.name for p in tmp_path.iterdir()] == ["raw"]


def test_a_full_disk_keeps_what_is_done_and_goes_on(built, raw, scene, tmp_path, monkeypatch):
    from ambiguous_wild.builder import resample

    def full(*args):
        raise OSError(errno.ENOSPC, "No space left on device", "/disk/p02.png")

    shutil.rmtree(copy_of(built, tmp_path / "scene"))  # its last stage went with it
    (unfinished,) = (tmp_path / ".scene.build").glob("undistort-*")
    shutil.rmtree(unfinished)
    with monkeypatch.context() as patch:
        patch.setattr(resample, "write_png", full)
        with pytest.raises(AwError, match=r"No space left on device \(/disk/p02\.png\).*goes on"):
            build_scene(raw, tmp_path / "scene", SETTINGS)
    assert not (tmp_path / "scene").exists()
    result = build_scene(raw, tmp_path / "scene", SETTINGS)
    assert set(result.reused) == {"screen", "features", "matches", "mapping", "motion", "map"}
    assert hashes(result.scene) == hashes(scene)


def test_a_capture_that_was_moved_is_linked_anew(built, raw, tmp_path):
    out = copy_of(built, tmp_path / "scene")
    shutil.rmtree(out)
    shutil.copytree(raw, tmp_path / "moved")
    build_scene(tmp_path / "moved", out, SETTINGS, keep_work=True)
    links = [path for path in (tmp_path / ".scene.build").glob("screen-*/photos/*.png") if path.is_symlink()]
    assert {path.resolve().is_relative_to(tmp_path) for path in links} == {True, False}


def test_a_mistyped_option_does_not_cost_the_work_of_a_stopped_build(built, raw, tmp_path):
    out = copy_of(built, tmp_path / "scene")
    shutil.rmtree(out)  # as if it had been stopped before its last step
    (tmp_path / "typo.txt").write_text("nobody.png\n")
    with pytest.raises(AwError, match=r"nobody\.png"):
        build_scene(raw, out, SETTINGS, test_list=tmp_path / "typo.txt")
    assert "features" in build_scene(raw, out, SETTINGS).reused


def test_what_lies_in_a_scene_and_is_not_the_builds_is_never_removed(raw, scene, tmp_path):
    out = tmp_path / "scene"
    shutil.copytree(scene, out)
    (out / "runs").mkdir()
    (out / "runs" / "notes.txt").write_text("mine")
    other = replace(SETTINGS, factor=4)
    before = hashes(out)
    with pytest.raises(AwError, match=r"also holds runs/notes\.txt"):
        build_scene(raw, out, other, overwrite=True)
    assert hashes(out) == before
