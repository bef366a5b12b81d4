"""Whole tables from folders of scenes in their published layouts."""

import re
import shutil

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.suites import differences, find_scenes, get_suite, scene_id, suites
from ambiguous_wild.io.scene_folder import read_scene_json
from ambiguous_wild.report import suite as suite_module
from ambiguous_wild.report.papers import read_reported
from ambiguous_wild.report.suite import prepare_suite, scene_facts, suite_methods, suite_tables
from ambiguous_wild.simulate.presets import PRESETS
from tests.command_line import aw
from tests.datasets import layouts

# Large enough to be measured at factor 8.
SIZE = {"WIDTH": 160, "HEIGHT": 128, "FX": 170.0, "FY": 171.0, "CX": 79.5, "CY": 64.5}
SUITES = {
    "ambiguous-wild": (layouts.robustnerf, ["Humanoid", "porter", "Wood"]),
    "on-the-go": (layouts.on_the_go, ["mountain", "patio_high"]),
    "robustnerf": (layouts.robustnerf, ["android3", "crab2"]),
    "photo-tourism": (layouts.phototourism, ["brandenburg_gate", "trevi-fountain"]),
    "drone": (layouts.drone, ["Simingshan", "Sculpture"]),
}


@pytest.fixture
def large(monkeypatch):
    for name, value in SIZE.items():
        monkeypatch.setattr(layouts, name, value)


@pytest.mark.parametrize("name", SUITES)
def test_a_suite_end_to_end(name, large, tmp_path):
    make, folders = SUITES[name]
    for folder in folders:
        make(tmp_path / "root" / folder)
    words = ["bench", "--suite", name, "--scene", tmp_path / "root", "--method", "3dgs", "--iterations", "10"]
    done = aw(*words, "-o", tmp_path / "runs", "--set", "train.probes=0", "--no-pictures", "--threads", "1")
    assert done.returncode == 0, done.stderr
    suite = get_suite(name)
    assert done.stdout.count(suite.dataset) >= 1
    rows = done.stdout.splitlines()
    assert any(line.startswith("3dgs ") for line in rows)
    if name != "robustnerf":  # no table of the paper has it
        assert "reported: printed in a paper, not measured here" in done.stdout
        assert any(line.startswith("  RefineSplat ") for line in rows)
    # the protocol and factor of the papers, without an option
    config = next((tmp_path / "runs").rglob("config.yaml")).read_text()
    assert ("protocol: half" in config) == (suite.protocol == "half")
    info = read_scene_json(next((tmp_path / "runs" / ".scenes").iterdir()))
    assert info["dataset"] == suite.dataset
    assert info["factor"] == (suite.factor or 8)
    missing = [s for s in suite.scenes if scene_id(s) not in {p.name for p in (tmp_path / "runs").iterdir()}]
    assert (f"scenes not found: {', '.join(missing)}" in done.stdout) == bool(missing)
    again = aw(*words, "-o", tmp_path / "runs", "--set", "train.probes=0", "--no-pictures", "--threads", "1")
    assert again.returncode == 0 and "imported" not in again.stderr


