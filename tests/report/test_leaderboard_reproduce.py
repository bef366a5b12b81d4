"""The commands that a board gives: what they are made of, and the same numbers from an empty folder."""

from __future__ import annotations

import json
import os
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.harness.cell import reproduce_command
from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import registry
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.report.board import read_board
from ambiguous_wild.report.board_reproduce import Scenes, command, preparation
from ambiguous_wild.simulate.presets import preset, resized
from ambiguous_wild.simulate.spec_file import parse_spec, plain_spec
from ambiguous_wild.splat.train_config import TrainConfig
from tests.tiny_scene import write_tiny_scene

SETTINGS = {"factor": 2, "camera": "auto", "matcher": "auto", "seed": 0, "strict": False, "sfm": "auto"}


def scene_of(root: Path, truth: object, settings: object = SETTINGS) -> Scene:
    scene = load_scene(write_tiny_scene(root))
    (root / "truth" / "capture.json").write_text(json.dumps(truth))
    return replace(scene, info={**scene.info, "settings": settings})


def test_a_preset_is_named_with_what_differs_from_it(tmp_path: Path) -> None:
    spec = plain_spec(resized(preset("courtyard"), 12, 480))
    scene = scene_of(tmp_path / "yard", {"preset": "courtyard", "seed": 3, "spec": spec})
    assert preparation(scene) == [
        "aw simulate courtyard --views 12 --width 480 --seed 3 -o raw/yard",
        "aw build-scene raw/yard -o yard --factor 2",
    ]
    more = scene_of(tmp_path / "b c", {"preset": "courtyard", "seed": 0, "spec": spec},
                    {**SETTINGS, "mapper": "global", "max_features": 500, "strict": True})  # fmt: skip
    assert preparation(more)[1] == (
        "aw build-scene 'raw/b c' -o 'b c' --factor 2 --mapper global --max-features 500 --strict"
    )
    fast = scene_of(tmp_path / "fast", {"preset": "courtyard", "seed": 0, "spec": spec},
                    {**SETTINGS, "sfm": "fast"})  # fmt: skip
    assert preparation(fast)[1] == "aw build-scene raw/fast -o fast --factor 2 --sfm fast"
    older = {key: value for key, value in SETTINGS.items() if key != "sfm"}
    old = scene_of(tmp_path / "old", {"preset": "courtyard", "seed": 0, "spec": spec}, older)
    assert preparation(old)[1] == "aw build-scene raw/old -o old --factor 2 --sfm thorough"


PAPER = {"refinesplat-paper.features=labhog", "refinesplat-paper.instances=graph"}


