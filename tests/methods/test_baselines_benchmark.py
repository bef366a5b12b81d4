"""benchmarks/baselines.py: what it plans, the gap by hand, lines of recipes, truth at other sizes."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from ambiguous_wild.io.images import read_png_rgb, write_png
from ambiguous_wild.io.scene_folder import load_scene
from tests.tiny_scene import write_tiny_scene

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def baselines(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import baselines

    yield baselines
    sys.modules.pop("baselines", None)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("data") / "wall-plain")


def arguments(baselines, scene, out, *more):
    return baselines.arguments(["--captures", str(scene), "--out", str(out), "--seeds", "0", "1", *more])


def test_scenes_are_taken_by_their_names_and_runs_once(baselines, scene, tmp_path):
    args = arguments(baselines, scene, tmp_path, "--only", "desplat", "absgs")
    planned = baselines.plan(args, [scene])
    assert {job.method for job in planned["transient"]} == {"3dgs", "3dgs+truth", "desplat"}
    assert len(planned["transient"]) == 6 and planned["density"] == []
    job = planned["transient"][0]
    assert job.folder(tmp_path) == tmp_path / "full-12000" / "wall-plain" / "3dgs" / "seed0"
    words = job.run(tmp_path, 7).words
    assert words[words.index("--iterations") + 1] == "7" and words[words.index("--threads") + 1] == "1"
    assert words[words.index("-o") + 1] == str(tmp_path / "full-12000")


def test_the_share_of_the_gap_by_hand(baselines, scene, tmp_path, monkeypatch):
    psnr = {"3dgs": (20.0, 21.0), "3dgs+truth": (24.0, 25.0), "desplat": (22.0, 24.0)}

    def result(job, out):
        row = {"name": "a", "psnr": psnr[job.method][job.seed]}
        pace = 30.0 if job.method == "desplat" else 10.0
        return {"status": "ok", "per_image": [row], "masks": {"iou": 0.5},
                "cost": {"gaussians": 100, "ms_per_iteration": pace}}  # fmt: skip

    monkeypatch.setattr(baselines, "result_of", result)
    args = arguments(baselines, scene, tmp_path, "--only", "desplat", "--sections", "transient")
    data = baselines.report(baselines.plan(args, [scene]), args)
    (row,) = data["rows"]
    assert row["gain_db"] == 2.5 and row["gap_db"] == 4.0 and row["share"] == 0.625
    assert row["gain_sd"] == pytest.approx(np.std([2, 3], ddof=1)) and row["ms_ratio"] == 3.0
    assert "| desplat |" in baselines.to_markdown(data) and "+2.50" in baselines.to_markdown(data)
    monkeypatch.setattr(baselines, "result_of", lambda job, out: None if job.seed else result(job, out))
    (one,) = baselines.report(baselines.plan(args, [scene]), args)["rows"]
    assert (row["seeds"], one["seeds"], one["gain_db"], one["gain_sd"]) == (2, 1, 2.0, None)
    monkeypatch.setattr(baselines, "result_of", lambda job, out: None)
    nothing = baselines.report(baselines.plan(args, [scene]), args)
    assert nothing["rows"] == [] and nothing["missing"] == ["desplat on wall-plain (transient)"]


def test_lines_of_a_recipe_are_those_of_its_files(baselines):
    root = BENCHMARKS.parent / "ambiguous_wild" / "methods"
    assert baselines.recipe_lines("absgs") == len((root / "absgs.py").read_text().splitlines())
    files = [root / "gsw" / name for name in ("__init__.py", "net.py", "recipe.py")]
    assert baselines.recipe_lines("gs-w") == sum(len(f.read_text().splitlines()) for f in files)


def test_truth_at_other_sizes(baselines, scene, tmp_path):
    place = tmp_path / "scene"
    shutil.copytree(scene, place)
    (place / "images_2").mkdir()
    for path in (place / "images").iterdir():
        write_png(place / "images_2" / path.name, np.ascontiguousarray(read_png_rgb(path)[::2, ::2]))
    loaded = load_scene(place, factor=2)
    assert [photo.shape[:2] for _, photo in baselines.truth_at(loaded, 0.5)] == [(12, 16)] * 2
    for view, photo in baselines.truth_at(loaded, 2.0):
        assert np.array_equal(photo, read_png_rgb(place / "images" / view.name))
    assert baselines.truth_at(load_scene(place, factor=1), 2.0) == []
