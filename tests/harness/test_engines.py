"""Cells in processes and on Ray are the cells of one process, also where a worker is killed in the middle."""

import importlib.util
import json
import math

import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.bench import command as bench
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.engines import job as jobs
from ambiguous_wild.harness.engines.ray_cluster import RayOptions
from ambiguous_wild.harness.engines.transfer import receive, run_sent, send_scene, stays
from ambiguous_wild.harness.grid import cell_folder, plan_cells
from ambiguous_wild.harness.run import CellReport
from ambiguous_wild.methods import registry
from ambiguous_wild.splat.trainer import TrainConfig
from tests.tiny_scene import write_tiny_scene

SHORT = TrainConfig(iterations=40)
HAS_RAY = importlib.util.find_spec("ray") is not None
# Kills its own process in the middle of a training, as many times as the file beside it says.
FRAIL = """
import os, signal
from pathlib import Path
from ambiguous_wild.methods import MethodEntry, register
from ambiguous_wild.splat.parts import MaskPolicy, Parts

DEATHS = Path({deaths!r})

class Mask(MaskPolicy):
    def keep(self, step):
        left = int(DEATHS.read_text())
        if step.iteration == 20 and left:
            DEATHS.write_text(str(left - 1))
            os.kill(os.getpid(), signal.SIGKILL)
        return None

def frail():
    "dies in the middle"
    return Parts(mask=Mask())
"""


@pytest.fixture(autouse=True)
def _methods(monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")


@pytest.fixture(scope="module")
def frail(tmp_path_factory):
    """A recipe's reference, and the file that says how often it dies."""
    folder = tmp_path_factory.mktemp("method")
    deaths = folder / "deaths"
    deaths.write_text("0")
    code = FRAIL.format(deaths=str(deaths))
    (folder / "recipe.py").write_text(code)
    return f"{folder / 'recipe.py'}:frail", deaths


def aw_bench(output, scene, method, *words):
    arguments = ["--method", method, "--scene", scene, "--seed", 0, "--seed", 1, "--iterations", 40]
    arguments += ["--no-pictures", "--threads", 1, "-o", output, *words]
    return CliRunner().invoke(bench, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def local(scene, frail, tmp_path_factory):
    """The same grid in one process, undisturbed."""
    output = tmp_path_factory.mktemp("local")
    done = aw_bench(output, scene, frail[0])
    assert done.exit_code == 0, done.output
    registry._registered.clear()
    return results(output)


def results(output):
    """Everything that must not depend on where a cell ran, by path below the output."""
    kept = {}
    for path in sorted(output.rglob("*")):
        name = path.relative_to(output).as_posix()
        if path.is_dir() or any(part.startswith(".") for part in path.relative_to(output).parts):
            continue
        if path.name == "metrics.json":
            kept[name] = {k: v for k, v in json.loads(path.read_text()).items() if k != "cost"}
        elif path.name == "config.yaml":
            config = yaml.safe_load(path.read_text())
            config["scene"].pop("path")
            kept[name] = config
        elif path.suffix in (".png", ".ply"):
            kept[name] = path.read_bytes()
        else:
            kept[name] = None  # times, versions, moments: there, and that is all
    return kept


def test_processes_one_killed_in_the_middle_give_what_one_process_gives(scene, frail, local, tmp_path):
    frail[1].write_text("1")
    done = aw_bench(tmp_path, scene, frail[0], "--jobs", 2)
    assert done.exit_code == 0, done.output
    assert frail[1].read_text() == "0"
    assert results(tmp_path) == local
    assert len([name for name in local if name.endswith("metrics.json")]) == 2
    assert done.output.count("begins: frail on scene") == 3
    assert "[2/2] frail on scene" in done.output and "2 runs: 2 trained" in done.output


@pytest.mark.skipif(not HAS_RAY, reason="Ray is not installed: extra [ray]")
def test_ray_one_worker_killed_in_the_middle_gives_what_one_process_gives(scene, frail, local, tmp_path):
    frail[1].write_text("1")
    done = aw_bench(tmp_path, scene, frail[0], "--engine", "ray", "--jobs", 2)
    assert done.exit_code == 0, done.output
    assert frail[1].read_text() == "0"
    assert results(tmp_path) == local
    assert "Ray: 1 node, 2 CPU" in done.output and "2 runs: 2 trained" in done.output
    assert list(tmp_path.glob(".aw-shared-*")) == []