@pytest.mark.parametrize(
    ("method", "named"),
    [
        ("robustsplat", {"robustsplat.features=labhog"}),
        ("refinesplat-paper", PAPER),
        ("dronesplat", set()),
        ("3dgs@mask=robustsplat", {"robustsplat.features=labhog"}),
        ("robustsplat@mask=refinesplat-paper", {"robustsplat.features=labhog", *PAPER}),
        ("dronesplat@density=uad", set()),
    ],
)
def test_a_default_that_depends_on_the_machine_is_named(method: str, named: set[str]) -> None:
    options = to_plain(get_method(method).options())
    config = {
        "method": method,
        "scene": {"name": "yard"},
        "source": None,
        "options": options,
        "train": {"seed": 0, "iterations": 100},
    }
    words = shlex.split(command(config))
    assert {words[i + 1] for i, word in enumerate(words) if word == "--set"} == named
    for seconds, budget in ((1234567.0, "1234567s"), (83.123456, "83.123456s")):
        assert f"--budget {budget}" in command(config | {"train": {"seed": 0, "budget_s": seconds}})
    corrected = command(config | {"corrections": {"sha256": "a" * 64}})
    assert "--corrections CORRECTIONS.json" in corrected and "--corrections" not in words


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("own.py:b", ["--method", "own.py:b"]),
        ("own.py:b@density=uad", ["--method", "own.py:b@density=uad"]),
        ("external:own.yaml", ["--method", "external:own.yaml"]),
        ("plugged", ["--method", "plugged", "--plugin", "own.py"]),
    ],
)
def test_an_own_method_is_named_as_it_was_given(
    given: str, words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(
        "from ambiguous_wild.methods import MethodEntry, register\n"
        "from ambiguous_wild.splat.method_hooks import MethodHooks\n\n"
        "def b(): return MethodHooks()\n\n"
        "register(MethodEntry('plugged', '', lambda options: MethodHooks()))\n"
    )
    Path("own.yaml").write_text("{name: other, train: aw, render: aw, renders: '{output}/{stem}.png'}")
    registry.load_plugin(Path("own.py"))
    (cell,) = plan_cells([given], [write_tiny_scene(tmp_path / "scene")], [0], TrainConfig(iterations=5))
    line = command(cell.config, (), reproduce_command(cell))
    assert line.startswith(shlex.join(["aw", "bench", *words, "--scene"])), line
    assert registry.get_method(words[1]).source_hash == cell.config["source"]
    # a stranger's text gives no more than names
    hostile = command(cell.config, (), "aw --method 'x/$(rm).py:b;' --plugin '../a b.py' \"")
    assert "rm" not in hostile and f"--method {cell.method.name} --plugin METHOD.py" in hostile


def test_another_spec_is_written_out(tmp_path: Path) -> None:
    spec = replace(preset("courtyard"), summary="it's mine; $(rm -rf ~)", arc_deg=33.0)
    scene = scene_of(tmp_path / "own", {"preset": "courtyard", "seed": 0, "spec": plain_spec(spec)})
    write, simulate, _ = preparation(scene)
    subprocess.run(["bash", "-c", write], cwd=tmp_path, check=True)
    assert parse_spec((tmp_path / "own.yaml").read_text()) == spec
    assert simulate == "aw simulate ./own.yaml -o raw/own" and "\n" not in write


@pytest.mark.parametrize(
    ("width", "change", "factor", "dataset"),
    [
        (480, {}, 2, "aw-sim"),
        (960, {}, 2, "aw-sim-large"),
        (480, {}, 1, "simulated"),
        (480, {"arc_deg": 33.0}, 2, "simulated"),
        (480, {"train_views": 12}, 2, "simulated"),
        (480, {"distractors": ()}, 2, "simulated"),
    ],
)
def test_another_spec_under_the_name_of_a_suites_preset_is_not_of_the_suite(
    width: int, change: dict, factor: int, dataset: str, tmp_path: Path
) -> None:
    spec = replace(resized(preset("coats"), None, width), **change)
    scene = scene_of(tmp_path / "coats", {"preset": "coats", "seed": 5, "spec": plain_spec(spec)})
    scene = replace(scene, info={**scene.info, "loaded_factor": factor})
    assert Scenes().dataset(tmp_path / "run", scene, "") == dataset
    exact = replace(scene, info={**scene.info, "chosen": {"mapper": "truth"}})
    assert Scenes().dataset(tmp_path / "run", exact, "") == f"{dataset}, exact poses"
    assert Scenes(dataset="Mine").dataset(tmp_path / "run", scene, "") == "Mine"


@pytest.mark.parametrize("truth", [None, [], {}, {"spec": 3}, {"preset": "x", "seed": "0", "spec": {}}])
def test_what_was_not_simulated_has_no_commands(truth: object, tmp_path: Path) -> None:
    assert preparation(scene_of(tmp_path / "s", truth)) == [] and preparation(None) == []


@pytest.mark.slow
def test_the_commands_give_the_same_psnr_in_an_empty_folder(tmp_path: Path) -> None:
    program = tmp_path / "bin" / "aw"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m ambiguous_wild.cli.main "$@"\n')
    program.chmod(0o755)
    root = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    environment = os.environ | {
        "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": path,
    }

    def bash(line: str, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        done = subprocess.run(
            ["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr

    first, empty = tmp_path / "first", tmp_path / "empty"
    bash("aw simulate tiny --views 8 --width 256 -o photos", first)
    bash("aw build-scene photos -o small --factor 2", first)
    bash("aw bench --method 3dgs --scene small --iterations 20 --no-pictures -o runs", first)
    bash("aw leaderboard add runs --board board --images 0", first)
    (entry,) = read_board(first / "board")
    bash(entry.reproduce, empty)
    bash(f"aw leaderboard add runs --board {shlex.quote(str(first / 'again'))} --images 0", empty)
    (again,) = read_board(first / "again")
    assert again.scene_hash == entry.scene_hash and again.config_hash == entry.config_hash
    assert again.quality == entry.quality and again.reproduce == entry.reproduce
