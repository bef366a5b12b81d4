"""How near the CPU trainer comes to the limits of the machine, part by part, and how its cost grows.

    python benchmarks/limits.py [--model NAME=POINT_CLOUD.ply,SCENE ...] [--quick] [--json PATH]

Measures the peak rate of fused multiply-adds and the memory bandwidth of this machine, then every part of a
training iteration: on random Gaussians of 0.5 to 4 px sigma, and with --model on trained ones as the middle
train photo of a scene sees them, at three widths. The work of a part is counted: blended pairs of Gaussian
and pixel times the operations of the inner loop, and bytes that must be read and written once. A part's share
of the limit is the larger of its two shares. Writes benchmarks/results/limits.json. Run it alone.
"""

from __future__ import annotations

import argparse
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
import torch
from job_queue import exit_code

from ambiguous_wild.core import Camera
from ambiguous_wild.harness.cell import environment
from ambiguous_wild.io.files import atomic_path, write_json
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_files import read_splats
from ambiguous_wild.splat.calibration import warm_up
from ambiguous_wild.splat.cpu import adam, bins, blend, photometric, project, reverse
from ambiguous_wild.splat.cpu.compile import parallel_kernel, threads
from ambiguous_wild.splat.cpu.cpu_render import RenderedCpu, render_cpu
from ambiguous_wild.splat.cpu.simd import fma, splat, store
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians
from ambiguous_wild.splat.losses import photometric as photometric_loss
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.viewing.model import gaussians_of

RESULTS = Path(__file__).parent / "results" / "limits.json"
RANDOM = ((30_000, 240, 136), (100_000, 504, 378), (300_000, 960, 540))
WIDTHS = (240, 480, 960)
RATES = dict.fromkeys(PARAMETERS, 1e-5) | {"sh_rest": 1e-6}
# Operations of the inner loops of blend.py for a Gaussian at a pixel, a fused multiply-add counted as two:
# forward 9 for the exponent, 14 for 2^x, 13 for blending; backward 9, 14, and 53 for the sums.
FORWARD_FLOP, BACKWARD_FLOP = 36, 76
# The kernels of each part, in the order of an iteration.
PARTS: dict[str, list[tuple[Any, str]]] = {
    "project": [(project, "project"), (project, "colours")],
    "sort": [(bins, n) for n in ("visible_slots", "depth_order", "count_tiles", "prefix", "scatter")],
    "blend forward": [(blend, "forward")],
    "L1 and SSIM": [(photometric, "photometric_cpu")],
    "blend backward": [(blend, "backward")],
    "to parameters": [(reverse, "reverse")],
    "Adam": [(adam, "dense_step"), (adam, "sparse"), (adam, "catch_up")],
}


@parallel_kernel
def _multiply_adds(workers, rounds, out):
    for worker in numba.prange(workers):
        a = splat(np.float32(0.5))
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = splat(np.float32(worker))
        for _ in range(rounds):
            s0, s1, s2, s3 = fma(s0, a, a), fma(s1, a, a), fma(s2, a, a), fma(s3, a, a)
            s4, s5, s6, s7 = fma(s4, a, a), fma(s5, a, a), fma(s6, a, a), fma(s7, a, a)
        store(out, worker * 16, s0 + s1 + s2 + s3 + s4 + s5 + s6 + s7)


