"""Time of a second image cotangent: one backward pass, two cotangents in one pass, two passes.

    python benchmarks/cotangents.py [--runs N] [--json PATH]

Uses the scene of benchmarks/rasterizer.py. The three variants alternate within every run, so that machine
load affects them alike, and each is repeated for a tenth of a second, longer than a scheduler slice. Ratios
are of the best of N. Prints a table and writes benchmarks/results/cotangents.json.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rasterizer import CASES, Stopwatch, machine, scene

from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.splat.cpu.render import render_cpu
from ambiguous_wild.splat.cpu.warmup import warm_up
from ambiguous_wild.splat.rendered import Cotangents

RESULTS = Path(__file__).parent / "results" / "cotangents.json"
WARM = 3  # runs whose times are thrown away
LEAST_MS = 100.0  # that a timed piece of work takes


def measure(n: int, width: int, height: int, runs: int) -> dict[str, Any]:
    """Milliseconds of the three variants, and their ratios to one backward pass."""
    gaussians, camera = scene(n, width, height)
    rng = np.random.default_rng(1)
    # of a mean over pixels, as a loss's is
    scale = 1.0 / (width * height)
    first, second = (
        torch.from_numpy((scale * rng.normal(size=(height, width, 3))).astype(np.float32)) for _ in range(2)
    )
    rendered = render_cpu(gaussians, camera)
    ways: dict[str, Callable[[], Any]] = {
        "one": lambda: rendered.backward(first),
        "two in one traversal": lambda: rendered.backward(Cotangents(first, second)),
        "two backwards": lambda: (rendered.backward(first), rendered.backward(second)),
    }
    probe = Stopwatch()
    for _ in range(WARM):
        probe("one", ways["one"])
    repeats = max(int(np.ceil(LEAST_MS / probe.summary()["one"]["best_ms"])), 1)
    watch = Stopwatch()
    for run in range(runs + WARM):
        used = watch if run >= WARM else Stopwatch()
        for name, way in ways.items():
            used(name, lambda way=way: [way() for _ in range(repeats)])  # type: ignore[misc]
    parts = {
        name: {kind: round(ms / repeats, 3) for kind, ms in times.items()}
        for name, times in watch.summary().items()
    }
    best = {name: ms["best_ms"] for name, ms in parts.items()}
    return {
        "gaussians": n,
        "width": width,
        "height": height,
        "runs": runs,
        "repeats": repeats,
        "parts": parts,
        "over_one": {name: round(ms / best["one"], 3) for name, ms in best.items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=30, help="timed runs a case")
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the figures go")
    args = parser.parse_args()
    warm_up(lambda text: print(text, file=sys.stderr))
    cases = [measure(*case, args.runs) for case in CASES]
    for case in cases:
        print(f"{case['gaussians']} Gaussians, {case['width']}x{case['height']}, {case['runs']} runs")
        for name, ms in case["parts"].items():
            ratio = case["over_one"][name]
            print(
                f"  {name:21s} best {ms['best_ms']:7.2f} ms, median {ms['median_ms']:7.2f} ms, x {ratio:.2f}"
            )
    write_json(args.json, {"machine": machine(), "cases": cases})
    print(f"wrote {args.json}")


if __name__ == "__main__":
    main()
