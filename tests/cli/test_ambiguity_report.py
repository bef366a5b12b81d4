"""`aw ambiguity-report` on a scene whose answer is planted."""

from __future__ import annotations

import csv
import json
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.metrics.ambiguity import COLOUR_METRIC
from ambiguous_wild.report.ambiguity_summary import describe
from tests.command_line import aw
from tests.tiny_scene import TRAIN, write_tiny_scene

SEMANTIC_METRIC = "semantic_lookalike_labhog"


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """The tiny scene, its distractor-free twin as the clean views."""
    root = write_tiny_scene(tmp_path / "scene")
    clean = write_tiny_scene(tmp_path / "clean", distractors=False)
    (root / "truth/clean").mkdir()
    for name in TRAIN:
        shutil.copy(clean / "images" / name, root / "truth/clean" / name)
    return root


def printed(*words: object) -> str:
    done = aw("ambiguity-report", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout


def report(*words: object) -> dict:
    return json.loads(printed(*words, "--json"))


def error(*words: object) -> str:
    done = aw("ambiguity-report", *words)
    assert done.returncode == 2
    return done.stderr


def pixels(scene: Path, part: str, name: str) -> np.ndarray:
    return cv2.imread(str(scene / part / name)).astype(float) / 255


def test_scores_are_those_of_the_files(scene: Path, tmp_path: Path) -> None:
    facts = report(scene, "-o", tmp_path / "out")
    masks = {n: pixels(scene, "truth/distractor", n)[..., 0] > 0.5 for n in TRAIN}
    away = [
        np.linalg.norm(pixels(scene, "images", n) - pixels(scene, "truth/clean", n), axis=2)[masks[n]]
        for n in TRAIN
    ]
    assert facts["occlusion"]["value"] == pytest.approx(np.mean([m.mean() for m in masks.values()]), abs=1e-6)
    assert facts[COLOUR_METRIC]["value"] == pytest.approx((np.concatenate(away) < 0.3).mean(), abs=1e-6)
    assert facts[COLOUR_METRIC]["mean_residual"] == pytest.approx(np.concatenate(away).mean(), abs=1e-5)
    assert facts[COLOUR_METRIC]["ambiguous"] is False and 0 <= facts[SEMANTIC_METRIC]["value"] <= 1
    rows = list(csv.DictReader((tmp_path / "out/photos.csv").open()))
    assert [r["photo"] for r in rows] == TRAIN
    assert float(rows[0]["occlusion"]) == pytest.approx(masks[TRAIN[0]].mean(), abs=1e-6)
    saved = json.loads((tmp_path / "out/ambiguity.json").read_text())
    assert saved["occlusion"] == facts["occlusion"] and len(saved["per_photo"]) == len(TRAIN)
    assert cv2.imread(str(tmp_path / "out/ambiguity.png")).std() > 5
    page = (tmp_path / "out/index.html").read_text()
    assert page.count("<tr") == 1 + len(TRAIN) and "viewport" in page
    # It needs no other file, here or elsewhere.
    assert "http" not in page and page.count("src=") == page.count('src="data:image/') > len(TRAIN)


def test_a_distractor_in_the_background_s_colours_is_ambiguous(scene: Path, tmp_path: Path) -> None:
    for name in TRAIN:
        shutil.copy(scene / "truth/clean" / name, scene / "images" / name)
    facts = report(scene, "-o", tmp_path / "out")
    assert facts[COLOUR_METRIC]["value"] == 1.0 and facts[COLOUR_METRIC]["ambiguous"] is True


def test_without_a_background_colour_is_refused_or_left_out_on_request(scene: Path, tmp_path: Path) -> None:
    shutil.rmtree(scene / "truth/clean")
    assert "--background none" in error(scene, "-o", tmp_path / "out") and not (tmp_path / "out").exists()
    text = printed(scene, "-o", tmp_path / "out", "--background", "none")
    assert "colour: no verdict, because no background of a distractor is known" in text
    assert "100 % of the distractor pixels is unknown" in text
    facts = json.loads((tmp_path / "out/ambiguity.json").read_text())
    assert facts["class"] in ("unknown", "semantic, rest unknown")


def test_no_distractor_pixels_give_no_verdict(scene: Path, tmp_path: Path) -> None:
    for name in TRAIN:
        cv2.imwrite(str(scene / "truth/distractor" / name), np.zeros((48, 64), np.uint8))
    with warnings.catch_warnings():  # matplotlib's on layouts that do not fit
        warnings.simplefilter("error")
        facts = report(scene, "-o", tmp_path / "out")
    assert facts["occlusion"]["value"] == 0
    assert facts[COLOUR_METRIC]["value"] is None and facts[SEMANTIC_METRIC]["ambiguous"] is None
    assert facts["class"] == "no distractors"
    text = printed(scene, "-o", tmp_path / "again")
    assert "photos are empty" in text and "missing" not in text
    assert "no distractors" in (tmp_path / "again/index.html").read_text()


def test_own_masks_and_what_is_said_where_there_are_none(scene: Path, tmp_path: Path) -> None:
    own = tmp_path / "mine"
    shutil.copytree(scene / "truth/distractor", own)
    shutil.rmtree(scene / "truth")
    assert "--distractor-masks or --keep-masks DIR" in error(scene)
    blind = ("--background", "none")
    assert report(scene, "--distractor-masks", own, "-o", tmp_path / "out", *blind)["occlusion"]["value"] > 0
    (own / TRAIN[2]).unlink()
    assert TRAIN[2] in error(scene, "--distractor-masks", own)
    cv2.imwrite(str(own / TRAIN[2]), np.zeros((48, 20), np.uint8))
    assert "another shape" in error(scene, "--distractor-masks", own, *blind)


def test_nothing_but_scores_in_scene_json_change_and_files_repeat(scene: Path, tmp_path: Path) -> None:
    account = {"schema_version": 1, "name": "yard", "factor": 1, "files": {}}
    (scene / "scene.json").write_text(json.dumps(account))
    files = [p for p in sorted(scene.rglob("*")) if p.is_file() and p.name != "scene.json"]
    before = [sha256_file(p) for p in files]
    report(scene, "-o", tmp_path / "a", "--no-record")
    assert json.loads((scene / "scene.json").read_text()) == account
    facts = report(scene, "-o", tmp_path / "b")
    saved = json.loads((scene / "scene.json").read_text())
    assert saved.pop("ambiguity")["occlusion"] == facts["occlusion"] and saved == account
    assert load_scene(scene).info["ambiguity"]["masks"] == "truth"
    assert [sha256_file(p) for p in files] == before
    for name in ("ambiguity.json", "ambiguity.png", "index.html", "photos.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_keep_masks_are_the_inverse(scene: Path, tmp_path: Path) -> None:
    facts = report(scene, "-o", tmp_path / "a")
    (scene / "masks/train").mkdir(parents=True)
    for name in TRAIN:
        mask = cv2.imread(str(scene / "truth/distractor" / name), 0)
        cv2.imwrite(str(scene / "masks/train" / name), 255 - mask)
    kept = report(scene, "-o", tmp_path / "b", "--distractor-masks", "scene")
    other = report(scene, "-o", tmp_path / "c", "--keep-masks", scene / "masks/train")
    assert kept["masks"] == "scene" and other["masks"] == "folder"
    assert kept[COLOUR_METRIC] == other[COLOUR_METRIC] == facts[COLOUR_METRIC]


def test_names_are_escaped_on_the_page() -> None:
    from ambiguous_wild.report.ambiguity_page import page

    interval = {"value": 0.5, "low": None, "high": None}
    summary = {
        "scene": "<b>x", "class": "both", "photos": 1, "masks": "m", "background": "b", "features": "labhog",
        "seed": 0, "occlusion": {**interval, "min": 0.5, "max": 0.5},
        COLOUR_METRIC: {**interval, "ambiguous": True, "unknown_px": 0, "distractor_px": 1},
        SEMANTIC_METRIC: {**interval, "ambiguous": True, "compared_with": "o", "same_surface": None},
    }  # fmt: skip
    text = page(
        summary, [{"photo": "<script>"}], b"", [('"><img src=x', [("<i>photo", b"j"), ("masks", b"k")])]
    )
    assert text.count("<figure>") == 2 and "<i>photo" not in text and "prefers-color-scheme:dark" in text
    assert "<script>" not in text and "<b>x" not in text and '"><img src=x' not in text


def test_a_cosine_near_its_limit_is_told_apart_from_it(scene: Path, tmp_path: Path) -> None:
    summary = report(scene, "-o", tmp_path / "out")
    look = summary[SEMANTIC_METRIC] | {"value": 0.6964, "low": 0.6951, "high": 0.7049}
    real = summary | {"features": "dinov2-small", "semantic_cosine_dinov2_small": look}
    assert "cosine 0.696 [0.695, 0.705]" in "\n".join(describe(real))
    resemble = "] of the distractor pixels lie in regions that resemble a static region of another photo"
    assert resemble in "\n".join(describe(summary))
