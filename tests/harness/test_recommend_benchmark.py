"""The benchmark of recommendations: choices for captures held back, and over all pairs."""

import json
from pathlib import Path

import pytest

from ambiguous_wild.core import AwError
from tests.benchmark_scripts import benchmark
from tests.harness.fake_cost import cost_run


@pytest.fixture
def recommend():
    with benchmark("recommend") as module:
        yield module


def test_choices_are_judged_by_what_was_held_back(recommend, tmp_path: Path, capsys) -> None:
    """`a` is the better setting everywhere but on one capture, where it is 1 dB behind."""
    for k, scene in enumerate(("one", "two", "three", "odd")):
        better = 3.0 if scene != "odd" else -1.0
        for method, psnr in (("a", 20.0 + k + better), ("b", 20.0 + k)):
            cost_run(tmp_path / "runs", method, scene, psnr=(psnr,), train_s=10.0, budget_s=10.0)
    results = tmp_path / "found.json"
    given = [str(tmp_path / "runs"), "--budgets", "10", "--results", str(results)]
    assert recommend.main([*given, "--held-back", "two", "odd"]) == 0
    found = json.loads(results.read_text())
    (row,) = found["budgets"]
    assert {name: choice["setting"] for name, choice in row["held_back"].items()} == {"two": "a", "odd": "a"}
    assert row["held_back"]["two"]["behind_db"] == 0.0
    assert row["held_back"]["odd"]["behind_db"] == pytest.approx(1.0) == row["worst_db"]
    assert row["pairs"] == 6 and row["share_within"] == pytest.approx(9 / 12)  # "odd" is in three pairs
    assert found["runs"] == 8 and found["contended"] == 0 and "two: a, 0.00 dB" in capsys.readouterr().out
    with pytest.raises(AwError):
        recommend.main([*given, "--held-back", "absent"])
