"""The stages of `gpu.py`."""

from __future__ import annotations

import argparse
import functools
import gc
import importlib.util
import itertools
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gpu_graph import GraphLoop
from gpu_measure import (
    BATCHES,
    DINO,
    Notes,
    ended,
    facts_of,
    folder_of,
    frames_per_second,
    late,
    method_of,
    test_psnr,
    trainer_of,
    write,
)
from gpu_plain import PlainLoop

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.harness.running.memory import peak_memory, reset_peak
from ambiguous_wild.splat.device import wait
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu import gsplat_seam
from ambiguous_wild.splat.gpu.options import using
from ambiguous_wild.splat.gpu.readiness import look, make_ready
from ambiguous_wild.splat.render import render

BLOCK = 50  # iterations
MOST_PROFILED = 600  # steps
OPTIONS = {  # variants of a step, see splat/gpu/options.py
    "3dgs, tiles=last-visit": {"tiles": "last-visit"},
    "3dgs, harmonics=split": {"harmonics": "split"},
    "3dgs, both": {"tiles": "last-visit", "harmonics": "split"},
}

# What a stage needs beyond torch, gsplat, numpy, safetensors and a reader of images, by method or stage
MODULES = {
    "refinesplat": ("scipy", "cv2"),
    DINO: ("scipy", "cv2", "transformers"),
    "parity": ("scipy", "cv2", "numba"),
    "same": ("scipy", "cv2", "numba"),
}


def missing(name: str) -> list[str]:
    """Modules that a stage, a method or a variant of one needs and that are not installed."""
    name = name if name in MODULES else method_of(name)
    return [m for m in MODULES.get(name, ()) if importlib.util.find_spec(m) is None]


def build(args: argparse.Namespace) -> dict[str, Any]:
    """gsplat's kernels, compiled or loaded, and a first picture."""
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
    """GPU stress tests against float64: all of them, or those of rendering where little is installed."""
    from ambiguous_wild.stress.case import run

    lacks = missing("parity")
    if lacks:
        from ambiguous_wild.stress.render_cases import CASES
    else:
        from ambiguous_wild.stress.table import CASES
    notes, rows = Notes(args, "parity"), []
    for one in CASES:
        if "cuda" in one.devices:
            rows.append(notes.get(one.key, lambda one=one: run(one, args.device).plain()))
            print({k: rows[-1][k] for k in ("key", "error", "tolerance", "passed")}, flush=True)
    passed = sum(row["passed"] for row in rows)
    why = f"rendering alone: {', '.join(lacks)} not installed" if lacks else ""
    return {"passed": passed, "cases": len(rows), "rows": rows, "left_out": why}


def train(args: argparse.Namespace) -> dict[str, Any]:
    """Whole trainings; a failed method is reported and the others are kept."""
    notes, rows, failed = Notes(args, "train"), [], {}
    found = {"scene": facts_of(args), "iterations": args.iterations, "rows": rows, "failed": failed}
    for method in args.methods:
        gc.collect()  # the trainer before this one
        if args.device == "cuda":
            torch.cuda.empty_cache()
        try:
            rows.append(notes.get(method, lambda method=method: _train_one(args, method)))
            print({k: v for k, v in rows[-1].items() if k != "ms_parts"}, flush=True)
        except Exception as error:  # whatever it is, what was measured before it is kept
            failed[method] = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            print(f"{method} failed: {traceback.format_exc()}", flush=True)
        write(args, "train", found)
    # of calls before this one
    others = [row for name, row in notes.rows.items() if name not in args.methods]
    rows.extend(others)
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
        **frames_per_second(trainer),
        **peak_memory(args.device),
    }


def budget(args: argparse.Namespace) -> dict[str, Any]:
    """Trainings of a number of seconds, with the defaults of `--budget`: coarse to fine, fewer Gaussians."""
    notes = Notes(args, "budget")
    methods = [method for method in args.methods if method not in BATCHES]  # which count photos, not seconds
    rows = [notes.get(method, lambda method=method: _budget_one(args, method)) for method in methods]
    for row in rows:
        print(row, flush=True)
    return {"scene": facts_of(args), "budget_s": args.budget, "rows": rows}


def _budget_one(args: argparse.Namespace, method: str) -> dict[str, Any]:
    trainer = trainer_of(args, method, budget_s=args.budget)
    trainer.resume()
    trainer.train()
    return {
        "method": method,
        "iterations": trainer.iteration,
        "train_s": trainer.clock.now(),
        "gaussians": len(trainer.gaussians),
        "psnr": test_psnr(trainer),
    }


