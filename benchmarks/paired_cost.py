"""What an iteration costs against an earlier state of the code, or against another method, in turns.

    git worktree add /tmp/before COMMIT
    python benchmarks/paired_cost.py --before /tmp/before --scene SCENE... [--methods 3dgs ...] [--threads 1]
        [--iterations 1000] [--gaussians 20000] [--set KEY=VALUE ...] [--json PATH]
    python benchmarks/paired_cost.py --against 3dgs --methods refinesplat --scene SCENE... --iterations 2000

Two processes train from the same start in turns of 50 iterations; who goes first alternates, so that machine
load affects both alike. Times are of the processor, with several threads of the clock. Compared are blocks
whose counts of Gaussians differ by at most 1 %, from iteration --from on (masks begin at 250). Prints the
ratio of sums, the median ratio and peak memory; --json keeps the blocks.
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
METHODS = ("3dgs", "robustsplat", "dronesplat", "refinesplat")
BLOCK = 50  # iterations
SAME = 0.01  # share by which counts of Gaussians may differ

# Runs in a process of its own, with one state of the package on its path.
WORKER = """
import resource, sys, tempfile, time
from pathlib import Path
import torch
from ambiguous_wild.core.config import with_options
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.cpu import set_threads
from ambiguous_wild.splat.calibration import warm_up
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer

root, method = sys.argv[1:3]
iterations, gaussians, block, threads = map(int, sys.argv[3:7])
settings = dict(text.split("=", 1) for text in sys.argv[7:])
warm_up()
set_threads(threads)
now = time.process_time if threads == 1 else time.perf_counter
with tempfile.TemporaryDirectory() as name:
    data = load_train_data(load_scene(Path(root)), device=torch.device("cpu"), seed=0, cache_dir=Path(name))
    config = TrainConfig(iterations=iterations, seed=0, max_gaussians=gaussians, probes=0)
    entry = get_method(method)
    options = with_options(entry.options(), settings)
    trainer = Trainer(data, entry.build(options), config, folder=Path(name))
    for _ in sys.stdin:
        begin = now()
        for _ in range(block):
            trainer.step()
        spent = 1e3 * (now() - begin) / block
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(spent, len(trainer.gaussians), peak, flush=True)
"""


def start(tree: Path, words: list[str], threads: int) -> subprocess.Popen[str]:
    """A worker with the package of that tree."""
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": str(threads)}
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


def compare(scene: Path, method: str, args: argparse.Namespace) -> dict[str, Any]:
    """Both sides, in turns: an earlier state of the code or another method, and the method now."""
    sides = {
        "before": (args.before.resolve() if args.before else ROOT, args.against or method),
        "now": (ROOT, method),
    }
    numbers = [str(n) for n in (args.iterations, args.gaussians, BLOCK, args.threads)]
    workers, blocks = {}, {}
    for name, (tree, trained) in sides.items():
        settings = args.settings if trained == method else []
        workers[name] = start(tree, [str(scene.resolve()), trained, *numbers, *settings], args.threads)
        blocks[name] = []
    for number in range(args.iterations // BLOCK):
        for name in list(workers) if number % 2 else reversed(workers):
            blocks[name].append(turn(workers[name]))
    for worker in workers.values():
        worker.communicate()
    pairs = [
        (before[0], now[0])
        for number, (before, now) in enumerate(zip(blocks["before"], blocks["now"], strict=True))
        if number * BLOCK >= args.first and abs(now[1] - before[1]) <= SAME * before[1]
    ]
    if not pairs:
        raise SystemExit(f"{method} on {scene.name}: no block has the same number of Gaussians on both sides")
    before, now = np.array(pairs).T
    return {
        "scene": scene.name,
        "method": method,
        "against": args.against or "earlier code",
        "ms_before": round(float(before.mean()), 3),
        "ms_now": round(float(now.mean()), 3),
        "ratio_of_sums": round(float(now.sum() / before.sum()), 4),
        "median_ratio": round(float(np.median(now / before)), 4),
        "same_gaussians": [b[1] for b in blocks["before"]] == [b[1] for b in blocks["now"]],
        "peak_mib": {name: round(rows[-1][2], 1) for name, rows in blocks.items()},
        "blocks": [[round(float(b), 3), round(float(n), 3)] for b, n in pairs],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    other = parser.add_mutually_exclusive_group(required=True)
    other.add_argument("--before", type=Path, help="root of the earlier state")
    other.add_argument("--against", metavar="METHOD", help="another method of this state")
    parser.add_argument("--scene", type=Path, nargs="+", required=True)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--iterations", type=int, default=1000)
    parser.add_argument("--from", dest="first", type=int, default=0, metavar="ITERATION")
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for scene in args.scene:
        for method in args.methods:
            rows.append(compare(scene, method, args))
            print({key: value for key, value in rows[-1].items() if key != "blocks"}, flush=True)
    if args.json:
        facts = {"iterations": args.iterations, "most": args.gaussians, "threads": args.threads, "rows": rows}
        args.json.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
