"""Which times may be ranked, and reference seconds from the calibrations of a run."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.result_file import read_result, write_result
from ambiguous_wild.harness.running.store import read_runs
from ambiguous_wild.harness.running.timing import (
    in_reference_seconds,
    seconds_range,
    timing_of,
    why_not_ranked,
)
from tests.harness.fake_runs import fake_result, save


def cost(verdict: str = "alone", reason: str = "", kernel: str = "cpu-1", **more: Any) -> dict[str, Any]:
    record = {"verdict": verdict, "reason": reason, "kernel": kernel}
    return {"train_s": 10.0, "reference_s": 20.0, "timing": record} | more


def test_only_runs_that_were_alone_are_ranked() -> None:
    assert timing_of(cost()).ranked and why_not_ranked([cost(), cost()]) == ""
    busy = cost("contended", "2 runs at once")
    assert not timing_of(busy).ranked
    assert why_not_ranked([cost(), busy, busy]) == "2 of 3 runs contended: 2 runs at once"
    assert timing_of({"train_s": 3.0}).verdict == "unknown"
    assert "1 of 2 runs unknown" in why_not_ranked([cost(), {"train_s": 3.0}])
    assert "cpu-1, gpu-1" in why_not_ranked([cost(), cost(kernel="gpu-1")])
    assert not timing_of(cost(reference_s=None)).ranked
    assert why_not_ranked([cost(reference_s=None)])
    assert not timing_of({"timing": {"verdict": "fast"}}).ranked


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
    save(tmp_path, result, fake_result("b"))
    assert read_result(tmp_path / "yard" / "a" / "seed0" / "metrics.json")["cost"]["timing"] == record
    frame = read_runs(tmp_path).runs.set_index("method")
    assert list(frame["timing"]) == ["contended", "unknown"]
    assert frame.loc["a", "timing_reason"] == "2 runs at once"
    assert frame.loc["a", "reference_s"] == 8.0