def cost(args: argparse.Namespace) -> dict[str, Any]:
    """ms per iteration (a photo) of every loop, alternating, with the final Gaussians of `3dgs`.

    Needs the training of `3dgs`; makes it where it is absent. `3dgs` is always among the loops, and gsplat's
    own loop is measured twice: as it is, and without the host's wait that its `torch.inverse` makes.
    """
    base = ended(args, "3dgs")
    names = list(dict.fromkeys(["3dgs", *args.methods]))
    trainers = {name: late(trainer_of(args, name, iterations=10**6), base.gaussians) for name in names}
    loops: dict[str, Callable[[], Any]] = {name: trainer.step for name, trainer in trainers.items()}
    for name, changes in OPTIONS.items():
        variant = late(trainer_of(args, "3dgs", iterations=10**6), base.gaussians)
        loops[name] = functools.partial(_with, changes, variant.step)
    rates = base.pace.learning_rates(1.0)
    for name, waits in (("gsplat", True), ("gsplat, no wait", False)):
        loops[name] = PlainLoop(base.gaussians, base.data, rates, waits=waits).step
    device, left_out = torch.device(args.device), {}
    try:
        captured = GraphLoop(base.gaussians, base.data, rates, capture=device.type == "cuda")
        loops["3dgs, CUDA graph"] = captured.step
    except (AwError, RuntimeError) as error:  # a variant must not cost the other figures
        left_out["3dgs, CUDA graph"] = str(error).splitlines()[0]
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
            photos = BLOCK * BATCHES.get(name, 1)
            ms[name].append(1e3 * (time.perf_counter() - begin) / photos)
    # Totals: masks are made anew in clumps, a median turn has hardly any. TURNS * BLOCK steps are four epochs
    # of the benchmark's 150 photos, in which every mask is made once.
    mean = {name: float(np.mean(values)) for name, values in ms.items()}
    pairs = [("3dgs", "gsplat"), ("3dgs", "gsplat, no wait")]
    pairs += [(name, "3dgs") for name in loops if name != "3dgs" and not name.startswith("gsplat")]
    return {
        "scene": facts_of(args),
        "gaussians": len(base.gaussians),
        "gaussians_after": {name: len(trainer.gaussians) for name, trainer in trainers.items()},
        "ms": mean,
        "ratios": {f"{a} / {b}": mean[a] / mean[b] for a, b in pairs},
        "turns": ms,
        "left_out": left_out,
    }


def _with(changes: dict[str, str], step: Callable[[], Any]) -> Any:
    with using(**changes):
        return step()


def profile(args: argparse.Namespace) -> dict[str, Any]:
    """Kernels by total time and launches of the host, of every method. Needs `3dgs` as `cost` does."""
    base, notes = ended(args, "3dgs"), Notes(args, "profile")
    tables = {m: notes.get(m, lambda m=m: _profile_one(args, m, base.gaussians)) for m in args.methods}
    return {"iterations": {m: t["steps"] for m, t in tables.items()},
            "tables": {m: t["table"] for m, t in tables.items()}}  # fmt: skip


def _profile_one(args: argparse.Namespace, method: str, gaussians: Gaussians) -> dict[str, Any]:
    from torch.profiler import ProfilerActivity, profile

    trainer = late(trainer_of(args, method, iterations=10**6), gaussians)
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
    table = seen.key_averages().table(sort_by=key, row_limit=25)
    print(table, flush=True)
    return {"steps": steps, "table": table}


def same(args: argparse.Namespace) -> dict[str, Any]:
    """Test PSNR of CPU and GPU on the same captures, seeds 0 to 2, same iterations."""
    notes, rows = Notes(args, "same"), []
    captures = args.captures or [args.scene]
    for capture, method, seed, device in itertools.product(
        captures, args.methods, range(3), ("cpu", args.device)
    ):
        key = f"{capture.resolve()} {method} {seed} {device} {args.device}"
        rows.append(notes.get(key, lambda a=(capture, method, seed, device): _same_one(args, *a)))
        print(rows[-1], flush=True)
    gaps = []
    for capture, method in itertools.product(captures, args.methods):
        of = {
            device: float(np.mean([
                r["psnr"] for r in rows
                if (r["capture"], r["method"], r["device"]) == (capture.name, method, device)
            ]))
            for device in ("cpu", args.device)
        }  # fmt: skip
        here, there = of["cpu"], of[args.device]
        gaps.append(
            {"capture": capture.name, "method": method, "cpu": here, "gpu": there, "gap": there - here}
        )
    return {"iterations": args.iterations, "rows": rows, "gaps": gaps}


def _same_one(args: argparse.Namespace, capture: Path, method: str, seed: int, device: str) -> dict[str, Any]:
    changed = {"scene": capture, "seed": seed, "device": device, "work": args.work / "same" / capture.name}
    trainer = ended(argparse.Namespace(**vars(args) | changed), method)
    facts = {"capture": capture.name, "method": method, "seed": seed, "device": device}
    return facts | {"psnr": test_psnr(trainer), "gaussians": len(trainer.gaussians)}


STAGES: dict[str, Callable[[argparse.Namespace], dict[str, Any]]] = {
    "build": build,
    "parity": parity,
    "train": train,
    "budget": budget,
    "cost": cost,
    "profile": profile,
    "same": same,
}


def needs(args: argparse.Namespace, stage: str) -> str:
    """One line: what a stage needs of those before it, and whether it is there."""
    if stage not in ("cost", "profile"):
        return ""
    said = f"{stage} needs 3dgs trained for {args.iterations} iterations"
    if "3dgs" in Notes(args, "train").rows:
        return f"{said}: found"
    begun = (folder_of(args, "3dgs") / "checkpoint" / "last.safetensors").is_file()
    return f"{said}: {'has a checkpoint, goes on from there' if begun else 'absent, trained first'}"


def lacking(stages: list[str], methods: list[str]) -> list[str]:
    """One line for each stage or method that cannot run here; parity runs what it can."""
    names = dict.fromkeys([*methods, *(s for s in stages if s == "same")])
    return [
        f"{name} needs {', '.join(lacks)}, which this machine lacks"
        for name in names
        if (lacks := missing(name))
    ]
