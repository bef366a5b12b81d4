"""`aw bench` as it is typed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ambiguous_wild.cli.bench import parse_budget, plan_among
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.benchmark import find_methods
from tests.command_line import ROOT, aw
from tests.tiny_scene import write_tiny_scene


def test_budgets():
    assert [parse_budget(text) for text in ("90s", "10m", "1.5h", " 2 min ", "10minutes")] == [
        90,
        600,
        5400,
        120,
        600,
    ]
    for text in ("", "10", "m", "-3m", "0s", "10m30", "1e3s", "500ms", "5ss"):
        with pytest.raises(AwError, match="no duration"):
            parse_budget(text)


def test_methods_with_commas_and_in_any_case():
    names = ["3DGS, RefineSplat", "robustsplat@density=absgs,mask=truth,3dgs"]
    expected = ["3dgs", "refinesplat", "robustsplat@mask=truth,density=absgs"]
    assert list(find_methods(names, [], {}, 1)) == expected


@pytest.mark.slow
def test_killed_in_mid_training_the_same_command_ends_with_the_same_renders(scene, tmp_path):
    """kill -9 once a checkpoint is there; the second command resumes and equals an undisturbed run."""
    arguments = ["bench", "--method", "3dgs", "--scene", scene, "--iterations", "650"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert aw(*arguments, "-o", whole).returncode == 0

    often = [*arguments, "-o", killed, "--set", "train.checkpoint_every_s=0.05"]
    command = [sys.executable, "-m", "ambiguous_wild.cli.main", *map(str, often)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    run = killed / "scene" / "3dgs" / "seed0"
    deadline = time.monotonic() + 60
    while not (run / "checkpoint" / "last.safetensors").exists() and time.monotonic() < deadline:
        time.sleep(0.005)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (run / "metrics.json").exists()

    done = aw(*often)
    assert done.returncode == 0, done.stderr
    undisturbed = whole / "scene" / "3dgs" / "seed0"
    for name in ("point_cloud.ply", "renders/test/test_0.png", "renders/test/test_1.png"):
        assert (run / name).read_bytes() == (undisturbed / name).read_bytes(), name
    assert list(killed.rglob(".*.tmp*")) == []


def test_listed_photos_that_the_model_lacks_are_named(tmp_path):
    scene = write_tiny_scene(tmp_path / "scene")
    with open(scene / "test_list.txt", "a") as f:
        f.write("lost.png\n")
    done = aw("bench", "--method", "3dgs", "--scene", scene, "--iterations", "5", "-o", tmp_path / "runs")
    assert done.returncode == 0, done.stderr
    assert "warning: scene: 1 test photos of the list are not in the model: lost.png" in done.stderr


def test_outcomes_as_json(scene, tmp_path):
    arguments = ["bench", "--method", "3dgs", "--scene", scene, "--iterations", "20", "-o", tmp_path / "runs"]
    first, second = aw(*arguments, "--json"), aw(*arguments, "--json")
    assert json.loads(first.stdout)[0]["outcome"] == "trained"
    assert json.loads(second.stdout)[0]["outcome"] == "kept"
    assert "aw table" in second.stderr


def test_a_plan_among_effects_stands_for_auto():
    assert plan_among(["none", "a/plan.json"]) == (["none", "auto"], Path("a/plan.json"))
    assert plan_among(["auto", "exposure,poses"]) == (["auto", "exposure,poses"], None)
