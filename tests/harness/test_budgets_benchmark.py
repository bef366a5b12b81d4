"""benchmarks/budgets.py: sizes of a scene, distance from the best length, the mark of a busy machine."""

import json
import math
from pathlib import Path

import pytest

from ambiguous_wild.io.scene_folder import load_scene
from tests.benchmark_scripts import benchmark
from tests.tiny_scene import write_tiny_scene


def row(method, budget, psnr, busy=0.1, width=480):
    return {
        "scene": "yard", "width": width, "method": method, "budget": budget, "psnr": psnr,
        "iterations": 100, "gaussians": 200, "busy_cores": busy,
    }  # fmt: skip


def test_a_folder_and_one_of_its_sizes():
    with benchmark("budgets") as budgets:
        assert budgets.place_of("scenes/yard@2") == (Path("scenes/yard"), 2)
        assert budgets.place_of("scenes/yard") == (Path("scenes/yard"), None)
        assert budgets.place_of("scenes/@yard") == (Path("scenes/@yard"), None)


def test_below_our_best_on_the_same_photos():
    with benchmark("budgets") as budgets:
        rows = [
            row("refinesplat", "60s", 25.0),
            row("refinesplat", "180s", 25.5),
            row("refinesplat", "60s", 30.0, width=240),
            row("3dgs", "60s", 31.0),
        ]
        found = budgets.below_best(rows)
    assert [r["below"] for r in found] == [0.5, 0.0, 0.0, None]


def test_a_row_of_a_busy_machine_is_marked():
    with benchmark("budgets") as budgets:
        rows = budgets.below_best([row("refinesplat", "60s", 25.0, busy=2.0), row("3dgs", "60s", 24.0)])
        table = budgets.to_markdown({"environment": {"cores": 2}, "seed": 0, "rows": rows})
    busy, quiet = (line for line in table.splitlines() if "| 480 |" in line)
    assert "60s (!)" in busy and "(!)" not in quiet and "| 0.00 |" in busy


def test_rows_of_earlier_results_are_marked_as_they_were():
    rows = [row("3dgs", f"{k}s", 25.0) | {"below": None} for k in (1, 2, 3)]
    for line, load in zip(rows, (0.49, 1.01, None)):
        del line["busy_cores"]
        line["load"] = load
    with benchmark("budgets") as budgets:
        table = budgets.to_markdown({"environment": {"cores": 2}, "seed": 0, "rows": rows})
    assert "| 1s |" in table and "| 2s (!) |" in table and "| 3s (!) |" in table


def test_a_run_has_busy_cores_and_an_earlier_one_its_load(tmp_path, monkeypatch):
    scene = load_scene(write_tiny_scene(tmp_path / "yard"))
    result = {
        "status": "ok",
        "per_image": [{"psnr": 20.0}, {"psnr": 22.0}],
        "cost": {"iterations": 9, "gaussians": 8},
    }
    folder = tmp_path / "run"
    folder.mkdir()
    with benchmark("budgets") as budgets:
        monkeypatch.setattr(budgets, "read_result", lambda path: json.loads(path.read_text()))
        (folder / budgets.RESULT).write_text(json.dumps(result))

        def found() -> dict:
            made = budgets.row_of(folder, "3dgs", "60s", scene)
            assert made["psnr"] == 21.0
            return {key: made[key] for key in ("busy_cores", "load") if key in made}

        assert found() == {"busy_cores": None}
        (folder / "load.txt").write_text("0.49\n")
        assert found() == {"busy_cores": None, "load": 0.49}
        (folder / "busy-cores.txt").write_text("0.02\n")
        assert found() == {"busy_cores": 0.02}


# user nice system idle iowait irq softirq steal guest guest_nice; a guest's time is part of the user's
BEFORE = "cpu  100 0 50 800 40 5 5 0 100 0\ncpu0 1 2 3\n"
AFTER = "cpu  220 0 60 1050 60 5 5 0 220 0\ncpu0 1 2 3\n"  # 400 more ticks, 270 of them without work


@pytest.fixture
def stat(tmp_path, monkeypatch):
    """Time goes on by `AFTER`; four cores."""
    path = tmp_path / "stat"
    path.write_text(BEFORE)
    with benchmark("budgets") as budgets:
        monkeypatch.setattr(budgets, "STAT", path)
        monkeypatch.setattr(budgets.os, "cpu_count", lambda: 4)
        monkeypatch.setattr(budgets.time, "sleep", lambda seconds: path.write_text(AFTER))
        yield budgets


def test_busy_cores_by_hand(stat):
    assert stat.busy_cores() == pytest.approx(4 * 130 / 400)


def test_busy_cores_are_unknown_where_the_system_does_not_tell(stat, monkeypatch, tmp_path):
    monkeypatch.setattr(stat, "STAT", tmp_path / "none")
    assert stat.busy_cores() is None and stat.once_quiet() is None


def test_a_run_waits_for_a_quiet_machine_but_not_for_ever(stat, monkeypatch):
    seen = iter((1.9, 0.8, 0.123, 1.9))
    monkeypatch.setattr(stat, "busy_cores", lambda: next(seen))
    assert stat.once_quiet() == 0.12
    assert stat.once_quiet(patience_s=-math.inf) == 1.9
