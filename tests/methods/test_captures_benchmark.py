"""The benchmark over captures: its sums by hand, and the script as it is typed on a tiny scene."""

import csv
import importlib
import json
import math
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.planning import probed
from ambiguous_wild.harness.planning.decide import Decision, Plan
from ambiguous_wild.harness.running.grid import plan_cells, run_cells
from ambiguous_wild.splat.pace import TrainConfig
from tests.tiny_scene import write_tiny_scene

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def report():
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield importlib.import_module("captures_report")
    finally:
        sys.path.remove(str(BENCHMARKS))


@pytest.fixture(scope="module")
def script(report):
    return importlib.import_module("captures")


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


def test_times_are_of_the_runs_that_have_any(report):
    book = pd.DataFrame(
        [{"capture": "a", "method": "3dgs", "seed": seed, "psnr": 20.0 + seed, "train_s": time}
         for seed, time in ((0, 60.0), (1, math.nan))]
    ).reindex(columns=report.BOOK)  # fmt: skip
    (made,) = report.tabulate(book, ["a"], ["3dgs"], [0, 1])
    assert (made["psnr"], made["train_s"], made["ms_per_iteration"]) == (20.5, 60.0, None)
    (made,) = report.tabulate(book, ["a"], ["3dgs"], [0, 1, 2])  # a run is missing
    assert made["psnr"] is None and made["train_s"] is None


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


def test_the_script_trains_what_is_missing_and_tabulates(script, report, tmp_path, capsys):
    write_tiny_scene(tmp_path / "captures" / "with")
    (tmp_path / "captures" / "with" / "nested").mkdir()
    words = ["--captures", tmp_path / "captures" / "with", "--out", tmp_path / "runs"]
    words += ["--results", tmp_path / "out", "--iterations", "10", "--methods", "3dgs@mask=truth"]
    words = [str(word) for word in [*words, "--seeds", "0", "1", "--set", "truth.dilation=1"]]

    def said(*more: str) -> str:
        assert script.main([*words, *more]) == 0
        return capsys.readouterr().out

    assert "2 runs: 0 finished before, 2 to go" in said()
    data = json.loads((tmp_path / "out.json").read_text())
    (capture,) = data["captures"]
    assert len(capture.pop("sha256")) == 64
    share = pytest.approx(144 / (64 * 48))
    assert capture == {"name": "with", "train": 6, "test": 2, "distractor_share": share}
    assert data["threads"] == [1]
    (truth,) = data["rows"]
    assert truth["masked_share"] == pytest.approx(100 * 14 * 14 / (64 * 48), abs=1e-4)
    values = []
    for seed in (0, 1):
        folder = tmp_path / "runs" / "with" / "3dgs@mask=truth" / f"seed{seed}"
        images = json.loads((folder / "metrics.json").read_text())["per_image"]
        values.append(sum(image["psnr"] for image in images) / len(images))
    assert truth["psnr"] == pytest.approx(sum(values) / 2, abs=1e-5)
    assert truth["psnr_sd"] == pytest.approx(abs(values[0] - values[1]) / 2**0.5, abs=1e-5)
    rows = list(csv.DictReader((tmp_path / "out.csv").open()))
    assert [r["method"] for r in rows] == ["3dgs@mask=truth"]
    assert "| 3dgs@mask=truth |" in (tmp_path / "out.md").read_text()

    assert "2 finished before, 0 to go" in said()
    for name in ("out.json", "out.csv", "out.md"):
        assert str(tmp_path) not in (tmp_path / name).read_text()

    third = said("--report-only", "--seeds", "0", "2")
    assert "to go" not in third
    assert "- 3dgs@mask=truth on with, seed 2 (not finished)" in third
    data = json.loads((tmp_path / "out.json").read_text())
    assert [m["seed"] for m in data["missing"]] == [2]
    assert data["rows"][0]["psnr"] is None  # one seed of two is no mean

    shutil.rmtree(tmp_path / "runs")  # another machine: the book is enough
    assert "2 finished before, 0 to go" in said()
    (kept,) = json.loads((tmp_path / "out.json").read_text())["rows"]
    assert kept["psnr"] == pytest.approx(truth["psnr"], abs=1e-5)
    changed = said("--iterations", "12", "--seeds", "0")
    assert "0 finished before, 1 to go" in changed  # what was configured otherwise is no result

    with pytest.raises(AwError, match=r"another configuration \(train.iterations was 12, is 14\)"):
        script.main([*words, "--report-only", "--iterations", "14"])


@pytest.fixture
def no_training(script, monkeypatch):
    """Probes and runs are errors."""

    def never(*args, **more):
        raise AssertionError("something was trained")

    monkeypatch.setattr(probed, "plan_with_probes", never)
    monkeypatch.setattr(script, "run_all", never)


def planned_run(tmp_path: Path, decision: str = "on") -> Path:
    """A finished run of 3dgs on the scene "with", planned with that decision on exposure."""
    scene = write_tiny_scene(tmp_path / "with")
    line = Decision(
        "affine exposure", "gains", 0.1, 0.05, "of a code", decision, "they differ", "--effects exposure"
    )
    train = TrainConfig(iterations=10)
    cells = plan_cells(["3dgs"], [scene], [0], train, effects="auto", plan=Plan("with", (line,)))
    (done,) = run_cells(cells, tmp_path / "runs", pictures=False)
    assert done.outcome == "trained"
    return done.folder


