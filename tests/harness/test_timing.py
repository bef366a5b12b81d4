"""Which times may be ranked, and reference seconds from the calibrations of a run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.result_file import read_result, write_result
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.harness.timing import (
    in_reference_seconds,
    seconds_range,
    timing_of,
)
from ambiguous_wild.report.comparison import comparison
from ambiguous_wild.report.comparison import table as table_of
from ambiguous_wild.report.plain_formats import to_text
from tests.harness.fake_runs import fake_result, save


def cost(verdict: str = "alone", reason: str = "", kernel: str = "cpu-1", **more: Any) -> dict[str, Any]:
    record = {"verdict": verdict, "reason": reason, "kernel": kernel}
    return {"train_s": 10.0, "reference_s": 20.0, "timing": record} | more


def test_the_verdict_of_a_record_and_unknown_without_one() -> None:
    busy = timing_of(cost("contended", "2 runs at once"))
    assert (busy.verdict, busy.reason, busy.kernel, busy.reference_s) == (
        "contended", "2 runs at once", "cpu-1", 20.0
    )  # fmt: skip
    assert timing_of({"train_s": 3.0}).verdict == "unknown"
    assert math.isnan(timing_of(cost(reference_s=None)).reference_s)
    assert timing_of({"timing": {"verdict": "fast"}}).verdict == "unknown"


def test_a_range_says_how_far_times_lie_apart() -> None:
    assert seconds_range([129.2, 230.4, math.nan, 168.0]) == "129 to 230"
    assert seconds_range([9.96, 10.04], 1) == "10.0" and seconds_range([]) == ""


def test_reference_seconds_of_a_steady_machine_are_a_ratio() -> None:
    samples = [[0.0, 0.5], [10.0, 0.5], [30.0, 0.5]]
    np.testing.assert_allclose(in_reference_seconds(samples, 0.25, [0.0, 5.0, 30.0, 40.0]), [0, 2.5, 15, 20])
    assert np.isnan(in_reference_seconds([], 0.25, [1.0])).all()


def test_reference_seconds_follow_a_load_that_comes_and_goes() -> None:
    # alone for 20 s of work, then half as fast for as much work: the kernel is half as fast too
    samples = [[0.0, 0.3], [20.0, 0.3], [20.001, 0.6], [60.0, 0.6]]
    found = in_reference_seconds(samples, 0.3, [20.0, 60.0])
    np.testing.assert_allclose(found, [20.0, 40.0], rtol=1e-3)


def test_reference_seconds_before_the_first_sample_and_in_between() -> None:
    found = in_reference_seconds([[10.0, 0.5], [20.0, 0.25]], 0.5, [5.0, 10.0, 15.0, 20.0, 22.0])
    np.testing.assert_allclose(found, [5.0, 10.0, 17.5, 25.0, 29.0])


@pytest.mark.parametrize(
    "record",
    [
        "alone",
        {"verdict": "fast", "reason": ""},
        {"verdict": "alone"},
        {"verdict": "alone", "reason": "", "samples": [[1.0]]},
        {"verdict": "alone", "reason": "", "samples": [[0.0, 0.0]]},
        {"verdict": "alone", "reason": "", "samples": [[0.0, "x"]]},
        {"verdict": "alone", "reason": "", "others": -1.0},
        {"verdict": "alone", "reason": "", "kernel": 1},
    ],
)
def test_a_damaged_record_is_one_line(tmp_path: Path, record: Any) -> None:
    result = fake_result("a")
    result["cost"]["timing"] = record
    with pytest.raises(AwError, match=r"cost\.timing"):
        write_result(tmp_path / "metrics.json", result)


def test_a_record_survives_the_file_and_stands_in_the_table_of_runs(tmp_path: Path) -> None:
    result = fake_result("a")
    record = {"verdict": "contended", "reason": "2 runs at once", "kernel": "cpu-1", "samples": [[0.0, 0.3]]}
    result["cost"] |= {"timing": record, "reference_s": 8.0}
    early = fake_result("b")
    del early["cost"]["timing"]
    save(tmp_path, result, early)
    assert read_result(tmp_path / "yard" / "a" / "seed0" / "metrics.json")["cost"]["timing"] == record
    frame = read_runs(tmp_path).runs.set_index("method")
    assert list(frame["timing"]) == ["contended", "unknown"]
    assert frame.loc["a", "timing_reason"] == "2 runs at once"
    assert frame.loc["a", "reference_s"] == 8.0


def test_tables_rank_only_times_that_compare(tmp_path: Path) -> None:
    runs = [fake_result(m, seed=s) for m in ("a", "b", "c") for s in (0, 1)]
    for k, run in enumerate(runs):
        run["cost"] |= {"train_s": 10.0 + k, "reference_s": 5.0 + k, "fps": 30.0 + k}
    runs[-1]["cost"]["timing"] = {"verdict": "contended", "reason": "2 runs at once", "kernel": "cpu-1"}
    table = comparison(
        read_runs(save(tmp_path, *runs)), metrics=["psnr", "train_s", "reference_s", "gaussians"]
    )
    rows = {row.name: row.cells for row in table[0].rows}
    assert [rows[m][1].rank for m in "abc"] == [1, 2, None]
    assert [rows[m][2].rank for m in "abc"] == [1, 2, None]
    text = to_text(table)
    assert "14.0 to 15.0" in text and "9.0 to 10.0" in text
    assert "times not ranked: c on yard (contended: 2 runs at once)" in text
    assert "times not ranked" not in str(table_of(tmp_path, metrics="psnr"))


def test_times_of_other_machines_are_ranked_by_reference_seconds(tmp_path: Path) -> None:
    runs = [fake_result(m) for m in ("a", "b")]
    for k, run in enumerate(runs):
        run["environment"] = {"cpu": f"CPU {k}", "packages": {}}
        run["cost"] |= {"train_s": 10.0 + k, "reference_s": 9.0 - k}
    table = comparison(read_runs(save(tmp_path, *runs)), metrics=["train_s", "reference_s"])
    ranks = [[cell.rank for cell in row.cells] for row in table[0].rows]
    assert ranks == [[None, 2], [None, 1]]
    assert any("CPU 0, 2 threads, CPU 1, 2 threads" in note for note in table[-1].notes)
    runs[1]["cost"]["timing"]["kernel"] = "gpu-1"
    table = comparison(read_runs(save(tmp_path, *runs)), metrics=["reference_s"])
    assert [row.cells[0].rank for row in table[0].rows] == [None, None]


def test_the_mean_over_scenes_is_a_range_where_one_scene_is(tmp_path: Path) -> None:
    runs = [fake_result(m, scene) for m in ("a", "b") for scene in ("one", "two")]
    runs[0]["cost"] |= {"train_s": 30.0, "timing": {"verdict": "unknown", "reason": "not measured"}}
    table = comparison(read_runs(save(tmp_path, *runs)), metrics=["train_s"])
    mean = {row.name: row.cells[0] for row in table[0].rows}
    assert mean["a"].ranged and (mean["a"].low, mean["a"].high) == (20.0, 20.0)
    assert mean["b"].rank is None and not mean["b"].ranged  # alone in its column: nothing to rank
