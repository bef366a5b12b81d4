"""The table of a simulated suite: means by kind, the board's rows beside ours, paired differences."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats as reference

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.suites import Simulated, Suite
from ambiguous_wild.report.board import read_board
from ambiguous_wild.report.plain_formats import to_text
from ambiguous_wild.report.suite import PreparedSuite
from ambiguous_wild.report.suite_board import suite_board
from ambiguous_wild.report.table_layout import Table
from tests.report.board_runs import add, own_scene, write_run

KINDS = {"colour": ["a", "b"], "meaning": ["c"], "control": ["d"]}
TOY = Suite("toy", "Toy", KINDS, {}, 1, 100, "full", "CC0-1.0", simulated=Simulated(64, 5))
MASKS = {"iou": 0.5, "precision": 0.6, "recall": 0.7}
NOISE = {"a": 10.0, "b": 14.0, "c": 20.0, "d": 8.0}


@pytest.fixture
def prepared(tmp_path: Path) -> PreparedSuite:
    scenes = {name: own_scene(tmp_path / "scenes" / name, distractors=name != "d") for name in TOY.scenes}
    return PreparedSuite(TOY, scenes, ())


def runs_of(prepared: PreparedSuite, root: Path, method: str, *, more: float = 0.0, **settings) -> Path:
    """A run on every scene; on "d", which has no distractors, no mask score is defined."""
    for name, scene in prepared.scenes.items():
        scores = settings.get("masks")
        if scores is not None and name == "d":
            scores = {"iou": 0.0, "precision": None, "recall": None}
        elif scores is not None:
            scores = {**scores, "iou": scores["iou"] + NOISE[name] / 100}
        write_run(root, scene, method, **(settings | {"masks": scores}), noise=NOISE[name] + more)
    return root


def psnr(root: Path, method: str, seeds: tuple[int, ...] = (0,)) -> dict[str, float]:
    """Mean PSNR of each scene, from the result files."""
    found: dict[str, list[float]] = {}
    for path in sorted(root.rglob("metrics.json")):
        result = json.loads(path.read_text())
        if result["method"] == method and result["seed"] in seeds:
            found.setdefault(result["scene"], []).append(
                np.mean([row["psnr"] for row in result["per_image"]])
            )
    return {scene: float(np.mean(values)) for scene, values in found.items()}


def cells(table: Table, name: str) -> dict[str, object]:
    row = next(row for row in table.rows if row.name == name)
    return {f"{c.group} {c.measure.key}": e for c, e in zip(table.columns, row.cells)}


def test_means_are_over_scenes_of_each_kind(prepared: PreparedSuite, tmp_path: Path) -> None:
    runs = runs_of(prepared, tmp_path / "runs", "refinesplat", masks=MASKS)
    runs_of(prepared, runs, "3dgs", more=5.0)
    table, pairs = suite_board(prepared, runs)
    assert "poses by structure from motion" in table.title
    exact = psnr(runs, "refinesplat")
    found = cells(table, "refinesplat")
    for kind, scenes in {**KINDS, "all": TOY.scenes}.items():
        expected = np.mean([exact[scene] for scene in scenes])
        assert found[f"{kind} ({len(scenes)}) psnr"].value == pytest.approx(expected)
    # without a distractor there is no IoU: not of the control, and the mean over all is over the others
    assert "control (1) mask_iou" not in found
    assert found["all (4) mask_iou"].value == pytest.approx(0.5 + np.mean([0.10, 0.14, 0.20]))
    assert cells(table, "3dgs")["all (4) mask_iou"].state == "missing"
    assert found["all (4) psnr"].rank == 1
    # without a board our own runs are the references
    difference = [exact[s] - psnr(runs, "3dgs")[s] for s in TOY.scenes]
    row = next(row for row in pairs.rows if row.name == "refinesplat")
    printed = [cell.printed for cell in row.cells]
    interval = reference.t.interval(0.95, 3, np.mean(difference), reference.sem(difference))
    assert printed[0] == "3dgs" and printed[2] == f"{np.mean(difference):+.2f}"
    assert printed[3] == "[{:.2f}, {:.2f}]".format(*interval)
    assert printed[4] == "4/0/0" and printed[5] == "4"


def test_rows_of_the_board_that_compare_stand_beside_ours(prepared: PreparedSuite, tmp_path: Path) -> None:
    board, runs = tmp_path / "board", runs_of(prepared, tmp_path / "runs", "robustsplat", masks=MASKS)
    others = tmp_path / "others"
    for seed in (0, 1):
        runs_of(prepared, others / f"{seed}", "3dgs", more=3.0, seed=seed)
    runs_of(prepared, others / "long", "dronesplat", iterations=200, masks=MASKS)
    write_run(others / "one", prepared.scenes["a"], "refinesplat", masks=MASKS)
    assert add(board, others, dataset="Toy").exit_code == 0
    assert len(read_board(board)) == 13
    table, pairs = suite_board(prepared, runs, board=board)
    assert [row.name for row in table.rows] == ["robustsplat", "3dgs (board)"]
    exact = psnr(others, "3dgs")
    assert cells(table, "3dgs (board)")["all (4) psnr"].value == pytest.approx(np.mean(list(exact.values())))
    (left,) = [note for note in table.notes if note.startswith("of the board left out")]
    assert "4 runs of another setting (200 iterations)" in left and "4 runs with seed 1" in left
    assert "1 run of refinesplat, which has not all seeds on b, c, d" in left
    (row,) = pairs.rows  # 3dgs has no masks
    difference = np.mean([psnr(runs, "robustsplat")[s] - exact[s] for s in TOY.scenes])
    assert row.cells[0].printed == "3dgs (board)" and row.cells[2].printed == f"{difference:+.2f}"
    assert "3dgs (board)" in to_text([table, pairs])


def test_a_run_without_its_settings_has_its_row(prepared: PreparedSuite, tmp_path: Path) -> None:
    runs = runs_of(prepared, tmp_path / "runs", "robustsplat")
    for path in runs.rglob("config.yaml"):
        path.unlink()
    table = suite_board(prepared, runs)[0]
    assert cells(table, "robustsplat")["all (4) psnr"].state == "ok"


def test_exact_poses_are_another_dataset(prepared: PreparedSuite, tmp_path: Path) -> None:
    board, runs = tmp_path / "board", runs_of(prepared, tmp_path / "runs", "robustsplat")
    assert add(board, runs_of(prepared, tmp_path / "others", "3dgs"), dataset="Toy").exit_code == 0
    table = suite_board(replace(prepared, exact_poses=True), runs, board=board)[0]
    assert "exact poses" in table.title and [row.name for row in table.rows] == ["robustsplat"]
    assert any(note.startswith("no rows of the board: no runs in") for note in table.notes)


def test_a_method_does_not_gain_by_failing(prepared: PreparedSuite, tmp_path: Path) -> None:
    runs = runs_of(prepared, tmp_path / "runs", "robustsplat")
    runs_of(prepared, runs, "3dgs", more=5.0)
    path = next(p for p in runs.rglob("metrics.json") if json.loads(p.read_text())["scene"] == "b"
                and json.loads(p.read_text())["method"] == "robustsplat")  # fmt: skip
    result = json.loads(path.read_text()) | {"status": "failed", "error": "out of memory", "per_image": []}
    path.with_name("failed.json").write_text(json.dumps(result))
    path.unlink()
    table, pairs = suite_board(prepared, runs)
    found = cells(table, "robustsplat")
    assert found["colour (2) psnr"].state == found["all (4) psnr"].state == "failed"
    assert found["meaning (1) psnr"].state == "ok"
    assert any(note == "failed: robustsplat on b" for note in table.notes)
    assert [cell.printed for cell in pairs.rows[0].cells][2:4] == ["failed", ""]


def test_runs_of_other_scenes_of_the_same_name_are_left_out(prepared: PreparedSuite, tmp_path: Path) -> None:
    runs = runs_of(prepared, tmp_path / "runs", "robustsplat")
    other = own_scene(tmp_path / "other" / "a", distractors=False)
    write_run(runs, other, "3dgs")
    table = suite_board(prepared, runs)[0]
    assert [row.name for row in table.rows] == ["robustsplat"]
    assert "left out, of other poses, photos or size of the scene: 3dgs on a" in table.notes
    with pytest.raises(AwError, match="no finished run of toy"):
        suite_board(prepared, write_run(tmp_path / "alone", other, "3dgs"))
