"""`aw build-scene`: what it prints and leaves; its mistakes are in test_mistakes.py."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.builder.scene_record import (
    NO_TEST_SET,
    provisional_warnings,
    summary_lines,
    verdict,
)
from ambiguous_wild.io.scene_folder import load_scene
from tests.builder.capture_maker import write_capture
from tests.command_line import aw

DATA = Path(__file__).parents[3] / "shared" / "data"


def test_cut_jpeg_among_good_ones_is_skipped_and_counted(tmp_path):
    paths = write_capture(tmp_path / "raw", 6)
    paths[2].write_bytes(paths[2].read_bytes()[:5000])
    # a photo that is too small after --factor, and is left out by structure from motion
    cv2.imwrite(str(tmp_path / "raw" / "tiny.jpg"), cv2.resize(cv2.imread(str(paths[0])), (40, 30)))
    words = ("build-scene", "raw", "-o", "scene", "--factor", 2, "--max-features")
    done = aw(*words, 500, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    stages = ["reading photos", "features", "matching pairs", "placing photos", "undistorting"]
    said = done.stderr.splitlines()
    assert list(dict.fromkeys(line for line in said if line in stages)) == stages  # no bars here
    facts = json.loads(done.stdout)
    assert facts["counts"]["photos"] == 7 and facts["counts"]["registered"] == 5
    assert facts["skipped"] == [{"source": "p02.jpg", "skipped": "cut JPEG (its end is missing)"}]
    assert "registered 5 of 7" in facts["verdict"]
    again = aw(*words, 500, cwd=tmp_path)
    assert again.returncode == 0 and again.stdout.startswith("scene is up to date")
    assert "1 of 7 photos skipped: p02.jpg" in again.stdout
    assert again.stdout.endswith("next: aw bench --method refinesplat --scene scene -o runs\n")
    # Other features now: refused with the setting's name.
    other = aw(*words, 900, cwd=tmp_path)
    assert other.returncode == 2 and "max_features 500 -> 900" in other.stderr


@pytest.mark.slow
@pytest.mark.skipif(not (DATA / "tiny_aerial").is_dir(), reason="real photos: ../shared/data is not there")
def test_real_photos_of_fields(tmp_path):
    done = aw("build-scene", DATA / "tiny_aerial", "-o", tmp_path / "scene", "--license", "CC0-1.0")
    assert done.returncode == 0 and "registered 12 of 12" in done.stdout
    scene = load_scene(tmp_path / "scene")
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


def test_copies_of_one_photo_are_used_once(tmp_path):
    paths = write_capture(tmp_path / "raw", 5)
    (tmp_path / "raw" / "z.jpg").write_bytes(paths[0].read_bytes())
    words = ("build-scene", "raw", "-o", "a b", "--max-features", 500, "--json", "--strict")
    done = aw(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["counts"]["registered"] == 5 and facts["counts"]["photos"] == 6
    assert facts["skipped"] == [{"source": "z.jpg", "skipped": "the same file as p00.jpg"}]
    assert any("z.jpg (the same file as p00.jpg)" in w for w in facts["warnings"])
    assert facts["verdict"].endswith("--scene 'a b' -o runs")
    for kept in paths[1:4]:
        kept.unlink()
    done = aw("build-scene", "raw", "-o", "other", cwd=tmp_path)
    assert done.returncode == 2 and "only 2 of 3 photos" in done.stderr


@pytest.mark.parametrize(
    ("photos", "word"), [(3, "few photos, about 20 are needed"), (19, "few photos"), (20, "ready")]
)
def test_the_verdict_says_whether_the_photos_are_enough(photos, word):
    counts = {"registered": photos, "photos": photos, "readable": photos, "points": 900}
    line = verdict(
        {"counts": counts, "lost": [], "reprojection_error_px": 0.5, "factor": 1}, (4, 3), Path("s")
    )
    assert word in line and ("ready" in line) == (photos >= 20)


def test_a_step_of_another_command_advises_nothing_that_is_not_its_own():
    """'aw try' trains itself, and takes no test photos."""
    counts = dict.fromkeys(("registered", "photos", "readable", "train", "test", "points"), 30)
    info = {"counts": counts, "lost": [], "reprojection_error_px": 0.5, "factor": 1, "split": "every-8",
            "fixed_to_camera": [], "warnings": [f"{NO_TEST_SET}, so ...", "soft"]}  # fmt: skip
    assert "; next: aw bench --method refinesplat --scene s -o runs" in verdict(info, (4, 3), Path("s"))
    assert verdict(info, (4, 3), None).endswith(": ready")
    assert summary_lines(info)[1:] == [f"warning: {NO_TEST_SET}, so ...", "warning: soft"]
    assert summary_lines(info, test_advice=False)[1:] == ["warning: soft"]


def test_photos_placed_with_little_evidence_come_with_an_advice():
    assert provisional_warnings([]) == []
    (line,) = provisional_warnings(["a.jpg", "b.jpg"])
    assert line.startswith("2 photos registered with little evidence") and ": a.jpg, b.jpg; take more" in line


@pytest.mark.parametrize(("registered", "missing"), [(13, 11), (24, None), (20, None)])
def test_the_verdict_says_that_much_of_a_walk_is_missing(registered, missing):
    counts = {"registered": registered, "photos": 24, "readable": 24, "points": 900}
    line = verdict(
        {"counts": counts, "lost": [], "reprojection_error_px": 0.5, "factor": 1}, (4, 3), Path("s")
    )
    told = f"not whole: what the {missing} photos left out show is missing"
    assert (told in line) == (missing is not None) == ("ready" not in line)
