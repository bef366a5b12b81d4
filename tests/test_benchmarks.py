"""Scripts of benchmarks/: they start; the sums of the table of captures by hand."""

import csv
import json
import re
import runpy
import sys

import pytest

from tests.benchmark_scripts import BENCHMARKS, benchmark

SCRIPTS = sorted(path for path in BENCHMARKS.glob("*.py") if "__main__" in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_a_script_starts(path, monkeypatch, capsys):
    """Its imports are there and its options are sound."""
    monkeypatch.setattr(sys, "argv", [path.name, "--help"])
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(path), run_name="__main__")
    assert ended.value.code == 0 and "usage" in capsys.readouterr().out


@pytest.fixture(scope="module")
def report():
    with benchmark("captures_report") as module:
        yield module


def row(capture, method, psnr, iou=None, gaussians=100.0, masked=0.0):
    return {
        "capture": capture, "method": method, "psnr": psnr, "iou": iou, "gaussians": gaussians,
        "masked_share": masked,
    }  # fmt: skip


def test_the_summary_by_hand(report):
    rows = [
        row("a", "3dgs", 26.0), row("a", "refinesplat", 29.0, 0.7, 90.0),
        row("a", "robustsplat", 28.0, 0.6), row("a", "dronesplat", 27.0, 0.5), row("a", "3dgs+truth", 30.0),
        row("b", "3dgs", 30.0), row("b", "refinesplat", 31.0, 0.5, 120.0),
        row("b", "robustsplat", 31.5, 0.6), row("b", "dronesplat", 30.0, 0.2), row("b", "3dgs+truth", 32.0),
        row("c", "3dgs", 33.0), row("c", "refinesplat", 32.75, None, 60.0, 1.5),
        row("c", "robustsplat", 32.0), row("c", "dronesplat", 30.0), row("c", "3dgs+truth", 33.0),
    ]  # fmt: skip
    captures = [{"name": n, "distractor_share": s} for n, s in (("a", 0.2), ("b", 0.1), ("c", 0.0))]
    got = report.summarise(rows, captures)
    assert set(got["gap"]) == {"a", "b"}  # on c exact masks bring nothing
    assert got["gap"]["a"] == {"gap_db": 4.0, "gained_db": 3.0, "share": 0.75}
    assert got["gap_share_mean"] == pytest.approx((0.75 + 0.5) / 2)
    assert got["psnr_mean"]["refinesplat"] == pytest.approx((29 + 31 + 32.75) / 3, abs=1e-6)
    assert got["best"] == "refinesplat"  # the references are not ranked
    assert got["best_by_capture"] == {"a": "refinesplat", "b": "robustsplat", "c": "3dgs"}
    assert got["iou_beats_both"] == ["a"]
    assert got["clean"] == {"c": {"difference_db": -0.25, "masked_share": 1.5}}
    assert got["gaussians_ratio"] == {"a": 0.9, "b": 1.2, "c": 0.6}
    assert got["gaussians_ratio_mean"] == pytest.approx(0.9)


def test_a_missing_run_is_missing_and_not_zero(report):
    rows = [row("a", "3dgs", 26.0), row("a", "refinesplat", None), row("a", "3dgs+truth", 30.0)]
    got = report.summarise(rows, [{"name": "a", "distractor_share": 0.2}])
    assert got["gap"]["a"]["share"] is None
    assert got["gap_share_mean"] is None
    assert got["psnr_mean"]["refinesplat"] is None
    assert got["best"] == "3dgs"
    assert got["iou_beats_both"] == []
    assert got["gaussians_ratio"]["a"] is None


def test_the_readme_quotes_the_demo_and_the_speed_of_the_result_files():
    readme, results = (BENCHMARKS.parent / "README.md").read_text(encoding="utf-8"), BENCHMARKS / "results"
    with (results / "demo.csv").open(encoding="utf-8", newline="") as file:
        first, second = (float(row["psnr"]) for row in csv.DictReader(file))
    assert f"{first:.2f} dB with 3DGS and {second:.2f} dB with RefineSplat" in readme
    for case in json.loads((results / "limits.json").read_text(encoding="utf-8"))["cases"][:2]:
        assert f"{case['best_ms']:.1f} ms" in readme


def test_the_tables_of_readme_and_docs_are_those_of_the_result_files():
    with benchmark("figures") as figures:
        for page in figures.TABLES:
            text = (figures.ROOT / page).read_text(encoding="utf-8")
            assert figures.written(page, text) == text, "run python benchmarks/figures.py"
            changed, count = re.subn(r"(<!-- figures: .*\n.*\n.*\n\| )", r"\1wrong ", text)
            assert count == len(figures.TABLES[page]) and figures.written(page, changed) == text
