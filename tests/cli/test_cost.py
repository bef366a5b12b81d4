"""`aw cost`, and the runs of several lengths that it reads."""

from __future__ import annotations

import json
from pathlib import Path

from ambiguous_wild.harness.grid import cell_folder, expand_budgets, plan_cells
from ambiguous_wild.splat.train_config import TrainConfig
from tests.command_line import aw
from tests.report.fake_cost import cost_run
from tests.tiny_scene import write_tiny_scene


def test_tables_on_standard_output_and_files_beside(tmp_path: Path) -> None:
    runs = tmp_path / "my runs"
    cost_run(runs, "a", psnr=(20.0,), train_s=300.0, probes=[(100.0, 15.0), (200.0, 19.0)])
    out = tmp_path / "out"
    words = ("cost", runs, "--target", "17", "-o", out)
    done = aw(*words)
    assert done.returncode == 0, done.stderr
    assert "minutes of training to reach a test PSNR (yard)" in done.stdout and "2.50" in done.stdout
    assert f"command: aw cost '{runs}' -o {out} --target 17" in done.stdout
    tables = [p.name for p in sorted(out.iterdir()) if p.suffix not in (".svg", ".png")]
    assert tables == ["cost.csv", "cost.json", "time-to-psnr.csv", "timelines.csv"] and any(out.glob("*.svg"))
    assert json.loads(aw(*words, "--json").stdout) == json.loads((out / "cost.json").read_text())


def test_several_lengths_and_effects_have_folders_of_their_own(tmp_path: Path) -> None:
    scene = write_tiny_scene(tmp_path / "scene")
    planned = {
        effects: plan_cells(["3dgs"], [scene], [0], TrainConfig(), effects=effects)
        for effects in ("none", "exposure, poses")
    }
    cells = expand_budgets(planned, [180.0, 60.0, 60.0])
    folders = [str(cell_folder(Path("o"), cell)) for cell in cells]
    assert folders == [
        f"o/budget-{b}s/effects-{e}/scene/3dgs/seed0" for b in (60, 180) for e in ("none", "exposure+poses")
    ]
    assert len({cell.identity for cell in cells}) == 4
    (alone,) = expand_budgets({"none": planned["none"]}, [60.0])
    assert cell_folder(Path("o"), alone) == Path("o/scene/3dgs/seed0")
    assert alone.identity == cells[0].identity  # where a run lies is not what it is
    assert expand_budgets({"none": planned["none"]}) == planned["none"]
