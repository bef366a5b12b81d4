"""Scripts of benchmarks/: they start, the sums of the table of captures by hand, and it on a tiny scene."""

import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.planning import probed
from ambiguous_wild.harness.planning.decide import Decision, Plan
from ambiguous_wild.harness.running.grid import plan_cells, run_cells
from ambiguous_wild.splat.pace import TrainConfig
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


@pytest.fixture(scope="module")
def report():
    with benchmark("captures_report") as module:
        yield module


@pytest.fixture(scope="module")
def script():
    with benchmark("captures") as module:
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


def test_an_unknown_gap_makes_the_mean_of_gaps_missing(report):
    rows = [
        row(c, m, p) for c in "ab" for m, p in (("3dgs", 26.0), ("refinesplat", 28.0), ("3dgs+truth", 30.0))
    ]
    captures = [{"name": n, "distractor_share": 0.2} for n in "ab"]
    assert report.summarise(rows, captures)["gap_share_mean"] == 0.5
    rows[-1]["psnr"] = None
    got = report.summarise(rows, captures)
    assert got["gap_unknown"] == ["b"]
    assert got["gap_share_mean"] is None
    captures[1]["distractor_share"] = 0.0  # nothing to mask: no gap, whatever was trained
    assert report.summarise(rows, captures)["gap_share_mean"] == 0.5


def test_the_masked_share_is_counted_in_the_written_masks(report, tmp_path):
    (tmp_path / "masks").mkdir()
    assert report.masked_share(tmp_path) == 0.0
    for name, rows in (("a", 2), ("b", 4)):
        keep = np.full((8, 8), 255, np.uint8)
        keep[:rows] = 0
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), keep)
    assert report.masked_share(tmp_path) == pytest.approx((2 / 8 + 4 / 8) / 2)


def test_what_trains_on_exact_masks_is_no_winner_but_the_ceiling(report):
    rows = [row("a", "3dgs", 26.0), row("a", "refinesplat", 29.0), row("a", "refinesplat@mask=truth", 31.0)]
    got = report.summarise(rows, [{"name": "a", "distractor_share": 0.2}])
    assert got["best"] == got["best_by_capture"]["a"] == "refinesplat"
    assert got["gap"]["a"] == {"gap_db": 5.0, "gained_db": 3.0, "share": 0.6}
    better = [*rows, row("a", "3dgs+truth", 32.0)]
    assert report.summarise(better, [{"name": "a", "distractor_share": 0.2}])["gap"]["a"]["gap_db"] == 6.0


def measured(script, tmp_path: Path, *more: str) -> dict:
    words = ["--captures", tmp_path / "with", "--out", tmp_path / "runs", "--results", tmp_path / "out.md"]
    args = script.arguments([str(word) for word in [*words, "--iterations", "10", *more]])
    data, failed = script.measure(args)
    assert failed == []
    args.results.write_text(script.to_markdown(data))
    return data


@pytest.mark.slow
def test_captures_trains_what_is_missing_and_tabulates(script, tmp_path, capsys):
    write_tiny_scene(tmp_path / "with")
    given = ["--methods", "3dgs@mask=truth", "--seeds", "0", "1", "--set", "truth.dilation=1"]
    data = measured(script, tmp_path, *given)
    assert "2 runs: 0 finished before, 2 to go" in capsys.readouterr().out
    (capture,), (truth,) = data["captures"], data["rows"]
    assert capture["distractor_share"] == pytest.approx(144 / (64 * 48)) and data["threads"] == [1]
    assert truth["masked_share"] == pytest.approx(100 * 14 * 14 / (64 * 48), abs=1e-4)
    assert truth["psnr"] > 0 and truth["psnr_sd"] > 0 and data["missing"] == []
    table = (tmp_path / "out.md").read_text()
    assert "| 3dgs@mask=truth |" in table and str(tmp_path) not in table

    again = measured(script, tmp_path, *given)
    assert "2 finished before, 0 to go" in capsys.readouterr().out and again["rows"] == data["rows"]
    data = measured(script, tmp_path, *given, "--report-only", "--seeds", "0", "2")
    assert [(m["seed"], m["why"]) for m in data["missing"]] == [(2, "not finished")]
    assert data["rows"][0]["psnr"] is None  # one seed of two is no mean
    with pytest.raises(AwError, match=r"another configuration \(train.iterations was 10, is 14\)"):
        measured(script, tmp_path, *given, "--report-only", "--iterations", "14")


def test_a_report_takes_the_plan_of_the_runs_and_trains_nothing(script, tmp_path, monkeypatch):
    def never(*args, **more):
        raise AssertionError("something was trained")

    scene = write_tiny_scene(tmp_path / "with")
    line = Decision(
        "affine exposure", "gains", 0.1, 0.05, "of a code", "on", "they differ", "--effects exposure"
    )
    plan = Plan("with", (line,))
    cells = plan_cells(["3dgs"], [scene], [0], TrainConfig(iterations=10), effects="auto", plan=plan)
    (done,) = run_cells(cells, tmp_path / "runs", pictures=False)
    monkeypatch.setattr(probed, "plan_with_probes", never)
    monkeypatch.setattr(script, "run_all", never)
    given = ("--report-only", "--effects", "auto", "--methods", "3dgs", "--seeds", "0", "1")
    data = measured(script, tmp_path, *given)
    # the plan is the scene's: of seed 1, too, it says what it would train with
    assert [(m["seed"], m["why"]) for m in data["missing"]] == [(1, "not finished")]
    (done.folder / "effects.json").write_text("{")
    (tmp_path / "out.md").unlink()
    data = measured(script, tmp_path, *given)
    assert data["rows"][0]["psnr"] is None
    assert {m["why"] for m in data["missing"]} == {"no run folder records a plan of effects"}


def test_results_of_other_captures_are_not_replaced(script, tmp_path):
    write_tiny_scene(tmp_path / "with")
    (tmp_path / "out.md").write_text("# Captures\n\n## mine (6 + 2 photos, no truth)\n")
    with pytest.raises(AwError, match=r"is of other captures \(mine\); choose another --results"):
        measured(script, tmp_path)


def test_the_area_under_the_curve_by_counting_pairs():
    generator = np.random.default_rng(0)
    values = generator.integers(0, 6, 60).astype(float)
    positive = generator.random(60) < 0.3
    above = values[positive][:, None] - values[~positive][None, :]
    by_pairs = float(np.mean((above > 0) + 0.5 * (above == 0)))
    with benchmark("entropy_auc") as script:
        assert script.auc(values, positive) == pytest.approx(by_pairs, abs=1e-12)
        assert script.auc(values, np.zeros(60, bool)) is None
