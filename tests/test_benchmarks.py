"""Scripts of benchmarks/: they start; README and docs quote the result files and the board."""

import csv
import json
import re
import runpy
import sys

import numpy as np
import pytest

from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.io.scene_folder import load_scene
from tests.benchmark_scripts import BENCHMARKS, benchmark
from tests.tiny_scene import write_tiny_scene

SCRIPTS = sorted(path for path in BENCHMARKS.glob("*.py") if "__main__" in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_starts(path, monkeypatch, capsys):
    """Its imports are there and its options are sound."""
    monkeypatch.setattr(sys, "argv", [path.name, "--help"])
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    assert ended.value.code == 0 and "usage" in capsys.readouterr().out


def test_readme_and_docs_quote_the_demo_and_the_speed_of_the_result_files():
    root, results = BENCHMARKS.parent, BENCHMARKS / "results"
    readme, docs = (
        (root / page).read_text(encoding="utf-8") for page in ("README.md", "docs/refinesplat.md")
    )
    with (results / "demo.csv").open(encoding="utf-8", newline="") as file:
        first, second = (float(row["psnr"]) for row in csv.DictReader(file))
    assert f"{first:.2f} dB with 3DGS and {second:.2f} dB with RefineSplat" in readme
    for case in json.loads((results / "limits.json").read_text(encoding="utf-8"))["cases"][:2]:
        assert f"{case['best_ms']:.1f} ms" in docs


def test_the_tables_of_readme_and_docs_are_those_of_the_board():
    with benchmark("figures") as figures:
        for page in figures.TABLES:
            text = (figures.ROOT / page).read_text(encoding="utf-8")
            assert figures.written(page, text) == text, "run python benchmarks/figures.py"
            changed, count = re.subn(r"(<!-- figures: .*\n.*\n.*\n\| )", r"\1wrong ", text)
            assert count == len(figures.TABLES[page]) and figures.written(page, changed) == text


def test_the_readme_says_where_refinesplat_is_first():
    with benchmark("figures") as figures:
        readme = " ".join((figures.ROOT / "README.md").read_text("utf-8").split())
        ahead = {}
        for iterations in (1000, 7000):
            psnr = [
                {m: methods[m]["psnr"] for m in figures.RANKED}
                for methods in figures.board(*figures.RANKED_ON, iterations=iterations).values()
            ]
            ahead[iterations] = [row.pop("refinesplat") - max(row.values()) for row in psnr]
        large = figures.board(*figures.SIZES[480], iterations=7000)["marble"]
        every = [
            {m: v["psnr"] for m, v in methods.items() if m not in figures.REFERENCES}
            for methods in figures.board("aw-sim", only="0").values()
        ]
    assert f"first on {sum(d >= 0 for d in ahead[1000])} of {len(ahead[1000])} scenes" in readme
    first = sum(row["refinesplat"] == max(row.values()) for row in every)
    assert f"first on {first} of the {len(every)} simulated captures" in readme
    worst, third, second, best = sorted(ahead[7000])
    assert f"four captures: RefineSplat is {best:.1f}, {second:.1f} and {third:.1f} dB ahead" in readme
    more = large["refinesplat"]["psnr"] - large["robustsplat"]["psnr"]
    assert f"and {-worst:.1f} dB behind RobustSplat on one, but {more:.1f} dB ahead there at" in readme


def test_peaks_of_memory_are_measured_on_enlarged_photos(tmp_path, monkeypatch, capsys):
    scene = load_scene(write_tiny_scene(tmp_path / "scene"))
    with benchmark("memory") as memory:
        monkeypatch.setattr(memory, "PIXELS", 192 * 144)
        monkeypatch.setattr(memory, "TRAINED", (96, 96))
        monkeypatch.setattr(memory, "GAUSSIANS", 50)
        work, page = tmp_path / "work", tmp_path / "memory.md"
        words = [str(scene.root), "--work", str(work), "--results", str(page), "--only", "view"]
        monkeypatch.setattr(sys, "argv", ["memory.py", *words])
        memory.main()
        monkeypatch.setattr(memory, "measure", lambda *_: pytest.fail("it was measured before"))
        memory.main()
    (row,) = (line for line in page.read_text().splitlines() if line.startswith("| view"))
    assert 0.0 < float(row.split("|")[3]) < 4 and capsys.readouterr().out.count("GB") == 1
    large = load_scene(work / "scene")
    assert (work / "now" / "view" / "index.html").is_file()
    photos = [read_png_rgb(path).shape for path in (work / "photos").glob("*.jpg")]
    assert photos == [(144, 192, 3)] * len(scene.views) and len(large.views) == len(scene.views)
    for view, small in zip(large.views, scene.views, strict=True):
        assert read_png_rgb(view.image_path).shape == (96, 96, 3)
        assert view.camera.fx == pytest.approx(1.5 * small.camera.fx)
        assert view.camera.fy == pytest.approx(2.0 * small.camera.fy)
        assert np.allclose(view.camera.cam_from_world, small.camera.cam_from_world)
