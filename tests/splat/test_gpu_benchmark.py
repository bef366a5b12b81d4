"""The GPU benchmark around a stand-in for gsplat: every stage runs and says what it measured."""

import json
import sys
from pathlib import Path

import numpy as np
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
    for name in list(sys.modules):
        if name == "gpu" or name.startswith("gpu_"):
            sys.modules.pop(name)


def run(gpu, tmp_path, *stages, **more):
    scene = tmp_path / "scene"
    if not scene.exists():
        write_tiny_scene(scene)
    words = ["--scene", str(scene), "--work", str(tmp_path / "work"), "--results", str(tmp_path / "results")]
    words += ["--iterations", "6", "--device", "cpu", "--warm-up", "1", "--turns", "1", "--budget", "1"]
    if stages:
        words += ["--stages", *stages]
    for key, values in more.items():
        words += [f"--{key}", *values]
    code = gpu.main(words)
    results = {p.stem: json.loads(p.read_text()) for p in (tmp_path / "results").glob("gpu-*.json")}
    return code, results, (tmp_path / "results" / "gpu.md").read_text()


def test_training_cost_and_profile(gpu, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gpu_stages.BLOCK", 2)
    code, results, page = run(
        gpu, tmp_path, "build", "train", "budget", "cost", "profile", methods=["3dgs", "refinesplat"]
    )
    assert code == 0
    rows = results["gpu-train"]["rows"]
    assert [r["method"] for r in rows] == ["3dgs", "refinesplat"]
    assert all(r["iterations"] == 6 and r["fps"] > 0 and r["psnr"] > 5 for r in rows)
    cost = results["gpu-cost"]
    variants = {"3dgs, tiles=last-visit", "3dgs, harmonics=split", "3dgs, both", "3dgs, CUDA graph"}
    loops = {"3dgs", "refinesplat", "gsplat", "gsplat, no wait"} | variants
    assert cost["ms"].keys() == loops and all(cost["ms"].values()) and not cost["left_out"]
    against = {f"{name} / 3dgs" for name in variants | {"refinesplat"}}
    assert cost["ratios"].keys() == {"3dgs / gsplat", "3dgs / gsplat, no wait"} | against
    assert cost["gaussians"] == rows[0]["gaussians"]
    assert "## Trainings of 1 s" in page and len(results["gpu-budget"]["rows"]) == 2
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


def test_the_plain_loop_learns_what_ours_learns(gpu, tmp_path, monkeypatch):
    """The yardstick measures a loop that trains, with the gradients that ours has."""
    import argparse

    from gpu_measure import trainer_of
    from gpu_plain import PlainLoop

    scene = write_tiny_scene(tmp_path / "scene")
    args = argparse.Namespace(
        scene=scene, work=tmp_path, seed=0, device="cpu", iterations=100, settings=[], methods=["3dgs"]
    )
    ours = trainer_of(args, "3dgs")
    plain = PlainLoop(ours.gaussians, ours.data, ours.pace.learning_rates(0.0))
    first = float(plain.step())
    for name, parameter in plain.parameters.items():
        assert not torch.equal(parameter.detach(), getattr(ours.gaussians, name)) or name == "quats", name
    for _ in range(17):
        last = float(plain.step())
    assert last < 0.8 * first
    rates = ours.pace.learning_rates(0.0)
    two = [PlainLoop(ours.gaussians, ours.data, rates, waits=waits) for waits in (True, False)]
    calls = []
    monkeypatch.setattr(torch, "inverse", lambda m: calls.append(1) or torch.linalg.inv(m))
    assert float(two[0].step()) == float(two[1].step())
    assert len(calls) == 1 and all(
        torch.allclose(p, two[1].parameters[name]) for name, p in two[0].parameters.items()
    )


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


def test_cost_of_one_method_brings_what_it_is_compared_with(gpu, tmp_path, monkeypatch):
    """It looked up `3dgs` among the loops, and failed after all the measuring."""
    monkeypatch.setattr("gpu_stages.BLOCK", 2)
    code, results, page = run(gpu, tmp_path, "cost", methods=["robustsplat"])
    assert code == 0 and "robustsplat / 3dgs" in results["gpu-cost"]["ratios"]
    assert "- robustsplat / 3dgs:" in page


def test_a_stage_goes_on_after_its_last_finished_part(gpu, tmp_path, monkeypatch):
    import gpu_stages

    seen, train_one = [], gpu_stages._train_one

    def stopped(args, method):
        seen.append(method)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return train_one(args, method)

    monkeypatch.setattr(gpu_stages, "_train_one", stopped)
    with pytest.raises(KeyboardInterrupt):
        run(gpu, tmp_path, "train", methods=["3dgs", "robustsplat"])
    code, results, _ = run(gpu, tmp_path, "train", methods=["3dgs", "robustsplat"])
    assert code == 0 and seen == ["3dgs", "robustsplat", "robustsplat"]
    assert [r["method"] for r in results["gpu-train"]["rows"]] == ["3dgs", "robustsplat"]
    code, results, _ = run(gpu, tmp_path, "train", methods=["3dgs"])  # rows of calls before this one stay
    assert [r["method"] for r in results["gpu-train"]["rows"]] == ["3dgs", "robustsplat"]


def test_the_dinov2_variant_reads_features(gpu, tmp_path, monkeypatch):
    transformers = pytest.importorskip("transformers")
    import gpu_measure

    monkeypatch.delenv("AW_WEIGHTS", raising=False)
    tiny = transformers.Dinov2Config(
        hidden_size=24, num_hidden_layers=1, num_attention_heads=2, image_size=56, patch_size=14
    )
    monkeypatch.setattr(transformers, "Dinov2Config", lambda **_: tiny)
    calls, model = [], transformers.Dinov2Model.forward
    monkeypatch.setattr(
        transformers.Dinov2Model, "forward", lambda self, *a, **k: calls.append(1) or model(self, *a, **k)
    )
    code, results, _ = run(gpu, tmp_path, "train", methods=[gpu_measure.DINO])
    assert code == 0 and results["gpu-train"]["rows"][0]["method"] == gpu_measure.DINO
    assert len(calls) >= 6  # every photo, once


def test_what_is_missing_is_one_line_before_anything_is_measured(gpu, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gpu_stages.missing", lambda name: ["cv2"] if name == "refinesplat" else [])
    with pytest.raises(SystemExit) as end:
        run(gpu, tmp_path, "train", methods=["3dgs", "refinesplat"])
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert "refinesplat needs cv2, which this machine lacks; the others: --methods 3dgs" in said
    assert not (tmp_path / "results").exists()


def test_what_a_stage_needs_of_the_one_before_is_said(gpu, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("gpu_stages.BLOCK", 2)
    said = "cost needs 3dgs trained for 6 iterations: "
    run(gpu, tmp_path, "cost", methods=["3dgs"])
    assert said + "absent, trained first" in capsys.readouterr().out
    run(gpu, tmp_path, "cost", methods=["3dgs"])
    assert said + "has a checkpoint, goes on from there" in capsys.readouterr().out
    run(gpu, tmp_path, "train", "cost", methods=["3dgs"])
    assert said + "found" in capsys.readouterr().out
    run(gpu, tmp_path, "train", methods=["3dgs"])
    assert "train: 3dgs was finished before" in capsys.readouterr().out


def test_steps_of_several_photos_are_counted_by_the_photo(gpu, tmp_path, monkeypatch):
    import itertools
    from types import SimpleNamespace

    seconds = itertools.count()
    monkeypatch.setattr("gpu_stages.BLOCK", 2)
    monkeypatch.setattr("gpu_stages.time", SimpleNamespace(perf_counter=lambda: float(next(seconds))))
    code, results, _ = run(gpu, tmp_path, "budget", "cost", methods=["3dgs-4-views"])
    ms = results["gpu-cost"]["ms"]
    assert code == 0 and ms["3dgs"] == 500 and ms["3dgs-4-views"] == 125
    assert results["gpu-budget"]["rows"] == []  # they count photos, a budget counts seconds


def test_calls_write_files_of_their_own(gpu, tmp_path, monkeypatch):
    monkeypatch.setattr("gpu_stages.BLOCK", 2)
    for call in ("1", "2"):
        monkeypatch.setitem(gpu.CALLS, int(call), (("cost",), ("3dgs",)))
        _, results, page = run(gpu, tmp_path, call=[call])
    assert {"gpu-cost-1", "gpu-cost-2"} <= results.keys() and page.count("An iteration at") == 2


def test_the_step_of_the_graph_is_the_step_of_the_trainer(gpu, tmp_path):
    """Without a graph, on the CPU: the same losses, and the same parameters up to rounding."""
    import argparse

    from gpu_graph import GraphLoop
    from gpu_measure import late, trainer_of

    scene = write_tiny_scene(tmp_path / "scene")
    args = argparse.Namespace(
        scene=scene, work=tmp_path, seed=0, device="cpu", iterations=100, settings=[], methods=["3dgs"]
    )
    start = trainer_of(args, "3dgs")
    ours = late(trainer_of(args, "3dgs", iterations=10**6), start.gaussians)
    rates = ours.pace.learning_rates(0.5)
    loop = GraphLoop(start.gaussians, start.data, rates, capture=False)
    order = [ours.pace.view(ours.iteration + 1 + k) for k in range(6)]
    loop.data = argparse.Namespace(
        photos=[start.data.photos[v] for v in order], cameras=[start.data.cameras[v] for v in order],
        device=start.data.device,
    )  # fmt: skip
    for _ in range(6):
        assert float(loop.step()) == pytest.approx(float(ours.step()), rel=1e-4)
    assert float(loop.over) == 0 and float(loop.count) == 6
    for name, tensor in ours.gaussians.items():
        if name != "quats":  # of a ball's turning there is nothing but rounding
            apart = (tensor - loop.values[name]).abs() > 1e-4
            assert float(apart.float().mean()) < 0.02, name


def test_a_scene_of_several_sizes_has_no_graph_and_the_other_figures(gpu, tmp_path, monkeypatch):
    import gpu_stages

    def refuses(*_, **__):
        raise gpu_stages.AwError("a graph needs photos of one size, the scene has 2")

    monkeypatch.setattr("gpu_stages.BLOCK", 2)
    monkeypatch.setattr(gpu_stages, "GraphLoop", refuses)
    code, results, page = run(gpu, tmp_path, "cost", methods=["3dgs"])
    assert code == 0 and "the scene has 2" in results["gpu-cost"]["left_out"]["3dgs, CUDA graph"]
    assert "- 3dgs, CUDA graph failed: a graph needs" in page


BARE = """
import sys
sys.path.insert(0, {benchmarks!r})
import pytest
from tests.splat import fake_gsplat

with fake_gsplat.installed(pytest.MonkeyPatch()):
    import gpu
    import gpu_stages
    gpu_stages.BLOCK = 2
    usual = ["--scene", {scene!r}, "--work", {work!r}, "--results", {work!r}, "--iterations", "4",
             "--device", "cpu", "--warm-up", "1", "--turns", "1"]
    code = gpu.main([*usual, "--stages", "build", "train", "cost", "--methods", "3dgs", "robustsplat"])
    print("code", code, sorted(set(sys.modules) & set(Absent.names)))
    try:
        gpu.main([*usual, "--methods", "refinesplat"])
    except SystemExit as end:
        print("refused", end.code)
"""


def test_it_runs_where_little_is_installed(tmp_path):
    from .test_few_packages import ABSENT
    from .test_few_packages import run as run_bare

    scene = write_tiny_scene(tmp_path / "scene")
    done = run_bare(
        BARE, absent=(*ABSENT, "cv2", "transformers"), benchmarks=str(BENCHMARKS), scene=str(scene),
        work=str(tmp_path / "work"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "code 0 []" in done.stdout and done.stdout.rstrip().endswith("refused 2")
    assert "refinesplat needs scipy, cv2, which this machine lacks" in done.stderr


def test_a_carried_scene_keeps_a_dozen_views_of_a_point(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    from gpu_scene import thinned

    seen = {k: (np.arange(0, 10 + k), np.full((10 + k, 2), float(k))) for k in range(30)}
    found = thinned(seen, 12)
    counts = np.bincount(np.concatenate([rows for rows, _ in found.values()]))
    before = np.bincount(np.concatenate([rows for rows, _ in seen.values()]))
    assert (counts == np.minimum(before, 12)).all()
    assert all((uv == k).all() and len(uv) == len(rows) for k, (rows, uv) in found.items())
    first = [k for k, (rows, _) in found.items() if 0 in rows]
    assert first[0] == 0 and max(np.diff(first)) <= 3  # spread over all views
