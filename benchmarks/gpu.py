"""GPU benchmarks: parity with float64, iteration time against plain gsplat, trainings, frames per second.

    bash benchmarks/gpu.sh                                  everything
    python benchmarks/gpu.py --stages parity cost           only some stages
    python benchmarks/gpu.py --stages same --captures A B   CPU and GPU on the same captures, three seeds

Each stage prints its results and writes benchmarks/results/gpu-STAGE.json; gpu.md is made from these files.
`cost` compares at equal counts: every loop starts with the final Gaussians of `3dgs` and runs without density
control, alternating in blocks of BLOCK iterations, so that machine load affects them alike. Exits with 1 if
parity or a training fails.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import itertools
import json
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from gpu_plain import PlainLoop
from gpu_report import to_markdown
from gpu_scene import make_scene

from ambiguous_wild.core import Camera
from ambiguous_wild.harness.running import evaluate
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.grid import plan_cells
from ambiguous_wild.harness.running.memory import peak_memory, reset_peak
from ambiguous_wild.io.atomic import write_json, write_text
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.device import wait
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu import gsplat_seam
from ambiguous_wild.splat.gpu.readiness import look, make_ready, why_not
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.trainer import Trainer

RESULTS = Path(__file__).parent / "results"
METHODS = ("3dgs", "robustsplat", "refinesplat")
STAGES = ("build", "parity", "train", "cost", "profile")
BLOCK = 50  # iterations
TURNS = 12
MOST_PROFILED = 600  # steps


def trainer_of(args: argparse.Namespace, method: str, **config: Any) -> Trainer:
    """A trainer of a method on the scene, before training."""
    config = {"iterations": args.iterations, "seed": args.seed, "probes": 0} | config
    (cell,) = plan_cells(
        [method], [args.scene], [args.seed], TrainConfig(**config),
        settings=[s for s in args.settings if s.startswith(f"{method}.")], device=args.device,
    )  # fmt: skip
    device = torch.device(args.device)
    data = load_train_data(cell.scene, device=device, seed=args.seed, cache_dir=args.work / "cache")
    folder = args.work / f"{method}-{args.seed}-{args.device}"
    return Trainer(data, cell.method.build(cell.options), cell.train, folder=folder)


def test_psnr(trainer: Trainer) -> float:
    """Mean PSNR over the test photos in dB, from 8-bit images."""
    truth = evaluate.load_test_photos(trainer.data.scene)
    with torch.no_grad():
        return evaluate.mean_psnr(truth, lambda camera: trainer.render(camera).image.cpu().numpy())


# -- stages ---------------------------------------------------------------------------------------


def build(args: argparse.Namespace) -> dict[str, Any]:
    """gsplat's kernels, compiled or loaded, and the loss."""
    begin = time.perf_counter()
    if args.device == "cuda":
        make_ready(look(), print)
    points = np.random.default_rng(0).normal((0.0, 0.0, 4.0), size=(64, 3))
    g = Gaussians.from_points(points, np.zeros((64, 3), np.uint8)).to(args.device)
    rendered = render(g, Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)))
    rendered.backward(torch.ones_like(rendered.image))
    wait(torch.device(args.device))
    return {"max_alpha": gsplat_seam.max_alpha(args.device), "seconds": time.perf_counter() - begin}


def parity(args: argparse.Namespace) -> dict[str, Any]:
    """All GPU stress tests against float64."""
    from ambiguous_wild.stress.table import CASES, run_all, to_line

    outcomes = run_all([c for c in CASES if "cuda" in c.devices], [args.device], lambda o: print(to_line(o)))
    passed = sum(o.passed for o in outcomes)
    return {"passed": passed, "cases": len(outcomes), "rows": [o.plain() for o in outcomes]}


def train(args: argparse.Namespace) -> dict[str, Any]:
    """Whole trainings; a failed method is reported and the others are kept."""
    rows: list[dict[str, Any]] = []
    failed: dict[str, str] = {}
    found = {"scene": facts_of(args), "rows": rows, "failed": failed}
    for method in args.methods:
        gc.collect()  # the trainer before this one
        if args.device == "cuda":
            torch.cuda.empty_cache()
        try:
            rows.append(_train_one(args, method))
            print({k: v for k, v in rows[-1].items() if k != "ms_parts"}, flush=True)
        except Exception as error:  # whatever it is, what was measured before it is kept
            failed[method] = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            print(f"{method} failed: {traceback.format_exc()}", flush=True)
        write(args, "train", found)
    return found


