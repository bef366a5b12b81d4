"""What an iteration of each method costs now against an earlier state of the code, in turns on one machine.

    git worktree add /tmp/before COMMIT
    python benchmarks/paired_cost.py --before /tmp/before --scene SCENE... [--methods 3dgs ...] [--threads 1]
        [--iterations 1000] [--gaussians 20000] [--json PATH]

Two processes train the same method from the same start, one with each state of the package, in turns of
50 iterations; who goes first alternates. Times are of the processor, with several threads of the clock.
Prints the ratio of sums and of the medians, and peak memory; writes benchmarks/results/paired-cost.json.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results" / "paired-cost.json"
METHODS = ("3dgs", "robustsplat", "dronesplat", "refinesplat")
BLOCK = 50  # iterations

# Runs in a process of its own, with one state of the package on its path.
WORKER = """
import resource, sys, tempfile, time
from pathlib import Path
import torch
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.cpu import set_threads
from ambiguous_wild.splat.cpu.warmup import warm_up
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.trainer import Trainer

root, method, iterations, gaussians, block, threads = sys.argv[1], sys.argv[2], *map(int, sys.argv[3:])
warm_up()
set_threads(threads)
now = time.process_time if threads == 1 else time.perf_counter
with tempfile.TemporaryDirectory() as name:
    data = load_train_data(load_scene(Path(root)), device=torch.device("cpu"), seed=0, cache_dir=Path(name))
    config = TrainConfig(iterations=iterations, seed=0, max_gaussians=gaussians, probes=0)
    entry = get_method(method)
    trainer = Trainer(data, entry.build(entry.options()), config, folder=Path(name))
    for _ in sys.stdin:
        begin = now()
        for _ in range(block):
            trainer.step()
        spent = 1e3 * (now() - begin) / block
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(spent, len(trainer.gaussians), peak, flush=True)
"""


def start(tree: Path, words: list[str]) -> subprocess.Popen[str]:
    """A worker with the package of that tree."""
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": words[-1]}
    return subprocess.Popen(
        [sys.executable, "-c", WORKER, *words],
        env=environment, cwd=tree, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def turn(worker: subprocess.Popen[str]) -> tuple[float, int, float]:
    """One block: ms an iteration, Gaussians, peak memory in MiB."""
    assert worker.stdin is not None and worker.stdout is not None
    worker.stdin.write("go\n")
    worker.stdin.flush()
    line = worker.stdout.readline()
    if not line:
        raise SystemExit(f"a worker stopped with exit code {worker.wait()}")
    ms, gaussians, peak = line.split()
    return float(ms), int(gaussians), float(peak)


def compare(trees: dict[str, Path], scene: Path, method: str, args: argparse.Namespace) -> dict[str, Any]:
    """Both states of one method, in turns."""
    words = [str(scene.resolve()), method]
    words += [str(n) for n in (args.iterations, args.gaussians, BLOCK, args.threads)]
    workers = {name: start(tree, words) for name, tree in trees.items()}
    blocks: dict[str, list[tuple[float, int, float]]] = {name: [] for name in trees}
    for number in range(args.iterations // BLOCK):
        for name in list(workers) if number % 2 else reversed(workers):
            blocks[name].append(turn(workers[name]))
    for worker in workers.values():
        worker.communicate()
    ms = {name: np.array([block[0] for block in rows]) for name, rows in blocks.items()}
    before, now = ms["before"], ms["now"]
    return {
        "scene": scene.name,
        "method": method,
        "ms_before": round(float(before.mean()), 3),
        "ms_now": round(float(now.mean()), 3),
        "ratio_of_sums": round(float(now.sum() / before.sum()), 4),
        "median_ratio": round(float(np.median(now / before)), 4),
        "same_gaussians": [b[1] for b in blocks["before"]] == [b[1] for b in blocks["now"]],
        "peak_mib": {name: round(rows[-1][2], 1) for name, rows in blocks.items()},
        "blocks": [[round(float(b), 3), round(float(n), 3)] for b, n in zip(before, now)],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, required=True, help="root of the earlier state")
    parser.add_argument("--scene", type=Path, nargs="+", required=True)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path, default=RESULTS)
    args = parser.parse_args()
    trees = {"before": args.before.resolve(), "now": ROOT}
    rows = []
    for scene in args.scene:
        for method in args.methods:
            rows.append(compare(trees, scene, method, args))
            print({key: value for key, value in rows[-1].items() if key != "blocks"}, flush=True)
    facts = {
        "iterations": args.iterations, "ceiling": args.gaussians, "threads": args.threads, "rows": rows,
    }  # fmt: skip
    args.json.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
