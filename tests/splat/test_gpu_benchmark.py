"""The GPU benchmark around a stand-in for gsplat: every stage runs and says what it measured."""

import json
import sys
from pathlib import Path

import pytest
import torch

from tests.tiny_scene import write_tiny_scene

from . import fake_gsplat

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def gpu(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    with fake_gsplat.installed(monkeypatch):
        import gpu

        yield gpu
    for name in ("gpu", "gpu_plain", "gpu_report", "gpu_scene"):
        sys.modules.pop(name, None)


def run(gpu, tmp_path, *stages, **more):
    scene = tmp_path / "scene"
    if not scene.exists():
        write_tiny_scene(scene)
    words = ["--scene", str(scene), "--work", str(tmp_path / "work"), "--results", str(tmp_path / "results")]
    words += ["--stages", *stages, "--iterations", "6", "--device", "cpu", "--warm-up", "1", "--turns", "1"]
    for key, values in more.items():
        words += [f"--{key}", *values]
    code = gpu.main(words)
    results = {p.stem: json.loads(p.read_text()) for p in (tmp_path / "results").glob("gpu-*.json")}
    return code, results, (tmp_path / "results" / "gpu.md").read_text()


def test_training_cost_and_profile(gpu, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu, "BLOCK", 2)
    code, results, page = run(
        gpu, tmp_path, "build", "train", "cost", "profile", methods=["3dgs", "refinesplat"]
    )
    assert code == 0
    rows = results["gpu-train"]["rows"]
    assert [r["method"] for r in rows] == ["3dgs", "refinesplat"]
    assert all(r["iterations"] == 6 and r["fps"] > 0 and r["psnr"] > 5 for r in rows)
    cost = results["gpu-cost"]
    assert cost["ms"].keys() == {"3dgs", "refinesplat", "gsplat"} and all(cost["ms"].values())
    assert cost["ratios"].keys() == {"3dgs / gsplat", "refinesplat / 3dgs"}
    assert cost["gaussians"] == rows[0]["gaussians"]
    assert "aten::" in results["gpu-profile"]["tables"]["3dgs"]
    assert "An iteration at" in page and "of 1.05)" in page and results["gpu-build"]["gsplat"] == "1.6.0"
    assert str(tmp_path) not in json.dumps(results)


def test_parity_fails_loudly(gpu, tmp_path, monkeypatch):
    from ambiguous_wild.stress import table
    from ambiguous_wild.stress.case import Case, Measured

    ok = Case(1, "sound", lambda device: Measured(0.0, 0.0, "exact", "fine"), ("cpu", "cuda"))
    bad = Case(2, "broken", lambda device: Measured(float("nan"), 1.0, "x", "y"), ("cpu", "cuda"))
    monkeypatch.setattr(table, "CASES", (ok,))
    assert run(gpu, tmp_path, "parity")[0] == 0
    monkeypatch.setattr(table, "CASES", (ok, bad))
    code, results, page = run(gpu, tmp_path, "parity")
    assert code == 1 and results["gpu-parity"]["passed"] == 1
    assert "| 02-broken | none | 1.0e+00 | FAILED |" in page


def test_the_plain_loop_learns_what_ours_learns(gpu, tmp_path):
    """The yardstick measures a loop that trains, with the gradients that ours has."""
    import argparse

    scene = write_tiny_scene(tmp_path / "scene")
    args = argparse.Namespace(
        scene=scene, work=tmp_path, seed=0, device="cpu", iterations=100, settings=[], methods=["3dgs"]
    )
    ours = gpu.trainer_of(args, "3dgs")
    plain = gpu.PlainLoop(ours.gaussians, ours.data, ours.pace.learning_rates(0.0))
    first = float(plain.step())
    for name, parameter in plain.parameters.items():
        assert not torch.equal(parameter.detach(), getattr(ours.gaussians, name)) or name == "quats", name
    for _ in range(17):
        last = float(plain.step())
    assert last < 0.8 * first


def test_a_scene_without_colmap_is_one(gpu, tmp_path):
    import numpy as np
    from gpu_scene import make_scene

    from ambiguous_wild.io.scene_folder import load_scene

    root = make_scene(tmp_path / "made", name="courtyard-colour", train=4, test=1, width=96)
    scene = load_scene(root)
    assert (len(scene.train), len(scene.test)) == (4, 1) and len(scene.points) > 20
    points = np.repeat(np.arange(len(scene.points)), np.diff(scene.points.track_offsets))
    for index, view in enumerate(scene.views):
        of_view = scene.points.track_views == index
        local = scene.points.xyz[points[of_view]] @ view.camera.cam_from_world[:3, :3].T
        local = local + view.camera.cam_from_world[:3, 3]
        c = view.camera
        seen = local[:, :2] / local[:, 2:] * [c.fx, c.fy] + [c.cx, c.cy]
        assert np.abs(seen - scene.points.track_xy[of_view]).max(initial=0) < 1e-3
    assert max(np.diff(scene.points.track_offsets)) > 1
    before = (root / "sparse/0/points3D.bin").stat().st_mtime_ns
    make_scene(root, name="courtyard-colour", train=4, test=1, width=96)
    assert (root / "sparse/0/points3D.bin").stat().st_mtime_ns == before
