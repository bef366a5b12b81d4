"""Time that each optional effect adds to an iteration.

    python benchmarks/effects.py SCENE [--rounds N]

ms per iteration of plain 3DGS, of 3DGS with an empty effect, and with each effect. All alternate within every
round, so that machine load affects them alike; prints medians of the differences. docs/effects.md has them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from job_queue import exit_code

from ambiguous_wild.harness.mask_plan import small_data
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.calibration import warm_up
from ambiguous_wild.splat.effects import ALL, with_effects
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer


def costs(path: Path, rounds: int, steps: int = 5) -> dict[str, Any]:
    """ms per iteration of every variant."""
    warm_up(print)
    scene = load_scene(path)
    with tempfile.TemporaryDirectory() as name:
        data = small_data(scene, Path(name))
        config = TrainConfig(iterations=30_000, probes=0)
        ways = {
            "off": MethodHooks(),
            "off again": MethodHooks(),
            "idle effect": MethodHooks(effects=(Effect(),)),
        }
        ways |= {effect: with_effects(MethodHooks(), (effect,)) for effect in ALL}
        trainers = {n: Trainer(data, parts, config, folder=Path(name) / n) for n, parts in ways.items()}
        times: dict[str, list[float]] = {n: [] for n in ways}
        for turn in range(rounds + 2):
            for n, trainer in trainers.items():
                begin = time.process_time()  # of the process: other programs do not count
                for _ in range(steps):
                    trainer.step()
                if turn > 1:
                    times[n].append(1e3 * (time.process_time() - begin) / steps)
        off = np.array(times["off"])
        rows = {
            n: {
                "cpu_ms": round(float(np.median(t)), 3),
                "more_ms": round(float(np.median(np.array(t) - off)), 3),
            }
            for n, t in times.items()
        }
        same = all(
            bool((a == b).all())
            for (_, a), (_, b) in zip(
                trainers["off"].gaussians.items(), trainers["idle effect"].gaussians.items()
            )
        )
        return {
            "scene": scene.name,
            "gaussians": len(trainers["off"].gaussians),
            "same_bits": same,
            "ms": rows,
        }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--rounds", type=int, default=20)
    args = parser.parse_args()
    result = costs(args.scene, args.rounds)
    print(f"{result['scene']}, {result['gaussians']} Gaussians")
    for name, row in result["ms"].items():
        print(f"{name:14} {row['cpu_ms']:8.2f} ms {row['more_ms']:+8.2f} ms")
    print("an effect that does nothing changes no bit:", result["same_bits"])
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