def report_only(script, tmp_path: Path, *more: str) -> dict:
    words = ["--captures", tmp_path / "with", "--out", tmp_path / "runs", "--results", tmp_path / "out"]
    words += ["--iterations", "10", "--report-only", *more]
    assert script.main([str(word) for word in words]) == 0
    return json.loads((tmp_path / "out.json").read_text())


def test_a_report_takes_the_plan_of_the_runs(script, tmp_path, no_training):
    planned_run(tmp_path)
    data = report_only(script, tmp_path, "--effects", "auto", "--methods", "3dgs", "--seeds", "0")
    (row,) = data["rows"]
    assert row["psnr"] > 0 and not data["missing"]
    # the plan is the scene's: of seed 1, too, it says what it would train with
    data = report_only(script, tmp_path, "--effects", "auto", "--methods", "3dgs", "--seeds", "0", "1")
    assert [(m["seed"], m["why"]) for m in data["missing"]] == [(1, "not finished")]


def test_a_row_without_a_recorded_plan_is_missing(script, tmp_path, no_training):
    folder = planned_run(tmp_path)
    (folder / "effects.json").write_text("{")
    given = ("--methods", "3dgs", "refinesplat", "--seeds", "0")
    auto = report_only(script, tmp_path, "--effects", "auto", *given)
    assert [row["psnr"] for row in auto["rows"]] == [None, None]
    assert [m["why"] for m in auto["missing"]] == ["no run folder records a plan of effects"] * 2
    shutil.rmtree(folder)  # it had effects, which 3dgs by default has not
    with pytest.raises(AwError, match="none of these runs is in"):  # a table is not emptied
        report_only(script, tmp_path, "--effects", "default", *given)
    (tmp_path / "out.json").unlink()
    default = report_only(script, tmp_path, "--effects", "default", *given)
    assert [row["psnr"] for row in default["rows"]] == [None, None]
    assert [m["why"] for m in default["missing"]] == ["not finished", auto["missing"][1]["why"]]


def test_a_report_refuses_a_run_with_other_effects_than_planned(script, tmp_path, no_training):
    folder = planned_run(tmp_path)
    told = json.loads((folder / "effects.json").read_text())
    told["plan"]["effects"] = ["poses"]
    (folder / "effects.json").write_text(json.dumps(told))
    with pytest.raises(AwError, match="another configuration"):
        report_only(script, tmp_path, "--effects", "auto", "--methods", "3dgs", "--seeds", "0")


def test_results_of_other_captures_are_not_replaced(script, tmp_path, no_training):
    write_tiny_scene(tmp_path / "with")
    for text, message in (
        ('{"captures": [{"name": "mine"}]}', r"is of other captures \(mine\); choose another --results"),
        ("[]", "is no result of this script"),
    ):
        (tmp_path / "out.json").write_text(text)
        with pytest.raises(AwError, match=message):
            report_only(script, tmp_path)
        assert (tmp_path / "out.json").read_text() == text and not (tmp_path / "out-runs.csv").exists()


def test_a_damaged_record_is_named(report, tmp_path):
    (tmp_path / "out-runs.csv").write_text('capture,method\n"a,b\nc,d,e,f\n')
    with pytest.raises(AwError, match=r"out-runs.csv is damaged .* restore or delete it"):
        report.read_book(tmp_path / "out-runs.csv")


def test_what_trains_on_exact_masks_is_no_winner_but_the_ceiling(report):
    rows = [row("a", "3dgs", 26.0), row("a", "refinesplat", 29.0), row("a", "refinesplat@mask=truth", 31.0)]
    got = report.summarise(rows, [{"name": "a", "distractor_share": 0.2}])
    assert got["best"] == got["best_by_capture"]["a"] == "refinesplat"
    assert got["gap"]["a"] == {"gap_db": 5.0, "gained_db": 3.0, "share": 0.6}
    better = [*rows, row("a", "3dgs+truth", 32.0)]
    assert report.summarise(better, [{"name": "a", "distractor_share": 0.2}])["gap"]["a"]["gap_db"] == 6.0


def test_published_tables_follow_from_their_rows(report):
    for path in sorted((BENCHMARKS / "results").glob("*.json")):
        data = json.loads(path.read_text())
        if isinstance(data, dict) and {"rows", "captures", "summary"} <= data.keys():
            told = json.loads(json.dumps(report.summarise(data["rows"], data["captures"])))
            assert told == data["summary"], path.name
            if "psnr_supported" in data["rows"][0]:  # older tables have fewer columns
                assert path.with_suffix(".md").read_text() == report.to_markdown(data), path.name


def test_the_script_as_it_is_typed(tmp_path):
    words = [sys.executable, BENCHMARKS / "captures.py", "--captures", tmp_path, "--out", tmp_path / "runs"]
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True)
    assert done.returncode == 2 and "is no scene folder" in done.stderr
    assert done.stderr.count("\n") == 1
