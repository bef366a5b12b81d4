"""`aw study make`: blind, bounded, repeatable, and refused in words where it cannot be."""

from __future__ import annotations

import base64
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.study import command
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.study.make import PairQuestion, render_pairs, sample_questions
from tests.harness.fake_runs import fake_result, save
from tests.study.studies import METHODS, write_runs
from tests.tiny_scene import TEST, TRAIN, write_tiny_scene


@pytest.fixture
def made(tmp_path: Path) -> tuple[Path, Path]:
    return write_runs(tmp_path)


def make(*words: object) -> dict:
    done = CliRunner().invoke(command, ["make", *map(str, words), "--json"], catch_exceptions=False)
    return json.loads(done.stdout)


def error(*words: object) -> str:
    raised = CliRunner().invoke(command, ["make", *map(str, words)]).exception
    assert isinstance(raised, AwError), raised
    return str(raised)


def data_of(page: Path) -> dict:
    text = re.search(r'<script id="data"[^>]*>(.*?)</script>', page.read_text(), re.S)
    assert text
    return json.loads(text[1])


def pixels(uri: str) -> np.ndarray:
    head, _, body = uri.partition(",")
    assert head == "data:image/jpeg;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(body), np.uint8), cv2.IMREAD_COLOR)


def test_page_and_key_fit_together(made: tuple[Path, Path], tmp_path: Path) -> None:
    scene, runs = made
    facts = make("--scene", scene, runs, "-o", tmp_path / "s.html")
    key = json.loads((tmp_path / "s.key.json").read_text())
    data = data_of(tmp_path / "s.html")
    assert facts["photos"] == len(TRAIN) and facts["pairs"] == 3 * len(TEST)
    assert data["study"] == key["study"] == facts["study"]
    assert {q["id"]: q["kind"] for q in data["questions"]} == {
        t: e["kind"] for t, e in key["questions"].items()
    }
    # Behind x stands the method that the key names: its render is the picture on the page.
    for q in data["questions"]:
        entry = key["questions"][q["id"]]
        if q["kind"] == "preference":
            for side in ("x", "y"):
                render = cv2.imread(
                    str(runs / "yard" / entry[side] / f"seed0/renders/test/{entry['view']}.png")
                )
                assert np.abs(pixels(data["images"][q["images"][side]]).astype(int) - render).mean() < 3
    sides = [e["x"] < e["y"] for e in key["questions"].values() if e["kind"] == "preference"]
    assert len(set(sides)) == 2  # no method is always x


def test_the_page_is_blind(made: tuple[Path, Path], tmp_path: Path) -> None:
    scene, runs = made
    make("--scene", scene, runs, "-o", tmp_path / "s.html")
    data = data_of(tmp_path / "s.html")
    blank = dict.fromkeys(data["images"], "")
    text = json.dumps({**data, "images": blank})
    for leak in (*METHODS, "yard", str(tmp_path), "seed0", *TEST, *TRAIN, "train_", "test_0"):
        assert leak not in text
    for uri in data["images"].values():
        body = base64.b64decode(uri.partition(",")[2])
        assert b"Exif" not in body and b"3dgs" not in body and str(tmp_path).encode() not in body
    # A render and its rivals are encoded alike: size and format say nothing.
    shapes = {pixels(u).shape for u in data["images"].values()}
    assert len(shapes) == 1


def test_pictures_are_bounded_and_shared(made: tuple[Path, Path], tmp_path: Path) -> None:
    facts = make(made[1], "-o", tmp_path / "s.html", "--side", 64)
    data = data_of(tmp_path / "s.html")
    assert all(max(pixels(u).shape) == 64 for u in data["images"].values())
    assert facts["pictures"] == len(data["images"]) == len(TEST) * (len(METHODS) + 1)


def test_the_same_seed_makes_the_same_files_and_another_another(
    made: tuple[Path, Path], tmp_path: Path
) -> None:
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        make(made[1], "-o", tmp_path / f"{name}.html", "--seed", seed)
    text = {n: (tmp_path / f"{n}.html").read_text() for n in "abc"}
    assert text["a"] == text["b"] != text["c"]
    assert (tmp_path / "a.key.json").read_text() == (tmp_path / "b.key.json").read_text()


def test_drawing_is_even_over_pairs() -> None:
    pairs = [
        PairQuestion(s, str(v), m, (Path("a"), Path("b")), None)
        for s in ("s", "t")
        for v in range(20)
        for m in (("a", "b"), ("a", "c"), ("b", "c"))
    ]
    chosen = sample_questions(pairs, 12, np.random.default_rng(0))
    assert len(set(map(id, chosen))) == 12
    counts = [sum(q.group == g for q in chosen) for g in {p.group for p in pairs}]
    assert counts == [2] * 6


def test_outline_and_truth_can_be_left_out(made: tuple[Path, Path], tmp_path: Path) -> None:
    scene, runs = made
    make("--scene", scene, runs, "-o", tmp_path / "s.html", "--no-outline", "--no-truth")
    slots = {tuple(q["images"]) for q in data_of(tmp_path / "s.html")["questions"]}
    assert slots == {("photo",), ("x", "y")}


def test_photos_in_which_nothing_moves_are_not_asked_about(made: tuple[Path, Path], tmp_path: Path) -> None:
    scene = made[0]
    masks = scene / "truth/distractor"
    cv2.imwrite(str(masks / TRAIN[0]), np.zeros((48, 64), np.uint8))
    assert make("--scene", scene, "-o", tmp_path / "s.html")["photos"] == len(TRAIN) - 1
    for name in TRAIN:
        cv2.imwrite(str(masks / name), np.zeros((48, 64), np.uint8))
    assert "no training photo of" in error("--scene", scene, "-o", tmp_path / "t.html")


