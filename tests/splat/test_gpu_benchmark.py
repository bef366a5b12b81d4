"""The GPU benchmark around a stand-in for gsplat: it runs, and its yardstick trains."""

import json

import pytest
import torch

from ambiguous_wild.stress import stress_table
from ambiguous_wild.stress.case import Case, CaseResult
from tests.benchmark_scripts import benchmark
from tests.tiny_scene import write_tiny_scene

from . import fake_gsplat


@pytest.fixture
def gpu(monkeypatch):
    with fake_gsplat.installed(monkeypatch), benchmark("gpu") as module:
        yield module


def case(name, error):
    return Case(1, name, lambda device: CaseResult(error, 1.0, "why", "what"), ("cpu", "cuda"))


@pytest.mark.parametrize(("errors", "code"), [([0.5], 0), ([0.5, float("nan")], 1)])
def test_every_measurement_is_in_the_results(gpu, tmp_path, monkeypatch, errors, code):
    monkeypatch.setattr(stress_table, "CASES", tuple(case(f"case {k}", e) for k, e in enumerate(errors)))
    monkeypatch.setattr(gpu, "BLOCK", 2)
    monkeypatch.setattr("ambiguous_wild.harness.evaluate.FPS_SECONDS", 0.01)
    scene, results = write_tiny_scene(tmp_path / "scene"), tmp_path / "gpu.json"
    words = f"--scene {scene} --work {tmp_path} --results {results} --iterations 6 --warm-up 1 --turns 1"
    assert gpu.main([*words.split(), "--device", "cpu"]) == code
    found = json.loads(results.read_text())
    assert [row["passed"] for row in found["parity"]] == [e < 1 for e in errors]
    assert [row["method"] for row in found["trainings"]] == ["3dgs", "refinesplat"]
    assert all(row["iterations"] == 6 and row["fps"] > 0 and row["psnr"] > 5 for row in found["trainings"])
    ms = found["ms_a_step"]
    assert ms.keys() == {"3dgs", "refinesplat", "gsplat"} and min(ms.values()) > 0
    assert found["against_gsplat"]["3dgs"] == pytest.approx(ms["3dgs"] / ms["gsplat"])


def test_gsplats_loop_learns(gpu, tmp_path):
    import argparse

    args = argparse.Namespace(scene=write_tiny_scene(tmp_path / "scene"), work=tmp_path, device="cpu")
    ours = gpu.trainer_of(args, "3dgs", 100)
    plain = gpu.PlainLoop(ours.gaussians, ours.data, ours.run_schedule.learning_rates(0.0))
    first = float(plain.step())
    for name, parameter in plain.parameters.items():
        assert not torch.equal(parameter.detach(), getattr(ours.gaussians, name)) or name == "quats", name
    for _ in range(17):
        last = float(plain.step())
    assert last < 0.8 * first


def test_tensors_are_counted_without_a_gpu(gpu, tmp_path, monkeypatch):
    page = tmp_path / "memory.md"
    monkeypatch.setattr(gpu, "COUNTED", page)
    page.write_text("# Memory\n\n## Peaks\n\nsome\n")
    words = f"--scene {write_tiny_scene(tmp_path / 'scene')} --work {tmp_path} --count 70"
    assert gpu.main(words.split()) == 0
    text = page.read_text()
    assert text.startswith("# Memory\n\n## Peaks\n\nsome\n")
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith(("| 3dgs", "| refinesplat"))]
    launches = {(row[0].strip("| "), row[1]): int(row[3]) for row in rows}
    assert launches["refinesplat", "mask"] > launches["3dgs", "loss"] > 10
    assert ("refinesplat", "growth") in launches and ("3dgs", "mask") not in launches


def test_living_tensors_are_those_that_live(gpu):
    with gpu.Tensors() as tensors:
        kept = torch.zeros(1000)
        with tensors.named("part"):
            torch.zeros(5000)
            view = kept[10:]
            view.add_(1.0)
            torch.zeros(500)
    assert tensors.peaks["set-up"][0] == 4000 and tensors.peaks["part"][0] == 24_000
    assert tensors.launches == {"set-up": 1, "part": 3}
    assert any("float32 [5000] of zeros" in what for _, what in tensors.peaks["part"][1])
