"""The benchmark of composites: which photos test, and what it makes of a base."""

import shutil
from pathlib import Path

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.scene_folder import load_scene
from tests.benchmark_scripts import benchmark
from tests.tiny_scene import TEST, TRAIN, write_tiny_scene


@pytest.fixture(scope="module")
def composites():
    with benchmark("composites") as module:
        yield module


def test_the_best_supported_views_test_none_beside_another(composites):
    shares = {"a": 0.9, "b": 0.8, "c": 0.7, "d": 0.1, "e": 0.6, "f": 0.65}
    assert composites.best_supported(shares, 3) == ["a", "c", "f"]
    assert composites.best_supported(shares, 2) == ["a", "c"]
    assert composites.best_supported({"a": 1.0, "b": 1.0}, 2) == ["a"]


def test_a_view_that_nobody_shares_is_not_supported(composites, tmp_path):
    shares = composites.support(load_scene(write_tiny_scene(tmp_path / "wall")))
    assert set(shares) == {*TRAIN, *TEST} and all(share > 0.5 for share in shares.values())


def test_a_base_is_split_once_and_gets_its_placements(composites, tmp_path, monkeypatch):
    asked = []

    def aw(*words):
        asked.append(words)
        root = Path(words[words.index("-o") + 1])
        if words[0] == "build-scene":
            if root.is_dir():  # the second build, with the test photos
                listed = Path(words[words.index("--test-list") + 1]).read_text().split()
                (root / "test_list.txt").write_text("".join(f"{n}\n" for n in listed))
                train = [n for n in (*TRAIN, *TEST) if n not in listed]
                (root / "train_list.txt").write_text("".join(f"{n}\n" for n in train))
            else:
                write_tiny_scene(root, distractors=False)
        else:
            shutil.copytree(words[1], root)

    monkeypatch.setattr(composites, "aw", aw)
    (tmp_path / "data" / "wall" / "images").mkdir(parents=True)
    given = ["--data", str(tmp_path / "data"), "--out", str(tmp_path / "out"), "--bases", "wall=1"]
    for _ in range(2):
        assert composites.main([*given, "--placements", "3", "--prepare-only"]) == 0
    assert [words[0] for words in asked] == [*["build-scene"] * 2, *["composite"] * 3]
    assert "--keep-work" in asked[0] and "--overwrite" in asked[1]
    assert ["--patches" in words for words in asked[2:]] == [False, True, False]
    scene = load_scene(tmp_path / "out" / "scenes" / "wall-cutouts-1")
    assert len(scene.test) == 3 and len(scene.train) == len(TRAIN) + len(TEST) - 3
    with pytest.raises(AwError, match="built at factor 1, not 2"):
        composites.main([*given[:-1], "wall=2", "--placements", "3", "--prepare-only"])


@pytest.mark.parametrize(
    "wrong", [["--bases", "wall"], ["--bases", "a/b=2"], ["--bases", "wall=0"], ["--placements", "0"],
              ["--frobnicate"], ["--jobs", "0"]],
)  # fmt: skip
def test_what_is_wrong_is_refused_before_a_base_is_built(composites, tmp_path, monkeypatch, wrong):
    monkeypatch.setattr(composites, "aw", lambda *words: pytest.fail("something was built"))
    with pytest.raises(SystemExit) as ended:
        composites.main(["--data", str(tmp_path), "--out", str(tmp_path / "out"), *wrong])
    assert ended.value.code == 2


def test_what_a_command_says_is_told(composites):
    with pytest.raises(AwError, match="nowhere"):
        composites.aw("build-scene", "/nowhere/at/all", "-o", "/tmp/never")
