"""Suites that are simulated here: what is missing is made, what is there is checked, other files stay."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.capture_hashes import capture_hash
from ambiguous_wild.datasets.suites import Simulated, Suite, get_suite, suites
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.io.scene_folder import read_scene_json
from ambiguous_wild.report.simulated_suite import make_captures, prepare_simulated
from ambiguous_wild.simulate import capture_writer
from ambiguous_wild.simulate.presets import PRESETS, preset, resized
from tests.command_line import aw
from tests.shared import made_once

WIDTH = 240
NAMES = ["toy-a", "toy-b"]
TOY = Suite(
    "aw-sim-mini", "toy", {"colour": ["toy-a"], "meaning": ["toy-b"]}, {}, 2, 5, "full", "CC0-1.0",
    simulated=Simulated(WIDTH, 5),
)  # fmt: skip
TRAIN = ("--set", "train.probes=0", "--no-pictures", "--threads", "1", "--effects", "none")


def add_presets(patch: pytest.MonkeyPatch) -> None:
    for number, name in enumerate(NAMES):
        spec = resized(preset("tiny"), 6, WIDTH)
        patch.setitem(PRESETS, name, replace(spec, name=name, train_views=6 + number, detail_px_per_m=40.0))


@pytest.fixture(autouse=True)
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """A suite of two tiny captures, under the name of one of ours."""
    add_presets(monkeypatch)
    monkeypatch.setitem(suites(), TOY.name, TOY)


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with captures and scenes with exact poses, to be copied."""

    def make(root: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            add_presets(patch)
            prepare_simulated(TOY, root / "toy", exact_poses=True)

    return made_once(tmp_path_factory, "simulated-suite", make) / "toy"


@pytest.fixture
def root(shared: Path, tmp_path: Path) -> Path:
    return shutil.copytree(shared, tmp_path / "toy")


def test_an_interrupted_call_goes_on_with_the_next_capture(tmp_path: Path, monkeypatch, shared: Path) -> None:
    original, calls = capture_writer.simulate, []

    def interrupted(spec, *args, **kwargs):
        calls.append(spec.name)
        if spec.name == "toy-b" and calls.count("toy-b") == 1:
            raise KeyboardInterrupt
        return original(spec, *args, **kwargs)

    monkeypatch.setattr(capture_writer, "simulate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        make_captures(TOY, tmp_path / "toy")
    assert [p.name for p in (tmp_path / "toy" / "captures").iterdir()] == ["toy-a"]
    lines: list[str] = []
    found = make_captures(TOY, tmp_path / "toy", say=lines.append)
    assert calls == ["toy-a", "toy-b", "toy-b"] and [c.name for c in found] == NAMES
    assert lines == ["no hash is listed for toy-a, toy-b: whether all have the same is unknown"]
    for capture in found:  # the same, whoever makes it
        assert capture.sha256 == capture_hash(shared / "captures" / capture.name)
        assert (tmp_path / "toy" / "captures" / capture.name / "truth" / "sheet.jpg").is_file()


def test_what_is_there_is_kept_and_checked(root: Path) -> None:
    before = {p: p.stat().st_mtime_ns for p in root.rglob("*") if p.is_file()}
    prepared = prepare_simulated(TOY, root, exact_poses=True)
    assert prepared.scenes == {name: root / "scenes-truth" / name for name in NAMES} and prepared.exact_poses
    assert {p: p.stat().st_mtime_ns for p in root.rglob("*") if p.is_file()} == before
    info = read_scene_json(prepared.scenes["toy-a"])
    assert info is not None and info["factor"] == 2 and dict(info)["license"] == "CC0-1.0"


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda r: (r / "captures/toy-b/train/IMG_0001.jpg").write_bytes(b"x"), "toy-b is damaged"),
        (lambda r: (r / "scenes-truth/toy-a/map.png").write_bytes(b"x"), "toy-a is damaged, or was built"),
        (
            lambda r: shutil.copytree(r / "captures/toy-a", r / "captures/toy-b", dirs_exist_ok=True),
            "preset toy-a, not toy-b",
        ),
    ],
)
def test_what_is_damaged_is_one_line(spoil, message: str, root: Path) -> None:
    spoil(root)
    with pytest.raises(AwError, match=message) as error:
        prepare_simulated(TOY, root, exact_poses=True)
    assert "\n" not in str(error.value) and "--overwrite" not in str(error.value)


def test_an_earlier_preset_is_noticed(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "toy-a", replace(preset("toy-a"), focal_35mm=30.0))
    with pytest.raises(AwError, match="another version of the preset toy-a"):
        make_captures(TOY, root)