@parallel_kernel
def _triad(a, b, c, parts):
    for part in numba.prange(parts):
        for k in range(part * len(a) // parts, (part + 1) * len(a) // parts):
            a[k] = b[k] + np.float32(0.5) * c[k]


def best_s(work: Callable[[], Any], runs: int = 7) -> float:
    times = []
    for _ in range(runs):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def limits() -> tuple[float, float]:
    """Peak floating-point operations and bytes to and from memory per second, on all threads."""
    workers, rounds, out = threads(), 4_000_000, np.zeros(16 * threads(), np.float32)
    flop = workers * rounds * 8 * 16 * 2 / best_s(lambda: _multiply_adds(workers, rounds, out))
    a, b, c = (np.full(1 << 25, value, np.float32) for value in (0.0, 1.0, 2.0))
    # a write reads the line first: four transfers an element
    return flop, 4 * a.nbytes / best_s(lambda: _triad(a, b, c, 8 * workers))


def random_model(n: int, width: int, height: int, seed: int = 0) -> tuple[Gaussians, Camera]:
    """n Gaussians in view, sigma 0.5 to 4 px along each axis, opacity 0.05 to 0.95."""
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
    return gaussians_of(arrays), Camera(width, height, focal, focal, width / 2, height / 2, np.eye(4))


def trained_model(text: str) -> tuple[str, Gaussians, Camera]:
    """NAME=POINT_CLOUD.ply,SCENE: the model, and the camera of the scene's middle train photo."""
    name, _, paths = text.partition("=")
    model, _, scene = paths.rpartition(",")
    train = load_scene(scene).train
    return name, gaussians_of(read_splats(Path(model)).gaussians), train[len(train) // 2].camera


class Clock:
    """Times of kernels, while they run inside of an iteration."""

    def __init__(self) -> None:
        self.rounds: list[dict[str, float]] = []

    @contextmanager
    def kernels(self) -> Iterator[None]:
        """Time the kernels of `PARTS` wherever they are called."""
        kept = [(module, name, getattr(module, name)) for ks in PARTS.values() for module, name in ks]
        for part, kernels in PARTS.items():
            for module, name in kernels:
                setattr(module, name, self._timed(part, getattr(module, name)))
        try:
            yield
        finally:
            for module, name, function in kept:
                setattr(module, name, function)

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **named: Any) -> Any:
            begin = time.perf_counter()
            result = function(*args, **named)
            self.rounds[-1][part] = self.rounds[-1].get(part, 0.0) + time.perf_counter() - begin
            return result

        return timed

    def median_ms(self) -> dict[str, float]:
        for round_ in self.rounds:
            round_["other"] = round_["iteration"] - sum(round_[part] for part in PARTS)
        names = [*PARTS, "other", "iteration"]
        return {name: 1e3 * float(np.median([r[name] for r in self.rounds])) for name in names}


def work(rendered: RenderedCpu, n: int, pixels: int) -> dict[str, tuple[float, float]]:
    """Floating-point operations and least bytes of every part that has a limit."""
    lists = rendered._lists
    drawn, entries = int(rendered.visible.sum()), int(lists.starts[-1])
    blended = int(np.unpackbits(lists.touched[:entries].view(np.uint8)).sum()) * bins.BLOCK
    return {
        "project": (0.0, 4.0 * (14 * n + (14 + 48 + 2 * 16) * drawn)),
        "blend forward": (FORWARD_FLOP * blended, 0.0),
        "L1 and SSIM": (pixels * 3.0 * (5 + 3) * 2 * 11 * 2, 0.0),
        "blend backward": (BACKWARD_FLOP * blended, 64.0 * entries),
        "to parameters": (0.0, 64.0 * entries + 4.0 * (14 * n + (14 + 48 + 16 + 45) * drawn)),
        "Adam": (0.0, 28.0 * (14 * n + 45 * drawn)),
    }


def measure(
    name: str, gaussians: Gaussians, camera: Camera, runs: int, peak: tuple[float, float]
) -> dict[str, Any]:
    """Times of the parts of an iteration, and their shares of the limit."""
    gaussians = gaussians.clone()
    width, height = camera.width, camera.height
    optimiser = SplatAdam(gaussians, RATES)
    photo = torch.from_numpy(np.random.default_rng(1).uniform(size=(height, width, 3)).astype(np.float32))
    keep, clock = torch.ones(height, width), Clock()

    def iteration() -> RenderedCpu:
        clock.rounds.append({})
        begin = time.perf_counter()
        rendered = render_cpu(gaussians, camera)
        gradients = rendered.backward(photometric_loss(rendered.image, photo, keep).d_image)
        optimiser.step(gradients, rendered.visible)
        clock.rounds[-1]["iteration"] = time.perf_counter() - begin
        return rendered

    with clock.kernels():
        for _ in range(runs + 2):
            iteration()
        rendered = iteration()
    clock.rounds = clock.rounds[3:]
    ms = clock.median_ms()
    parts: dict[str, dict[str, Any]] = {part: {"ms": round(value, 3)} for part, value in ms.items()}
    amounts = work(rendered, len(gaussians), width * height)
    for part, (flop, size) in amounts.items():
        shares = [amount / rate / (ms[part] / 1e3) for amount, rate in zip((flop, size), peak)]
        parts[part] |= {
            "share": round(max(shares), 3),
            "limit": "arithmetic" if shares[0] >= shares[1] else "memory",
        }
    blended = amounts["blend forward"][0] / FORWARD_FLOP
    best = 1e3 * min(r["iteration"] for r in clock.rounds)
    return {
        "name": name, "gaussians": len(gaussians), "width": width, "height": height, "runs": runs,
        "visible": int(rendered.visible.sum()), "entries": int(rendered._lists.starts[-1]),
        "pairs": int(blended), "best_ms": round(best, 3), "parts": parts,
        "pairs_per_s": {p: round(blended / ms[p] * 1e3) for p in ("blend forward", "blend backward")},
    }  # fmt: skip


def growth(runs: int, peak: tuple[float, float]) -> dict[str, Any]:
    """Time of an iteration by Gaussians at 480x270, and by pixels with 100 000 Gaussians; exponents."""
    counts = [(n, 480, 270) for n in (30_000, 100_000, 300_000, 1_000_000)]
    sizes = [(100_000, w, w * 9 // 16) for w in WIDTHS]
    grown: dict[str, Any] = {}
    for name, cases in {"Gaussians": counts, "pixels": sizes}.items():
        x = [n if name == "Gaussians" else w * h for n, w, h in cases]
        ms = [measure("", *random_model(*case), runs, peak)["parts"]["iteration"]["ms"] for case in cases]
        exponent = round(float(np.polyfit(np.log(x), np.log(ms), 1)[0]), 3)
        grown[name] = {"x": x, "ms": ms, "exponent": exponent}
    return grown


def draw(grown: dict[str, Any], path: Path) -> None:
    """Plot the growth, both axes logarithmic."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    figure = Figure(figsize=(7, 3), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    for axes, (name, row) in zip(figure.subplots(1, 2, sharey=True), grown.items()):
        axes.loglog(row["x"], row["ms"], "o-")
        axes.set(xlabel=name, ylabel="ms an iteration", title=f"time ~ {name}^{row['exponent']:.2f}")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.grid(alpha=0.3)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})


def peak_memory(n: int, width: int, height: int) -> float:
    """Largest resident size, MiB, of a process that does three iterations (libraries included)."""
    code = (
        f"import resource, sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import limits as m\n"
        f"m.measure('', *m.random_model({n}, {width}, {height}), 1, (1.0, 1.0))\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def machine(peak: tuple[float, float]) -> dict[str, Any]:
    return {
        "cpu": environment("cpu")["cpu"],
        "llvm_target": llvmlite.binding.get_host_cpu_name(),
        "threads": threads(),
        "python": platform.python_version(),
        "numba": numba.__version__,
        "torch": torch.__version__,
        "peak_gflops": round(peak[0] / 1e9, 1),
        "memory_gb_per_s": round(peak[1] / 1e9, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", action="append", default=[], help="NAME=POINT_CLOUD.ply,SCENE; repeatable")
    parser.add_argument("--quick", action="store_true", help="5 runs, no growth, no memory measurement")
    parser.add_argument("--json", type=Path, default=RESULTS, help="where the figures go")
    args = parser.parse_args()
    warm_up(lambda text: print(text, file=sys.stderr))
    n, width, height = RANDOM[-1]
    # first, because a child's largest size begins with that of its parent
    memory = None if args.quick else round(peak_memory(n, width, height))
    peak, runs = limits(), 5 if args.quick else 30
    print(f"peak {peak[0] / 1e9:.0f} GFLOP/s, {peak[1] / 1e9:.1f} GB/s on {threads()} threads")
    cases = [measure("random", *random_model(*case), runs, peak) for case in RANDOM]
    for text in args.model:
        name, gaussians, camera = trained_model(text)
        for width in WIDTHS:
            height = round(camera.height * width / camera.width)
            cases.append(measure(name, gaussians, camera.resized(width, height), runs, peak))
    for case in cases:
        print(
            f"\n{case['name']}: {case['gaussians']} Gaussians, {case['width']}x{case['height']}, "
            f"{case['visible']} visible, {case['pairs'] / 1e6:.1f} million pairs"
        )
        for part, row in case["parts"].items():
            share = f"{row['share']:6.0%} of {row['limit']}" if "share" in row else ""
            print(f"  {part:15s} {row['ms']:8.2f} ms  {share}")
    results: dict[str, Any] = {"machine": machine(peak), "cases": cases}
    if not args.quick:
        results["growth"] = growth(7, peak)
        results["peak_rss_mib"] = memory
        draw(results["growth"], args.json.with_suffix(".png"))
        for name, row in results["growth"].items():
            print(f"\ntime grows as {name} to the power of {row['exponent']}: {row['ms']} ms at {row['x']}")
        print(f"peak memory, {n} Gaussians at {width}x{height}: {results['peak_rss_mib']} MiB")
    write_json(args.json, results)
    print(f"wrote {args.json}")


if __name__ == "__main__":
    sys.exit(exit_code(main))