def _train_one(args: argparse.Namespace, method: str) -> dict[str, Any]:
    """Seconds, PSNR, Gaussians, ms by part, memory, frames a second."""
    reset_peak(args.device)
    begin = time.perf_counter()
    trainer = trainer_of(args, method)
    setup_s = time.perf_counter() - begin
    if not trainer.resume():
        trainer.setup_s = setup_s
    trainer.train()
    trainer.clock.settle()
    n = max(trainer.iteration, 1)
    return {
        "method": method,
        "iterations": trainer.iteration,
        "setup_s": trainer.setup_s,
        "train_s": trainer.clock.now(),
        "ms_per_iteration": trainer.ms_per_iteration,
        "ms_parts": {k: 1e3 * v / n for k, v in trainer.clock.parts_s.items()},
        "gaussians": len(trainer.gaussians),
        "psnr": test_psnr(trainer),
        **evaluate.frames_per_second(trainer),
        **peak_memory(args.device),
    }


def cost(args: argparse.Namespace) -> dict[str, Any]:
    """ms per iteration of every loop, alternating, with the final Gaussians of `3dgs`."""
    loops: dict[str, Callable[[], Any]] = {}
    ended = trainer_of(args, "3dgs")
    if not ended.resume():
        ended.train()
    trainers = {m: late(trainer_of(args, m, iterations=10**6), ended.gaussians) for m in args.methods}
    loops |= {method: trainer.step for method, trainer in trainers.items()}
    loops["gsplat"] = PlainLoop(ended.gaussians, ended.data, ended.pace.learning_rates(1.0)).step
    device = torch.device(args.device)
    for step in loops.values():  # every mask once, every kernel compiled
        for _ in range(args.warm_up):
            step()
    wait(device)
    ms: dict[str, list[float]] = {name: [] for name in loops}
    for _ in range(args.turns):
        for name, step in loops.items():
            begin = time.perf_counter()
            for _ in range(BLOCK):
                step()
            wait(device)
            ms[name].append(1e3 * (time.perf_counter() - begin) / BLOCK)
    # Totals: masks are made anew in clumps, a median turn has hardly any. TURNS * BLOCK steps are four epochs
    # of the benchmark's 150 photos, in which every mask is made once.
    mean = {name: float(np.mean(values)) for name, values in ms.items()}
    against = {"3dgs": "gsplat"} | {m: "3dgs" for m in args.methods if m != "3dgs"}
    return {
        "scene": facts_of(args),
        "gaussians": len(ended.gaussians),
        "gaussians_after": {name: len(trainer.gaussians) for name, trainer in trainers.items()},
        "ms": mean,
        "ratios": {f"{a} / {b}": mean[a] / mean[b] for a, b in against.items() if a in ms},
        "turns": ms,
    }


def late(trainer: Trainer, gaussians: Gaussians) -> Trainer:
    """A trainer in the middle of its run with these Gaussians and no density control."""
    trainer.gaussians = gaussians.clone()
    trainer.optimiser = SplatAdam(trainer.gaussians, trainer.pace.learning_rates(0.5))
    trainer.iteration = trainer.config.iterations // 2  # masks have begun, all harmonics are on
    # Nothing grows, is reset or is dropped; statistics are gathered all the same.
    trainer.density.config = dataclasses.replace(
        trainer.density.config, start=1e9, stop=1e9, resets=(), min_every=10**9
    )
    return trainer


