"""Disk full: run again, and it ends with the same files.

Kills are in tests/builder/test_killed.py (stages of build-scene) and tests/faults/test_killed_at_random.py.
"""

import json

import pytest

from ambiguous_wild.builder.workspace import Workspace
from ambiguous_wild.harness.grid import cell_folder, plan_cells, run_cells
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.images import write_png
from ambiguous_wild.splat.train_config import TrainConfig
from tests.faults.compare import half_written, state
from tests.faults.small_disks import grow, small_disk

SHORT = TrainConfig(iterations=40, probes=0, checkpoint_every_s=0.1)


def bench(scene, output):
    cells = plan_cells(["3dgs"], [scene], [0], SHORT)
    (report,) = run_cells(cells, output)
    return report, cell_folder(output, cells[0])


def test_a_bench_on_a_full_disk_says_so_and_with_room_ends_with_the_same_files(scene, tmp_path):
    reference, folder = bench(scene, tmp_path / "undisturbed")
    assert reference.outcome == "trained", reference.error
    expected = state(folder)
    with small_disk(tmp_path / "disk", 200) as disk:  # a checkpoint of this scene has over 300 kB
        report, run = bench(scene, disk / "runs")
        assert report.outcome == "failed"
        assert "No space left on device; free space" in report.error and "\n" not in report.error
        assert half_written(disk) == []
        grow(disk, 20_000)
        report, run = bench(scene, disk / "runs")
        assert report.outcome == "trained", report.error
        assert state(run) == expected


def test_a_file_that_does_not_fit_leaves_the_old_one(tmp_path):
    with small_disk(tmp_path / "disk", 64) as disk:
        write_json(disk / "a.json", {"old": True})
        with pytest.raises(OSError, match="No space left"):
            write_json(disk / "a.json", ["x" * 100] * 1000)
        assert json.loads((disk / "a.json").read_text()) == {"old": True}
        assert [p.name for p in disk.iterdir()] == ["a.json"]


def test_a_stage_that_does_not_fit_is_absent_and_with_room_is_made(tmp_path):
    import numpy as np

    noise = np.random.default_rng(0).integers(0, 256, (100, 100, 3), dtype=np.uint8)

    def work(folder):
        for i in range(4):
            write_png(folder / f"{i}.png", noise)
        return {"photos": 4}

    with small_disk(tmp_path / "disk", 80) as disk:
        with pytest.raises(OSError, match="No space left"):
            Workspace(disk / "work").run("downsample", [1], work)
        assert list((disk / "work").iterdir()) == []
        grow(disk, 1000)
        result = Workspace(disk / "work").run("downsample", [1], work)
        assert not result.reused
        assert result.facts == {"photos": 4}
        assert half_written(disk) == []
