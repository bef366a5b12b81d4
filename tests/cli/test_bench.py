"""`aw bench` as it is typed."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from ambiguous_wild.cli.bench import parse_budget
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.benchmark import find_methods
from tests.command_line import ROOT, aw
from tests.tiny_scene import write_tiny_scene


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("10m", 600), ("1.5h", 5400), (" 2 min ", 120)])
def test_budgets(text, seconds):
    assert parse_budget(text) == seconds


@pytest.mark.parametrize("text", ["", "10", "m", "-3m", "0s", "10m30", "1e3s"])
def test_what_is_no_budget(text):
    with pytest.raises(AwError, match="no duration"):
        parse_budget(text)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--method", "refinsplat"], "did you mean 'refinesplat'"),
        (["--method", "3dgs", "--iterations", "5", "--budget", "1m"], "exclude each other"),
        (["--method", "3dgs", "--iterations", "0"], "--iterations"),
        (["--method", "3dgs", "--iterations", "10k"], "'10k' is not a whole number"),
        (["--method", "3DGS", "--passes", "2", "refinesplat"], "did you mean --method refinesplat?"),
        (["--method", "3dgs", "./other"], "did you mean --scene ./other?"),
        (["--method", "mine:trimmed"], "write FILE.py:RECIPE, as mine.py:trimmed"),
        (["--method", "3dgs,refinsplat"], "unknown method 'refinsplat': did you mean 'refinesplat'"),
        (["--method", "3dgs", "--overwrite", "perhaps"], "'never', 'missing', 'changed', 'always'"),
        (["--method", "3dgs", "--itterations", "5"], "--iterations"),
        (["--method", "refinesplat", "--set", "refinesplat.lamda_cr=1"], "did you mean 'lambda_cr'"),
        (["--method", "3dgs", "--plugin", "absent.py"], "no plugin file"),
        (["--method", "3dgs", "--seed", "-1"], "--seed"),
        (["--method", "3dgs", "--checkpoint-every", "nan"], "nan"),
        (["--method", "3dgs", "--budget", "0s"], "above zero"),
        (["--method", "refinesplat", "--set", "refinesplat.lambda_dssim=nan"], "finite"),
        (["--method", "refinesplat", "--set", "refinesplat.mask_every=0"], "at least 1"),
    ],
)
def test_mistakes_get_one_line_and_exit_code_2(scene, tmp_path, arguments, message):
    done = aw("bench", "--scene", scene, "-o", tmp_path / "runs", *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()


def test_a_file_without_a_recipe_names_its_recipes(scene, tmp_path):
    own = "from dataclasses import dataclass\nfrom ambiguous_wild.splat.method_hooks import MethodHooks\n"
    (tmp_path / "own.py").write_text(
        own + "def helper(x): ...\ndef chroma() -> MethodHooks: return MethodHooks()\n"
    )
    done = aw("bench", "--scene", scene, "--method", "own.py", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: own.py is a file: add the name of a recipe in it: own.py:chroma\n"


def test_methods_with_commas_and_in_any_case():
    names = ["3DGS, RefineSplat", "robustsplat@density=absgs,mask=truth,3dgs"]
    assert list(find_methods(names, [], {}, 1)) == [
        "3dgs", "refinesplat", "robustsplat@mask=truth,density=absgs"
    ]  # fmt: skip


def test_no_scene_there(tmp_path):
    done = aw("bench", "--method", "3dgs", "--scene", tmp_path / "nothing", "-o", tmp_path / "runs")
    assert done.returncode == 2
    assert "there is no scene folder" in done.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("output", ["file", "file/deeper"])
def test_an_output_that_cannot_be_is_one_line(scene, tmp_path, output):
    (tmp_path / "file").write_text("mine")
    done = aw("bench", "--method", "3dgs", "--scene", scene, "--iterations", "5", "-o", tmp_path / output)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Traceback" not in done.stderr
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.slow
def test_killed_in_mid_training_the_same_command_ends_with_the_same_renders(scene, tmp_path):
    """kill -9 once a checkpoint is there; the second command resumes and equals an undisturbed run."""
    arguments = ["bench", "--method", "3dgs", "--scene", scene, "--iterations", "650"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert aw(*arguments, "-o", whole).returncode == 0

    often = [*arguments, "-o", killed, "--checkpoint-every", "0.05"]
    process = subprocess.Popen(
        [sys.executable, "-m", "ambiguous_wild.cli.main", *map(str, often)],
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
    )
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
