"""Time of the check for values that are not finite: ms per iteration with and without it.

    python benchmarks/safeguards.py [--steps N] [--json PATH]

Two trainings with the same seed alternate step by step, one with the watchdog and one without, so that
machine load affects them alike; their results must be bit-identical. Times are processor times. Prints
medians, and the time of the checks alone; writes benchmarks/results/safeguards.json. Safeguards inside the
kernels (culling of NaN, the clamp, float64 in the projection) are a few of many operations and are not
measured.
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
from rasterizer import machine, scene

from ambiguous_wild.core import Camera, Points, Scene, View
from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.splat.cpu import set_threads
from ambiguous_wild.splat.cpu.render import render_cpu
from ambiguous_wild.splat.cpu.warmup import warm_up
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.trainer import Trainer

RESULTS = Path(__file__).parent / "results" / "safeguards.json"
CASES = ((1_000, 64, 36), (30_000, 240, 136))
WARM = 5  # steps whose times are thrown away


class Blind:
    """A watchdog that checks nothing."""

    def __init__(self, real: Any) -> None:
        self._real = real

    def __getattr__(self, name: str) -> Any:
        return (lambda *args, **kw: None) if name.startswith("look_at") else getattr(self._real, name)


class Timed(Blind):
    """The watchdog with a timer: ms of processor time of every check."""

    def __init__(self, real: Any) -> None:
        super().__init__(real)
        self.ms: list[float] = []

    def __getattr__(self, name: str) -> Any:
        real = getattr(self._real, name)
        if not name.startswith("look_at"):
            return real

        def timed(*args: Any, **kw: Any) -> None:
            begin = time.thread_time()  # not the process's: torch's other threads spin on after a step
            real(*args, **kw)
            self.ms.append(1e3 * (time.thread_time() - begin))

        return timed


def trainer_of(n: int, width: int, height: int, folder: Path) -> Trainer:
    """A training on two views of n random Gaussians, without density control during the benchmark."""
    gaussians, camera = scene(n, width, height)
    photo = render_cpu(gaussians, camera).image.clone().clamp(0, 1)
    views, photos, cameras = [], [], []
    for i in range(2):
        pose = np.eye(4)
        pose[0, 3] = 0.05 * i
        moved = Camera(width, height, camera.fx, camera.fy, camera.cx, camera.cy, pose)
        views.append(View(f"{i}.png", folder / f"{i}.png", moved, "train"))
        photos.append(photo)
        cameras.append(moved)
    rgb = np.random.default_rng(0).integers(0, 255, (n, 3)).astype(np.uint8)
    none = np.zeros(0, np.int32)
    points = Points(
        gaussians.means.double().numpy(),
        rgb,
        np.zeros(n),
        np.zeros(n + 1, int),
        none,
        np.zeros((0, 2), np.float32),
    )
    made = Scene(folder, "made", tuple(views), points)
    data = TrainData(made, photos, cameras, [None, None], torch.device("cpu"), 0, folder)
    return Trainer(data, Parts(), TrainConfig(iterations=1_000_000, probes=0), folder=folder)


def measure(n: int, width: int, height: int, steps: int) -> dict[str, Any]:
    """Medians of both, and whether the results are bit-identical."""
    with tempfile.TemporaryDirectory() as name:
        runs = {kind: trainer_of(n, width, height, Path(name)) for kind in ("with", "without")}
    runs["without"].watchdog = Blind(runs["without"].watchdog)  # type: ignore[assignment]
    looks = runs["with"].watchdog = Timed(runs["with"].watchdog)  # type: ignore[assignment]
    ms: dict[str, list[float]] = {kind: [] for kind in runs}
    for step in range(steps + WARM):
        for kind in sorted(runs, reverse=bool(step % 2)):  # who goes first takes turns too
            begin = time.process_time()
            runs[kind].step()
            if step >= WARM:
                ms[kind].append(1e3 * (time.process_time() - begin))
    for trainer in runs.values():
        trainer.optimiser.flush()
    same = all(
        torch.equal(t, getattr(runs["without"].gaussians, k)) for k, t in runs["with"].gaussians.items()
    )
    medians = {kind: float(np.median(values)) for kind, values in ms.items()}
    # two looks a step, loss and gradients; those at parameters are rare, and their share is of all steps
    own = float(np.sum(looks.ms[2 * WARM :])) / steps
    return {
        "gaussians": n,
        "width": width,
        "height": height,
        "steps": steps,
        "ms_with": medians["with"],
        "ms_without": medians["without"],
        "difference": medians["with"] / medians["without"] - 1,
        "ms_of_the_looks": own,
        "share_of_the_looks": own / medians["without"],
        "same_bits": same,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--json", type=Path, default=RESULTS)
    args = parser.parse_args()
    warm_up(lambda text: print(text, file=sys.stderr))
    set_threads(1)  # one thread: the processor's time is then the step's
    cases = [measure(*case, args.steps) for case in CASES]
    for c in cases:
        print(
            f"{c['gaussians']:6d} Gaussians, {c['width']}x{c['height']}: {c['ms_with']:.2f} ms with, "
            f"{c['ms_without']:.2f} ms without, {100 * c['difference']:+.1f} %; the looks alone "
            f"{c['ms_of_the_looks']:.3f} ms, {100 * c['share_of_the_looks']:.2f} %; "
            f"same bits: {c['same_bits']}"
        )
    write_json(args.json, {"machine": machine(), "cases": cases})
    return 0 if all(c["same_bits"] for c in cases) else 1


if __name__ == "__main__":
    sys.exit(main())