def profile(args: argparse.Namespace) -> dict[str, Any]:
    """Profile of the slowest method: kernels by total time, and launch time of the host."""
    from torch.profiler import ProfilerActivity, profile

    ended = trainer_of(args, "3dgs")
    if not ended.resume():
        ended.train()
    found = {}
    for method in args.methods:
        trainer = late(trainer_of(args, method, iterations=10**6), ended.gaussians)
        for _ in range(args.warm_up):
            trainer.step()
        wait(trainer.data.device)
        kinds = [ProfilerActivity.CPU]
        if trainer.data.device.type == "cuda":
            kinds.append(ProfilerActivity.CUDA)
        # as many steps as it takes to make every mask anew
        steps = max(BLOCK, min(4 * len(trainer.data.photos), MOST_PROFILED))
        with profile(activities=kinds) as seen:
            for _ in range(steps):
                trainer.step()
            wait(trainer.data.device)
        key = "self_cuda_time_total" if len(kinds) > 1 else "self_cpu_time_total"
        found[method] = seen.key_averages().table(sort_by=key, row_limit=25)
        print(found[method])
    return {"iterations": steps, "tables": found}


def same(args: argparse.Namespace) -> dict[str, Any]:
    """Test PSNR of CPU and GPU on the same captures, seeds 0 to 2, same iterations."""
    rows: list[dict[str, Any]] = []
    for capture, method, seed, device in itertools.product(
        args.captures, args.methods, range(3), ("cpu", args.device)
    ):
        changed = {"scene": capture, "seed": seed, "device": device, "work": args.work / capture.name}
        trainer = trainer_of(argparse.Namespace(**vars(args) | changed), method)
        trainer.resume()
        trainer.train()
        facts = {"capture": capture.name, "method": method, "seed": seed, "device": device}
        rows.append(facts | {"psnr": test_psnr(trainer), "gaussians": len(trainer.gaussians)})
        print(rows[-1], flush=True)
    gpu = args.device
    means = pd.DataFrame(rows).pivot_table(index=["capture", "method"], columns="device", values="psnr")
    gaps = [
        {"capture": c, "method": m, "cpu": row["cpu"], "gpu": row[gpu], "gap": row[gpu] - row["cpu"]}
        for (c, m), row in means.iterrows()
    ]
    return {"iterations": args.iterations, "rows": rows, "gaps": gaps}


def write(args: argparse.Namespace, stage: str, found: dict[str, Any]) -> None:
    """Results of a stage, with the environment."""
    more = {"environment": environment(args.device), "gsplat": gsplat_seam.version()}
    write_json(args.results / f"gpu-{stage}.json", found | more)


def facts_of(args: argparse.Namespace) -> dict[str, Any]:
    scene = load_scene(args.scene, verify=False)
    camera = scene.train[0].camera
    return {
        "train": len(scene.train),
        "test": len(scene.test),
        "width": camera.width,
        "height": camera.height,
        "points": len(scene.points),
        "settings": args.settings,
    }


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, help="a scene folder; simulated without")
    parser.add_argument("--work", type=Path, default=Path("gpu-benchmark"), help="scene, runs and caches")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--stages", nargs="+", default=list(STAGES), choices=(*STAGES, "same"))
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--captures", nargs="+", type=Path, default=[], help="of the stage 'same'")
    parser.add_argument("--iterations", type=int, default=30_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="METHOD.KEY=VALUE")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--warm-up", type=int, default=300, help="iterations before a loop is timed")
    parser.add_argument("--turns", type=int, default=TURNS)
    args = parser.parse_args(words)
    lack = why_not(look()) if args.device == "cuda" else None
    if lack is not None:
        parser.error(f"no GPU to measure: {lack}")
    if args.scene is None and set(args.stages) & {"train", "cost", "profile"}:
        args.scene = make_scene(args.work / "scene", name="courtyard-colour", train=150, test=20, width=582)
    args.work.mkdir(parents=True, exist_ok=True)
    stages = {
        "build": build,
        "parity": parity,
        "train": train,
        "cost": cost,
        "profile": profile,
        "same": same,
    }
    failed = False
    for name in args.stages:
        begin = time.perf_counter()
        found = stages[name](args)
        found["seconds_of_stage"] = time.perf_counter() - begin
        write(args, name, found)
        print(f"{name}: {found['seconds_of_stage']:.0f} s", flush=True)
        failed |= name == "parity" and found["passed"] < found["cases"]
        failed |= bool(found.get("failed"))
    there = {
        p.stem.removeprefix("gpu-"): json.loads(p.read_text())
        for p in sorted(args.results.glob("gpu-*.json"))
    }
    write_text(args.results / "gpu.md", to_markdown(there))
    print(to_markdown(there))
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
