"""Iteration time of RefineSplat against 3DGS at the same number of Gaussians.

    python benchmarks/iteration_cost.py --scene SCENE [--method refinesplat-paper] [--set KEY=VALUE]
        [--iterations 2000] [--gaussians 20000] [--json PATH]

Both train on SCENE with the same limit of Gaussians and one thread, alternating in blocks of 100
iterations, so that machine load affects them alike. Times are processor times. Only blocks after the start
of masks, with counts within 1 % of each other, are compared; a block contains all schedules: masks every
fourth visit, growth every hundredth iteration. Prints the blocks and writes
benchmarks/results/iteration-cost.json. Exits with 1 if no block can be compared.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rasterizer import machine

from ambiguous_wild.core.config import with_options
from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.cpu import set_threads
from ambiguous_wild.splat.cpu.warmup import warm_up
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.trainer import Trainer

RESULTS = Path(__file__).parent / "results" / "iteration-cost.json"
PLAIN = "3dgs"
BLOCK = 100  # iterations
SAME = 0.01  # counts may differ by this share


def blocks(
    scene_root: Path, refined: str, settings: dict[str, str], iterations: int, gaussians: int, seed: int
) -> list[dict[str, Any]]:
    """Per block and method: Gaussians and ms of processor time an iteration, without setup."""
    scene = load_scene(scene_root)
    config = TrainConfig(iterations=iterations, seed=seed, max_gaussians=gaussians, probes=0)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        trainers = {}
        for method in (PLAIN, refined):
            folder = Path(name) / method
            data = load_train_data(scene, device=torch.device("cpu"), seed=seed, cache_dir=Path(name))
            entry = get_method(method)
            options = with_options(entry.options(), settings if method == refined else {})
            trainers[method] = Trainer(data, entry.build(options), config, folder=folder)
        for done in range(BLOCK, iterations + 1, BLOCK):
            row: dict[str, Any] = {"iteration": done}
            for method, trainer in trainers.items():
                begin = time.process_time()
                for _ in range(BLOCK):
                    trainer.step()
                row[f"{method}, ms"] = 1e3 * (time.process_time() - begin) / BLOCK
                row[f"{method}, Gaussians"] = len(trainer.gaussians)
            rows.append(row)
            print("  ".join(f"{k} {v:.1f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    return rows


def compare(rows: list[dict[str, Any]], refined: str, masks_from: int) -> dict[str, Any]:
    """The ratio over the blocks that may be compared."""
    plain = PLAIN
    same = [
        row
        for row in rows
        if row["iteration"] - BLOCK >= masks_from
        and abs(row[f"{refined}, Gaussians"] - row[f"{plain}, Gaussians"])
        <= SAME * row[f"{plain}, Gaussians"]
    ]
    ms = {m: [row[f"{m}, ms"] for row in same] for m in (plain, refined)}
    ratios = np.array(ms[refined]) / np.array(ms[plain])
    return {
        "blocks": len(same),
        "ms_3dgs": round(float(np.mean(ms[plain])), 3) if same else None,
        f"ms_{refined}": round(float(np.mean(ms[refined])), 3) if same else None,
        "ratio": round(float(np.sum(ms[refined]) / np.sum(ms[plain])), 4) if same else None,
        "lowest": round(float(ratios.min()), 4) if same else None,
        "highest": round(float(ratios.max()), 4) if same else None,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--method", default="refinesplat")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--iterations", type=int, default=2000)
    parser.add_argument("--gaussians", type=int, default=20_000, help="ceiling of both")
    parser.add_argument("--masks-from", type=int, default=300, help="blocks before are not compared")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, default=RESULTS)
    args = parser.parse_args()
    warm_up(lambda text: print(text, file=sys.stderr))
    set_threads(1)  # one thread: the processor's time is then the step's
    settings = dict(text.split("=", 1) for text in args.settings)
    rows = blocks(args.scene, args.method, settings, args.iterations, args.gaussians, args.seed)
    summary = compare(rows, args.method, args.masks_from)
    write_json(
        args.json,
        {
            "machine": machine(),
            "scene": args.scene.name,
            "method": args.method,
            "settings": args.settings,
            "iterations": args.iterations,
            "ceiling": args.gaussians,
            "seed": args.seed,
            "summary": summary,
            "blocks": rows,
        },
    )
    print(summary)
    return 0 if summary["blocks"] else 1


if __name__ == "__main__":
    sys.exit(main())