def test_nothing_is_written_among_other_files(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "thesis.txt").write_text("mine")
    with pytest.raises(AwError, match="has no folder captures of aw-sim-mini"):
        make_captures(TOY, tmp_path / "photos")
    (tmp_path / "toy" / "captures" / "toy-a").mkdir(parents=True)
    (tmp_path / "toy" / "captures" / "toy-a" / "thesis.txt").write_text("mine")
    with pytest.raises(AwError, match="toy-a exists and is no whole capture"):
        make_captures(TOY, tmp_path / "toy")
    assert sorted(p.name for p in tmp_path.rglob("*.*")) == ["thesis.txt", "thesis.txt"]
    with pytest.raises(AwError, match="photos of a real place"):
        make_captures(get_suite("drone"), tmp_path / "drone")


def test_as_it_is_typed(root: Path, tmp_path: Path) -> None:
    """An own method, from captures to the table beside the references; the second call keeps it all."""
    (tmp_path / "mine.py").write_text(
        "from ambiguous_wild.methods.entry import NoOptions\n"
        "from ambiguous_wild.splat.method_hooks import MethodHooks\n\n\n"
        "def mine(options: NoOptions) -> MethodHooks:\n    return MethodHooks()\n"
    )
    words = [
        "bench",
        "--suite",
        TOY.name,
        "--scene",
        root,
        "--poses",
        "truth",
        "-o",
        tmp_path / "runs",
        *TRAIN,
    ]
    words += ["--method", f"3dgs,{tmp_path / 'mine.py'}:mine"]
    done = aw(*words)
    assert done.returncode == 0, done.stderr
    assert "aw-sim-mini: 2 scenes, exact poses" in done.stdout
    table = done.stdout.splitlines()
    head = next(line for line in table if "colour (1)" in line)
    assert "meaning (1)" in head and "all (2)" in head
    assert any(line.startswith("3dgs ") for line in table) and any(line.startswith("mine ") for line in table)
    assert "paired differences" in done.stdout and "no rows of the board" in done.stdout
    runs = read_runs(tmp_path / "runs")
    assert set(runs.runs["scene"]) == set(NAMES) and set(runs.runs["length"]) == {"5 iterations"}
    again = aw(*words)
    assert again.returncode == 0 and again.stdout == done.stdout and "4 kept" in again.stderr
    study = (tmp_path / "runs" / "study.yaml").read_text()
    assert "suite: aw-sim-mini" in study and "poses: truth" in study and "scene: [../toy]" in study


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--suite", "aw-sim-mini", "--scene", "a", "--scene", "b"], "give --scene DIR once, or not at all"),
        (["--suite", "aw-sim-mini", "--method", "3dgz"], "did you mean '3dgs'"),
        (["--suite", "on-the-go", "--scene", ".", "--poses", "truth"], "of simulated suites alone"),
        (["--method", "3dgs", "--scene", ".", "--poses", "truth"], "of simulated suites alone"),
        (["--suite", "aw-sim-mini", "--scene", "a", "-o", "a/runs"], "lies inside the suite aw-sim-mini"),
    ],
)
def test_mistakes_are_one_line(words, message: str, tmp_path: Path) -> None:
    done = aw("bench", *words, *([] if "-o" in words else ["-o", "runs"]), cwd=tmp_path)
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert list(tmp_path.iterdir()) == []


def test_fetch_simulates_and_verify_checks(root: Path, tmp_path: Path) -> None:
    shutil.rmtree(root / "captures" / "toy-b")
    done = aw("fetch", TOY.name, "-o", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 captures" in done.stdout and f"aw bench --suite aw-sim-mini --scene {root}" in done.stdout
    assert "no hash is listed for toy-a, toy-b" in done.stderr
    checked = aw("verify", root, "--json")
    assert checked.returncode == 0, checked.stderr
    facts = json.loads(checked.stdout)
    assert facts["listed"] == {str(WIDTH): {n: capture_hash(root / "captures" / n) for n in NAMES}}
    (root / "captures" / "toy-a" / "train" / "IMG_0003.jpg").unlink()
    damaged = aw("verify", root)
    assert damaged.returncode == 2 and "1 capture of" in damaged.stderr and damaged.stderr.count("\n") == 1


def test_a_package_of_simulated_scenes_needs_no_info(root: Path, tmp_path: Path) -> None:
    done = aw("package", root / "scenes-truth" / "toy-a", "-o", tmp_path / "package", "--no-people")
    assert done.returncode == 0 and "NOT FOR RELEASE" not in done.stdout, done.stderr
    card = (tmp_path / "package" / "README.md").read_text()
    assert "Licence: CC0-1.0" in card and "no recognisable person, no personal data" in card
    facts = json.loads((tmp_path / "package" / "croissant.json").read_text())
    assert facts["license"] == "https://spdx.org/licenses/CC0-1.0.html"
    assert aw("verify", tmp_path / "package").stdout.count("warning") == 0