def test_what_cannot_be_is_said(made: tuple[Path, Path], tmp_path: Path) -> None:
    scene, runs = made
    out = tmp_path / "s.html"
    assert "nothing to ask" in error("-o", out)
    assert "*.html" in error("--scene", scene, "-o", tmp_path / "s.txt")
    assert "unknown method 'refinesplit': did you mean 'refinesplat'" in error(
        runs, "-o", out, "--method", "refinesplit"
    )
    assert "two methods" in error(runs, "-o", out, "--method", "3dgs")
    untested = save(tmp_path / "untested", *(fake_result(m, psnr=()) for m in ("3dgs", "mine")))
    assert "has no scene with test photos and finished runs of two methods" in error(untested, "-o", out)
    assert "give RUNS" in error("--scene", scene, "-o", out, "--method", "3dgs")
    wide = runs / "yard/3dgs/seed0/renders/test" / TEST[0]
    cv2.imwrite(str(wide), np.zeros((48, 70, 3), np.uint8))
    assert "differ in size" in error(runs, "-o", out)
    shutil.rmtree(wide.parent)
    assert "3dgs lacks renders/test" in error(runs, "-o", out)
    shutil.rmtree(runs / "yard/3dgs")
    shutil.rmtree(scene)
    assert "--no-truth" in error(runs, "-o", out)
    assert not out.exists() and not (tmp_path / "s.key.json").exists()


def change(run: Path, **values: object) -> None:
    """Make the run one on another state of the scene (`scene_hash`), or with other facts."""
    result = json.loads((run / "metrics.json").read_text()) | values
    (run / "metrics.json").write_text(json.dumps(result))
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["scene"]["sha256"] = result["scene_hash"]
    (run / "config.yaml").write_text(yaml.safe_dump(config))


def test_runs_of_other_conditions_are_refused_or_named(made: tuple[Path, Path], tmp_path: Path) -> None:
    scene, runs = made
    run, out = runs / "yard/3dgs/seed0", tmp_path / "s.html"
    change(run, facts={"length": "40 iterations"})
    change(runs / "yard/refinesplat/seed0", facts={"length": "45 iterations"})
    with pytest.warns(UserWarning, match="lengths differ on yard: 3dgs: 40 .*, refinesplat: 45"):
        make(runs, "-o", out, "--overwrite")
    state = yaml.safe_load((run / "config.yaml").read_text())["scene"]["sha256"]
    half = {"facts": {"protocol": "half"}}
    for values, what in ((half, "--protocol"), ({"scene_hash": "a"}, "version of the scene")):
        change(run, **values)
        assert what in error(runs, "-o", out, "--overwrite", "--no-truth")
        change(run, facts={}, scene_hash=state)
    path = scene / "images" / TEST[0]
    cv2.imwrite(str(path), 255 - cv2.imread(str(path)))
    assert "another state of" in (line := error(runs, "-o", out, "--overwrite")) and "--no-truth" in line
    make(runs, "-o", out, "--overwrite", "--no-truth")


def test_an_old_page_is_not_replaced_unasked(made: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "s.html"
    make("--scene", made[0], "-o", out)
    before = out.read_text()
    assert "--overwrite" in error("--scene", made[0], "-o", out, "--seed", 1)
    assert out.read_text() == before
    make("--scene", made[0], "-o", out, "--seed", 1, "--overwrite")
    assert out.read_text() != before


def test_views_of_several_folders_with_equal_names_are_all_asked_about(
    made: tuple[Path, Path], tmp_path: Path
) -> None:
    scene, runs = made
    moved = dict(zip(TEST, ("back/0.png", "front/0.png"), strict=True))
    for old, new in moved.items():
        for path in [*scene.rglob(old), *runs.rglob(old)]:
            (path.parent / new).parent.mkdir()
            path.rename(path.parent / new)
        for text in (scene / "test_list.txt", scene / "sparse/0/images.txt"):
            text.write_text(text.read_text().replace(old, new))
    state = scene_identity(load_scene(scene))
    for method in METHODS:
        change(runs / "yard" / method / "seed0", scene_hash=state)
    make(runs, "-o", tmp_path / "s.html")
    key = json.loads((tmp_path / "s.key.json").read_text())
    assert sorted(e["view"] for e in key["questions"].values()) == ["back/0"] * 3 + ["front/0"] * 3


def test_a_title_cannot_leave_its_script_element_and_methods_of_any_name_stay_in_the_key(
    tmp_path: Path,
) -> None:
    _, runs = write_runs(tmp_path, ("<b>a</b>", "=b"))
    assert {m for p in render_pairs(runs) for m in p.methods} == {"<b>a</b>", "=b"}
    make(runs, "--title", "</script><script>alert(1)</script>", "-o", tmp_path / "s.html")
    page = (tmp_path / "s.html").read_text()
    assert page.count("</script>") == 2 and "alert(1)</script>" not in page and "<b>a" not in page


def test_a_scene_given_twice_and_half_a_character_are_refused(
    made: tuple[Path, Path], tmp_path: Path
) -> None:
    scene, _ = made
    page = tmp_path / "s.html"
    for other in (scene / ".", write_tiny_scene(tmp_path / "elsewhere" / scene.name)):
        assert "are both called yard" in error("--scene", scene, "--scene", other, "-o", page)
    assert "half a character" in error("--scene", scene, "-o", page, "--title", "a\udcff")
    assert not page.exists()
