"""What a user types and gets back: one line and exit code 2 for every mistake, nothing left behind."""

import json
import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.scene_record import verdict
from ambiguous_wild.cli.main import main
from ambiguous_wild.io.scene_folder import load_scene
from tests.builder.capture_maker import HEIGHT, WIDTH, write_capture

DATA = Path(__file__).parents[3] / "shared" / "data"


@pytest.fixture
def aw(monkeypatch, capsys, tmp_path):
    """Run `aw build-scene ...` in tmp_path; returns (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["aw", "build-scene", *map(str, args)])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code
        out, err = capsys.readouterr()
        return code, out, err

    return run


def fails(aw, *args):
    """The one line of an exit-2 failure."""
    code, out, err = aw(*args)
    assert code == 2, err
    assert out == ""
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert "Traceback" not in err
    return errors[0]


def test_empty_folder(aw, tmp_path):
    (tmp_path / "raw").mkdir()
    assert "holds no photos" in fails(aw, "raw", "-o", "scene")
    assert os.listdir(tmp_path) == ["raw"]


def test_one_photo(aw, tmp_path):
    write_capture(tmp_path / "raw", 1)
    assert "one photo" in fails(aw, "raw", "-o", "scene")
    assert os.listdir(tmp_path) == ["raw"]


def test_text_named_jpg(aw, tmp_path):
    (tmp_path / "raw").mkdir()
    for name in "abc":
        (tmp_path / "raw" / f"{name}.jpg").write_text("dear diary")
    message = fails(aw, "raw", "-o", "scene")
    assert "only 0 of 3 photos" in message
    assert "a.jpg (no image" in message
    assert os.listdir(tmp_path) == ["raw"]


def test_cut_jpeg_among_good_ones_with_strict(aw, tmp_path):
    paths = write_capture(tmp_path / "raw", 4)
    paths[2].write_bytes(paths[2].read_bytes()[:5000])
    message = fails(aw, "raw", "-o", "scene", "--strict")
    assert "1 of 4 photos cannot be read: p02.jpg (cut JPEG" in message
    assert os.listdir(tmp_path) == ["raw"]


def test_cut_jpeg_among_good_ones_is_skipped_and_counted(aw, tmp_path):
    paths = write_capture(tmp_path / "raw", 6)
    paths[2].write_bytes(paths[2].read_bytes()[:5000])
    # a photo that is too small after --factor, and is left out by structure from motion
    cv2.imwrite(str(tmp_path / "raw" / "tiny.jpg"), cv2.resize(cv2.imread(str(paths[0])), (40, 30)))
    code, out, err = aw("raw", "-o", "scene", "--max-features", 500, "--factor", 2, "--json")
    assert code == 0, err
    stages = ["reading photos", "features", "matching pairs", "placing photos", "undistorting"]
    assert list(dict.fromkeys(line for line in err.splitlines() if line in stages)) == stages  # no bars here
    facts = json.loads(out)
    assert facts["counts"]["photos"] == 7
    assert facts["counts"]["registered"] == 5
    assert facts["skipped"] == [{"source": "p02.jpg", "skipped": "cut JPEG (its end is missing)"}]
    assert "registered 5 of 7" in facts["verdict"]
    code, out, _ = aw("raw", "-o", "scene", "--max-features", 500, "--factor", 2)
    assert code == 0
    assert out.startswith("scene is up to date")
    assert "1 of 7 photos skipped: p02.jpg" in out
    assert out.splitlines()[-1].endswith("next: aw bench --method refinesplat --scene scene -o runs")
    # Other features now: refused with the setting's name.
    assert "max_features 500 -> 900" in fails(aw, "raw", "-o", "scene", "--max-features", 900, "--factor", 2)


def test_masks_missing_and_of_the_wrong_size(aw, tmp_path):
    write_capture(tmp_path / "raw", 3)
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "p00.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    message = fails(aw, "raw", "-o", "scene", "--keep-masks", "masks")
    assert "2 of 3 photos have no mask: p01.jpg, p02.jpg" in message
    for i in (1, 2):
        cv2.imwrite(str(tmp_path / "masks" / f"p0{i}.png"), np.zeros((HEIGHT, WIDTH - i), np.uint8))
    assert "2 of 3 masks" in fails(aw, "raw", "-o", "scene", "--keep-masks", "masks")
    assert sorted(os.listdir(tmp_path)) == ["masks", "raw"]


def test_options_that_cannot_be(aw, tmp_path):
    write_capture(tmp_path / "raw", 3)
    assert "does not exist" in fails(aw, "nowhere", "-o", "scene")
    small = fails(aw, "raw", "-o", "scene", "--factor", 64)
    assert "px a side, too small to train on" in small and "p02.jpg (4)" in small
    assert "--factor must be" in fails(aw, "raw", "-o", "scene", "--factor", 0)
    assert "--max-features" in fails(aw, "raw", "-o", "scene", "--max-features", 3)
    assert "--help" in fails(aw, "raw")
    assert "'exhaustive'" in fails(aw, "raw", "-o", "scene", "--matcher", "all")
    (tmp_path / "tests.txt").write_text("p07.jpg\n")
    assert "did you mean" in fails(aw, "raw", "-o", "scene", "--test-list", "tests.txt")
    assert sorted(os.listdir(tmp_path)) == ["raw", "tests.txt"]


def test_output_that_cannot_be_written(aw, tmp_path):
    write_capture(tmp_path / "raw", 3)
    (tmp_path / "file").write_text("x")
    assert "cannot write" in fails(aw, "raw", "-o", "file/scene")


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "tiny_aerial").is_dir(), reason="real photos: ../shared/data is not there")
def test_real_photos_of_fields(aw, tmp_path):
    code, out, _ = aw(DATA / "tiny_aerial", "-o", "scene", "--license", "CC0-1.0")
    assert code == 0
    assert "registered 12 of 12" in out
    scene = load_scene("scene")
    assert (len(scene.train), len(scene.test)) == (10, 2)
    assert len(scene.points) > 600
    # Reprojection of every observation, from what a trainer gets: the error SfM reports, and no outlier.
    points = scene.points
    owner = np.repeat(np.arange(len(points)), np.diff(points.track_offsets))
    errors = []
    for k, i in enumerate(owner):
        camera = scene.views[points.track_views[k]].camera
        seen = camera.intrinsics @ (camera.cam_from_world[:3] @ np.append(points.xyz[i], 1.0))
        errors.append(np.linalg.norm(seen[:2] / seen[2] - points.track_xy[k]))
    assert np.mean(errors) < 0.6
    assert np.max(errors) < 6.0


@pytest.mark.parametrize(
    "output", ["raw/sub/scene", "raw/train/scene", "raw/images", "raw/../raw/x", "link/x"]
)
def test_a_scene_is_never_made_among_the_photos(aw, tmp_path, output):
    write_capture(tmp_path / "raw", 3)
    (tmp_path / "link").symlink_to("raw")
    before = sorted(os.listdir(tmp_path / "raw"))
    assert "lies inside raw" in fails(aw, "raw", "-o", output)
    assert "holds the photos themselves" in fails(aw, "raw", "-o", "raw")
    assert sorted(os.listdir(tmp_path / "raw")) == before
    assert sorted(os.listdir(tmp_path)) == ["link", "raw"]


@pytest.mark.parametrize("mark", ["scene.json", "sparse"])
def test_a_scene_is_not_built_again(aw, tmp_path, mark):
    write_capture(tmp_path / "raw" / "images", 3)
    (tmp_path / "raw" / mark).mkdir()
    message = fails(aw, "raw", "-o", "scene")
    assert "is a scene already" in message and mark in message and "aw bench" in message
    assert os.listdir(tmp_path) == ["raw"]


@pytest.mark.parametrize("name", ["", " ", "a/b", "..", ".x", "a\nb", "\x1b[31m", "x" * 101])
def test_a_name_that_cannot_be(aw, tmp_path, name):
    write_capture(tmp_path / "raw", 3)
    assert "scene name" in fails(aw, "raw", "-o", "scene", "--name", name)
    assert os.listdir(tmp_path) == ["raw"]


def test_the_folder_s_name_must_do_as_a_name_too(aw, tmp_path):
    write_capture(tmp_path / "raw", 3)
    assert "--name sets another" in fails(aw, "raw", "-o", ".scene")


def test_a_mask_file_is_not_said_to_be_absent(aw, tmp_path):
    write_capture(tmp_path / "raw", 3)
    (tmp_path / "mask.png").write_bytes(b"x")
    assert "mask.png is a file; give the folder" in fails(
        aw, "raw", "-o", "scene", "--keep-masks", "mask.png"
    )


def test_masks_that_keep_nothing_are_named_where_registration_fails(aw, tmp_path):
    write_capture(tmp_path / "raw", 3)
    (tmp_path / "masks").mkdir()
    for i in range(3):
        cv2.imwrite(str(tmp_path / "masks" / f"p0{i}.png"), np.zeros((HEIGHT, WIDTH), np.uint8))
    message = fails(aw, "raw", "-o", "scene", "--keep-masks", "masks", "--max-features", 200)
    assert "masks keep only 0 % of a photo" in message and "white = keep" in message


def test_a_test_list_of_every_photo(aw, tmp_path):
    paths = write_capture(tmp_path / "raw", 3)
    (tmp_path / "t.txt").write_text("".join(f"{p.name}\n" for p in paths))
    assert "no training photo would be left" in fails(aw, "raw", "-o", "scene", "--test-list", "t.txt")


def test_copies_of_one_photo_are_used_once(aw, tmp_path):
    paths = write_capture(tmp_path / "raw", 5)
    (tmp_path / "raw" / "z.jpg").write_bytes(paths[0].read_bytes())
    code, out, err = aw("raw", "-o", "a b", "--max-features", 500, "--json", "--strict")
    assert code == 0, err
    facts = json.loads(out)
    assert facts["counts"]["registered"] == 5 and facts["counts"]["photos"] == 6
    assert facts["skipped"] == [{"source": "z.jpg", "skipped": "the same file as p00.jpg"}]
    assert any("z.jpg (the same file as p00.jpg)" in w for w in facts["warnings"])
    assert facts["verdict"].endswith("--scene 'a b' -o runs")
    for kept in paths[1:4]:
        kept.unlink()
    assert "only 2 of 3 photos" in fails(aw, "raw", "-o", "other")


@pytest.mark.parametrize("output", ["/dev/null/x", "file", "file/x/y", "/proc/x"])
def test_outputs_that_cannot_be_are_one_line(aw, tmp_path, output):
    write_capture(tmp_path / "raw", 3)
    (tmp_path / "file").write_text("x")
    fails(aw, "raw", "-o", output)
    assert sorted(os.listdir(tmp_path)) == ["file", "raw"]


@pytest.mark.parametrize(
    ("photos", "word"), [(3, "few photos, about 20 are needed"), (19, "few photos"), (20, "ready")]
)
def test_the_verdict_says_whether_the_photos_are_enough(photos, word):
    counts = {"registered": photos, "photos": photos, "points": 900}
    line = verdict(
        {"counts": counts, "lost": [], "reprojection_error_px": 0.5, "factor": 1}, (4, 3), Path("s")
    )
    assert word in line and ("ready" in line) == (photos >= 20)