def test_reported_numbers_stand_in_their_own_rows(large, tmp_path):
    """Every number of our row is measured here, and every reported one is printed as in its table."""
    layouts.drone(tmp_path / "root" / "SimingShan")
    prepared = prepare_suite(get_suite("drone"), tmp_path / "root", tmp_path / "runs")
    done = aw(
        "bench", "--method", "3dgs", "--scene", prepared.scenes["simingshan"], "--iterations", "5",
        "-o", tmp_path / "runs", "--set", "train.probes=0", "--no-pictures", "--threads", "1",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (table,) = suite_tables(prepared, tmp_path / "runs")
    measured = [row for row in table.rows if row.kind == "measured"]
    reported = [row for row in table.rows if row.kind == "reported"]
    assert [row.name for row in measured] == ["3dgs"]
    assert all(not e.printed for row in measured for e in row.cells)
    assert all(e.printed or e.state == "blank" for row in reported for e in row.cells)
    numbers = [n for n in read_reported() if n.dataset == "Drone Imagery" and n.scene == "SimingShan"]
    printed = {(n.method, n.metric): n.text for n in numbers if not n.setting}
    famous = next(row for row in reported if row.name == "RefineSplat")
    psnr = next(i for i, c in enumerate(table.columns) if c.scene and c.measure.key == "psnr")
    assert famous.cells[psnr].printed == printed["RefineSplat", "psnr"]
    # One scene of two: the papers' mean over both would mislead.
    assert all(not e.printed for row in reported for c, e in zip(table.columns, row.cells) if not c.scene)


def test_scenes_are_found_in_any_spelling(tmp_path):
    suite = get_suite("on-the-go")
    for name in ("Patio-High", "nested/spot"):
        (tmp_path / name / "sparse").mkdir(parents=True)
    (tmp_path / "corner").mkdir()  # photos of a scene, no scene
    found, absent = find_scenes(suite, tmp_path)
    assert {k: v.relative_to(tmp_path).as_posix() for k, v in found.items()} == {
        "Patio-High": "Patio-High",
        "Spot": "nested/spot",
    }
    assert absent == ["Mountain", "Fountain", "Corner", "Patio"]
    (tmp_path / "patio_high" / "sparse").mkdir(parents=True)
    with pytest.raises(AwError, match="2 folders of the scene Patio-High"):
        find_scenes(suite, tmp_path)
    with pytest.raises(AwError, match="has no scene of drone"):
        find_scenes(get_suite("drone"), tmp_path)


def test_the_registry_has_the_papers_scenes():
    wild = get_suite("ambiguous-wild")
    assert len(wild.scenes) == 18 and wild.factor == 8 and (wild.width, wild.height) == (1920, 1080)
    reported = {(n.dataset, n.scene) for n in read_reported() if n.known}
    for suite in suites().values():
        if suite.name != "robustnerf" and suite.simulated is None:
            assert all((suite.dataset, scene) in reported for scene in suite.scenes)
    assert {"3dgs", "refinesplat", "robustsplat", "dronesplat", "wildgaussians"} <= set(suite_methods(wild))
    assert suite_methods(get_suite("robustnerf")) == ["3dgs", "refinesplat"]


def test_a_copy_is_compared_with_the_registry():
    wild = get_suite("ambiguous-wild")
    assert differences(wild, "Stone", [(1920, 1080), (1078, 1900)], 8) == []
    found = differences(wild, "stones", [(1280, 720)], 4)
    assert len(found) == 3
    assert "no scene 'stones'" in found[0] and "factor 4" in found[1] and "1280x720" in found[2]


def test_a_scene_under_another_name_is_refused(large, tmp_path):
    scene = tmp_path / "root" / "Sculpture"
    aw("import", layouts.drone(tmp_path / "raw"), "-o", tmp_path / "other")
    shutil.copytree(tmp_path / "other", scene)
    with pytest.raises(AwError, match="is the scene 'other'"):
        prepare_suite(get_suite("drone"), tmp_path / "root", tmp_path / "runs")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--suite", "on-the-go"], "--scene DIR"),
        (["--suite", "on-the-go", "--scene", "absent"], "is no folder"),
        (["--suite", "on-the-run", "--scene", "."], "'on-the-run'"),
        (["--suite", "on-the-go", "--scene", ".", "--scene", "x"], "--scene DIR once"),
        (["--scene", "x"], "--method is missing"),
        (["--method", "3dgs"], "--scene is missing"),
    ],
)
def test_mistakes_are_one_line(words, message, tmp_path):
    done = aw("bench", *words, "-o", tmp_path / "runs", cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr and done.stderr.count("\n") == 1
    assert not re.search("Traceback", done.stderr) and not (tmp_path / "runs").exists()


def test_what_is_known_of_the_scenes_of_a_simulated_suite(monkeypatch):
    measured = {
        scene: {"occlusion": share, "class": "both"}
        for scene, share in {"coats": 0.149, "greys": 0.15, "marble": 0.299, "crowd": 0.3, "still": 0}.items()
    }
    monkeypatch.setattr(suite_module, "measured_ambiguity", lambda: measured)
    found = scene_facts({"aw-sim", "On-the-go", "Tiny"})
    assert found.keys() == {"aw-sim"} and scene_facts({"Tiny"}) == {}
    facts, tables = found["aw-sim"], get_suite("aw-sim").tables
    assert {kind: [s for s in facts if facts[s]["ambiguity"] == kind] for kind in tables} == tables
    assert all(facts[scene]["place"] == PRESETS[scene].world.place for scene in facts)
    assert {s: (f["occlusion"], f["covered"]) for s, f in facts.items() if s in measured} == {
        "coats": ("below 15%", 15),
        "greys": ("below 30%", 15),
        "marble": ("below 30%", 30),
        "crowd": ("30% and more", 30),
        "still": ("below 15%", 0),
    }
    assert {f["verdict"] for s, f in facts.items() if s in measured} == {"both"}
    assert {scene for scene in facts if facts[scene]["half"]} == {"coats", "bonnet", "noon"}
    rest = [f for s, f in facts.items() if s not in measured]
    assert {(f["occlusion"], f["covered"], f["verdict"]) for f in rest} == {
        ("not measured", None, "not measured")
    }
