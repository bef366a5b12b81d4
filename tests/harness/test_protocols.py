"""What is fitted to test photos stands in the result and below every table that holds such runs."""

import json
from pathlib import Path

import pandas as pd
import pytest

from ambiguous_wild import bench
from ambiguous_wild.harness.ablation_study import plan_study
from ambiguous_wild.harness.store import Runs, read_runs
from ambiguous_wild.report.comparison import comparison
from ambiguous_wild.report.notes import _fitted
from ambiguous_wild.splat.train_config import TrainConfig

SMALL = ("gs-w.side=16", "gs-w.width=2", "wildgaussians.width=8")


@pytest.fixture(scope="module")
def report(scene, tmp_path_factory):
    made = bench(
        ["3dgs", "gs-w", "wildgaussians"], scene, output=tmp_path_factory.mktemp("runs"), iterations=20,
        protocol="half", settings=SMALL, device="cpu", pictures=False,
    )  # fmt: skip
    assert not made.failed, [run.error for run in made.failed]
    return made


def test_a_result_says_what_was_fitted_and_for_how_many_steps(report):
    facts = {run.method: run.result["facts"] for run in report.runs}
    assert {f["protocol"] for f in facts.values()} == {"half"}
    assert facts["3dgs"]["fitted"] == {"effects": [], "steps": 0}
    assert facts["wildgaussians"]["fitted"] == {"effects": ["wildgaussians"], "steps": 128}
    assert facts["gs-w"]["fitted"] == {"effects": [], "steps": 0, "read_by": ["gs-w"]}


def test_a_table_never_shows_them_together_without_saying_so(report):
    notes = [note for note in comparison(report.read())[-1].notes if note.startswith("test photos")]
    assert len(notes) == 3
    assert "wildgaussians: colours fitted on the left half" in notes[0]
    assert "gs-w: colours read from the left half" in notes[1]
    assert "3dgs: nothing fitted" in notes[2]


def test_results_of_before_are_not_taken_for_plain_ones(report, tmp_path):
    folder = Path(tmp_path, "old")
    for run in report.runs[:2]:
        target = folder / run.folder.relative_to(report.output)
        target.mkdir(parents=True)
        result = json.loads((run.folder / "metrics.json").read_text())
        result["facts"].pop("fitted")
        (target / "metrics.json").write_text(json.dumps(result))
    assert set(read_runs(folder).runs["fit"]) == {"unknown"}
    assert "not recorded" in " ".join(comparison(read_runs(folder))[-1].notes)


def test_whole_photos_need_no_note_and_scenes_are_named_where_protocols_differ():
    row = {"status": "ok", "method": "3dgs", "fit": "full", "scene": "yard"}
    frame = pd.DataFrame([row])
    assert _fitted(Runs(pd.DataFrame(), frame, pd.DataFrame())) == []
    both = pd.DataFrame([row, row | {"fit": "plain", "scene": "coats"}])
    coats, yard = _fitted(Runs(pd.DataFrame(), both, pd.DataFrame()))
    assert coats == "test photos of coats: 3dgs: nothing fitted, the right half measured"
    assert yard == "test photos of yard: 3dgs: whole test photos measured, nothing fitted"


@pytest.mark.parametrize(("method", "group"), [("gs-w", "plug-in"), ("wildgaussians", "plug-in")])
def test_the_plug_in_table_has_a_row_a_threshold(scene, method, group):
    study = plan_study(method, [scene], [0], TrainConfig(iterations=5), groups=[group])
    rows = {row.variant.name: row for row in study.rows}
    assert set(rows) == {"default", "m-final", "t-hard", "t-statistics", "t-ent"}
    assert not any(row.missing for row in rows.values())
    assert rows["m-final"].cells[0].method.name == f"{method}@mask=refinesplat"
    thresholds = {
        name: row.cells[0].options.mask.mask.threshold for name, row in rows.items() if name != "default"
    }
    assert [thresholds[n] for n in ("t-hard", "t-statistics", "t-ent")] == ["hard", "statistics", "kapur"]
    names = [row.cells[0].method.name for row in rows.values()]
    assert len(set(names)) == 5 and len({row.cells[0].identity for row in rows.values()}) == 5


def test_the_density_table_puts_other_density_controls_in_refinesplat(scene):
    study = plan_study("refinesplat", [scene], [0], TrainConfig(iterations=5), groups=["density-control"])
    built = [row.cells[0].method.build(row.cells[0].options) for row in study.rows]
    assert [parts.density.__name__ for parts in built[1:]] == ["PupDensity", "UncertaintyAwareDensity"]
    assert type(built[1].mask) is type(built[0].mask)
