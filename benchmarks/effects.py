"""Time of optional effects, and the decisions of `aw plan` on scenes with known effects.

    python benchmarks/effects.py --cost SCENE [--rounds N]
    python benchmarks/effects.py --scenes yard=exposure,masks street= [--no-probe] [--json PATH]

--cost: ms per iteration of plain 3DGS, of 3DGS with an empty effect, and with each effect. All alternate
within every round, so that machine load affects them alike; prints medians of the differences.
--scenes: FOLDER=EFFECTS, the effects each scene was made with; prints the confusion table per effect.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import Scene
from ambiguous_wild.harness.planning.decide import Plan, plan_without_training
from ambiguous_wild.harness.planning.probe import small_data
from ambiguous_wild.harness.planning.probed import plan_with_probes
from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.cpu.warmup import warm_up
from ambiguous_wild.splat.effects import ALL, with_effects
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.trainer import Trainer

# what a scene is said to call for -> the line of the plan
LINES = {
    "masks": "masks",
    "exposure": "affine exposure",
    "appearance": "appearance embedding",
    "antialias": "antialiasing",
    "poses": "pose refinement",
    "sh": "SH degree",
}


def costs(path: Path, rounds: int, steps: int = 5) -> dict[str, Any]:
    """ms per iteration of every variant."""
    warm_up(print)
    scene = load_scene(path)
    with tempfile.TemporaryDirectory() as name:
        data = small_data(scene, Path(name))
        config = TrainConfig(iterations=30_000, probes=0)
        ways = {"off": Parts(), "off again": Parts(), "idle effect": Parts(effects=(Effect(),))}
        ways |= {effect: with_effects(Parts(), (effect,)) for effect in ALL}
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


def _probed(scene: Scene) -> Plan:
    """The plan of `aw plan`, for a run of the full length."""
    with tempfile.TemporaryDirectory() as name:
        return plan_with_probes(
            scene, TrainConfig(), Path(name), masks=True, prepare=lambda: warm_up(print), say=print
        )


def confusion(wanted: dict[Path, set[str]], probe: bool) -> dict[str, Any]:
    """Confusion counts per effect, and all decisions."""
    table: dict[str, Counter[str]] = {name: Counter() for name in LINES}
    details = {}
    for path, needs in wanted.items():
        scene = load_scene(path)
        plan = _probed(scene) if probe else plan_without_training(scene)
        found = {d.effect: d for d in plan.decisions}
        details[str(path)] = plan.plain()
        for name, line in LINES.items():
            if line in found:
                table[name][f"{'has' if name in needs else 'lacks'} it, {found[line].decision}"] += 1
    return {"table": {n: dict(c) for n, c in table.items()}, "plans": details}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cost", type=Path, metavar="SCENE")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--scenes", nargs="*", default=[], metavar="FOLDER=EFFECTS")
    parser.add_argument("--no-probe", action="store_true")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    result: dict[str, Any] = {}
    if options.cost:
        result["cost"] = costs(options.cost, options.rounds)
        for name, row in result["cost"]["ms"].items():
            print(f"{name:14} {row['cpu_ms']:8.2f} ms {row['more_ms']:+8.2f} ms")
        print("an effect that does nothing changes no bit:", result["cost"]["same_bits"])
    if options.scenes:
        wanted = {}
        for text in options.scenes:
            folder, _, names = text.partition("=")
            wanted[Path(folder)] = {n for n in names.split(",") if n}
            if unknown := wanted[Path(folder)] - LINES.keys():
                parser.error(f"{text}: no effect {', '.join(sorted(unknown))}; there is {', '.join(LINES)}")
        result["confusion"] = confusion(wanted, not options.no_probe)
        for name, counts in result["confusion"]["table"].items():
            print(f"{name:12}", ", ".join(f"{kind}: {n}" for kind, n in sorted(counts.items())))
    if options.json:
        write_json(options.json, result)


if __name__ == "__main__":
    main()
