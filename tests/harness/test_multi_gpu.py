"""A cell whose model two processes share, from the plan to its result; and what is refused before."""

import dataclasses
import functools
import json

import pytest
import torch
from click.testing import CliRunner

from ambiguous_wild.cli.main import cli
from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running import multi_gpu, run, training
from ambiguous_wild.harness.running.grid import plan_cells
from ambiguous_wild.splat.pace import TrainConfig
from tests.splat import fake_gsplat
from tests.tiny_scene import write_tiny_scene


def rank_around_the_stand_in(*arguments):
    """What a worker does here: the stand-in for gsplat, then its rank."""
    with fake_gsplat.installed(pytest.MonkeyPatch()):
        multi_gpu.train_cell_rank(*arguments)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")


def cell_of(scene, method="3dgs", gpus=2, iterations=12, **config):
    train = TrainConfig(iterations=iterations, probes=1, **config)
    (cell,) = plan_cells([method], [scene], [0], train)
    return dataclasses.replace(cell, gpus=gpus)


def test_a_shared_run_is_measured_as_any_other(scene, tmp_path, monkeypatch):
    gloo = functools.partial(multi_gpu.train_multi_gpu, backend="gloo")
    monkeypatch.setattr(training, "train_multi_gpu", gloo)
    work = multi_gpu.launch
    monkeypatch.setattr(multi_gpu, "launch", lambda n, _, *a, **k: work(n, rank_around_the_stand_in, *a, **k))
    ticks = []
    cell = cell_of(scene)
    report = run.run_cell(
        cell, tmp_path / "run", cache_dir=tmp_path, tick=lambda t: ticks.append(t.iteration), pictures=False
    )
    assert report.outcome == "trained"
    result = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert result["cost"]["gpus"] == 2 and result["cost"]["iterations"] == 12
    assert result["cost"]["gaussians"] == 400
    assert all(row["psnr"] > 10 for row in result["per_image"])
    assert len(list((tmp_path / "run" / "renders" / "test").glob("*.png"))) == 2
    assert ticks and max(ticks) == 12
    again = run.run_cell(cell, tmp_path / "run", cache_dir=tmp_path)
    assert again.outcome == "kept"
    with pytest.raises(AwError, match="gpus was 2"):
        run.run_cell(cell_of(scene, gpus=3), tmp_path / "run", cache_dir=tmp_path)


def test_one_gpu_has_the_identity_it_had(scene):
    one = cell_of(scene, gpus=1)
    (plain,) = plan_cells(["3dgs"], [scene], [0], one.train)
    assert one.identity == plain.identity and "gpus" not in one.config
    assert cell_of(scene).identity != one.identity


@pytest.mark.parametrize(
    ("method", "changes", "said"),
    [
        ("refinesplat", {}, "refinesplat|mask"),
        ("3dgs", {"budget_s": 60.0}, "budget"),
        ("3dgs", {"on_nonfinite": "rollback"}, "rollback"),
    ],
)
def test_what_cannot_be_shared_is_refused_in_one_line(scene, method, changes, said):
    cell = dataclasses.replace(cell_of(scene, method, **changes), device="cuda")
    with pytest.raises(AwError, match=said) as error:
        multi_gpu.check_multi_gpu(cell)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("words", "gpus", "said"),
    [
        (["--gpus", "2", "--jobs", "2"], 4, "leave --jobs and --engine out"),
        (["--gpus", "3"], 2, "--gpus 3: torch sees 2 GPUs here"),
        (["--gpus", "2", "--device", "cpu"], 2, "--gpus 2 is of GPUs"),
    ],
)
def test_the_command_line_says_what_is_wrong(scene, tmp_path, monkeypatch, words, gpus, said):
    from ambiguous_wild.harness.running.engines.session import Session

    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    monkeypatch.setattr(Session, "device", lambda self, wanted: "cpu" if wanted == "cpu" else "cuda")
    out = tmp_path / "runs"
    result = CliRunner().invoke(
        cli, ["bench", "--method", "3dgs", "--scene", str(scene), "-o", str(out), *words]
    )
    text = str(result.exception) if isinstance(result.exception, AwError) else result.output
    assert said in text
    assert not out.exists()
