"""Time of the CPU renderer: blending, the whole renderer, a training iteration; and peak memory.

    python benchmarks/rasterizer.py [--quick] [--json PATH]

Random Gaussians of 0.5 to 4 px sigma at random positions and depths, opacity 0.05 to 0.95. Prints a table
and writes benchmarks/results/rasterizer.json. Run it alone on the machine.
"""

from __future__ import annotations

import argparse
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.io.files import write_json
from ambiguous_wild.splat.calibration import warm_up
from ambiguous_wild.splat.cpu import blend
from ambiguous_wild.splat.cpu.compile import threads
from ambiguous_wild.splat.cpu.render import render_cpu
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.optim import SplatAdam

RESULTS = Path(__file__).parent / "results" / "rasterizer.json"
CASES = ((30_000, 240, 136), (100_000, 504, 378))
PEAK = (300_000, 960, 540)
RATES = {
    "means": 1e-5,
    "quats": 1e-5,
    "log_scales": 1e-5,
    "opacity_logits": 1e-5,
    "sh0": 1e-5,
    "sh_rest": 1e-6,
}


def scene(n: int, width: int, height: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """n Gaussians in view, sigma 0.5 to 4 px along each axis."""
    rng = np.random.default_rng(seed)
    focal = 0.9 * width
    z = rng.uniform(2, 10, n)
    u, v = rng.uniform(0, width, n), rng.uniform(0, height, n)
    opacity = rng.uniform(0.05, 0.95, n)
    arrays = {
        "means": np.stack([(u - width / 2) / focal * z, (v - height / 2) / focal * z, z], 1),
        "quats": rng.normal(size=(n, 4)),
        "log_scales": np.log(rng.uniform(0.5, 4, (n, 3)) * z[:, None] / focal),
        "opacity_logits": np.log(opacity / (1 - opacity)),
        "sh0": rng.normal(size=(n, 3)),
        "sh_rest": 0.1 * rng.normal(size=(n, 15, 3)),
    }
    tensors = {name: torch.from_numpy(a.astype(np.float32)) for name, a in arrays.items()}
    return Gaussians(**tensors), Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


class Stopwatch:
    """Milliseconds of named parts over many runs."""

    def __init__(self) -> None:
        self.ms: dict[str, list[float]] = {}

    def __call__(self, name: str, work: Callable[[], Any]) -> Any:
        begin = time.perf_counter()
        result = work()
        self.ms.setdefault(name, []).append(1e3 * (time.perf_counter() - begin))
        return result

    def summary(self) -> dict[str, dict[str, float]]:
        return {
            name: {"best_ms": round(min(ms), 3), "median_ms": round(float(np.median(ms)), 3)}
            for name, ms in self.ms.items()
        }


def measure(n: int, width: int, height: int, runs: int) -> dict[str, Any]:
    """Times of the parts of a training iteration, and of the two blending kernels alone."""
    gaussians, camera = scene(n, width, height)
    optimiser = SplatAdam(gaussians, RATES)
    photo = torch.from_numpy(np.random.default_rng(1).uniform(size=(height, width, 3)).astype(np.float32))
    keep = torch.ones(height, width)
    watch = Stopwatch()

    def iteration(watch: Stopwatch) -> None:
        rendered = watch("render", lambda: render_cpu(gaussians, camera))
        loss = watch("loss", lambda: photometric(rendered.image, photo, keep))
        gradients = watch("backward", lambda: rendered.backward(loss.d_image))
        watch("adam", lambda: optimiser.step(gradients, rendered.visible))

    def blending(watch: Stopwatch) -> None:
        s = render_cpu(gaussians, camera)._lists
        image = np.empty((height, width, 3), np.float32)
        alpha, depth = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
        lists = (s.tile_slots, s.starts, s.tile_order, threads(), width, height, s.background)
        watch(
            "blend forward", lambda: blend.forward(s.records, *lists, image, alpha, depth, s.kept, s.touched)
        )
        sums = np.empty(int(s.starts[-1]) * blend.ROW, np.float32)
        sums[:] = 0.0  # touches the pages, as in training, where the array is used again
        lists = (s.tile_slots, s.tile_instances, *lists[1:])
        d_image = photo.numpy()
        watch(
            "blend backward",
            lambda: blend.backward(
                s.records, *lists, s.kept, s.touched, d_image, None, None, None, None, None, sums
            ),
        )

    for warm in range(runs + 3):
        used = watch if warm >= 3 else Stopwatch()
        used("iteration", lambda used=used: iteration(used))
        blending(used)
    parts = watch.summary()
    raster = parts["render"]["median_ms"] + parts["backward"]["median_ms"]
    return {
        "gaussians": n,
        "width": width,
        "height": height,
        "runs": runs,
        "parts": parts,
        "iteration_over_rasteriser": round(parts["iteration"]["median_ms"] / raster, 3),
    }


def peak_memory(n: int, width: int, height: int) -> float:
    """Largest resident size, MiB, of a process that does three iterations (libraries included)."""
    code = (
        f"import resource, sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import rasterizer as r\n"
        f"r.measure({n}, {width}, {height}, 1)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def machine() -> dict[str, Any]:
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        model = names[0] if names else model
    return {
        "cpu": model,
        "llvm_target": llvmlite.binding.get_host_cpu_name(),
        "threads": threads(),
        "python": platform.python_version(),
        "numba": numba.__version__,
        "torch": torch.__version__,
        "threading_layer": numba.threading_layer(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="5 runs, no memory measurement")
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the figures go")
    args = parser.parse_args()
    warm_up(lambda text: print(text, file=sys.stderr))
    runs = 5 if args.quick else 30
    cases = [measure(*case, runs) for case in CASES]
    peak = None if args.quick else {"case": list(PEAK), "peak_rss_mib": round(peak_memory(*PEAK))}
    for case in cases:
        print(f"{case['gaussians']} Gaussians, {case['width']}x{case['height']}, {case['runs']} runs")
        for name, ms in case["parts"].items():
            print(f"  {name:15s} best {ms['best_ms']:8.2f} ms   median {ms['median_ms']:8.2f} ms")
        print(f"  iteration / (render + backward): {case['iteration_over_rasteriser']}")
    if peak:
        print(f"peak memory, {PEAK[0]} Gaussians at {PEAK[1]}x{PEAK[2]}: {peak['peak_rss_mib']} MiB")
    write_json(args.json, {"machine": machine(), "cases": cases, "peak": peak})
    print(f"wrote {args.json}")


if __name__ == "__main__":
    main()
