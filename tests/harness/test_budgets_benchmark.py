"""benchmarks/budgets.py: sizes of a scene, distance from the best length, the mark of a busy machine."""

from pathlib import Path

from tests.benchmark_scripts import benchmark


def row(method, budget, psnr, load=0.1, width=480):
    return {
        "scene": "yard", "width": width, "method": method, "budget": budget, "psnr": psnr,
        "iterations": 100, "gaussians": 200, "load": load,
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
        rows = budgets.below_best([row("refinesplat", "60s", 25.0, load=2.0), row("3dgs", "60s", 24.0)])
        table = budgets.to_markdown({"environment": {"cores": 2}, "seed": 0, "rows": rows})
    busy, quiet = (line for line in table.splitlines() if "| 480 |" in line)
    assert "60s (!)" in busy and "(!)" not in quiet and "| 0.00 |" in busy
