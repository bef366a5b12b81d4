"""A GPU against float64 and gsplat's own loop: parity, training, milliseconds a step, frames a second.

    python benchmarks/gpu.py --scene SCENE [--methods 3dgs refinesplat] [--iterations 7000]
    python benchmarks/gpu.py --scene SCENE --count 150000

The second command needs no GPU: it runs torch's part of a step there on the CPU, with so many Gaussians and
our renderer in place of gsplat's, and lists the bytes of living tensors and the calls that a GPU would launch
(benchmarks/results/memory.md). Memory that libraries take without a tensor is not in it.

Four measurements, printed and written to benchmarks/results/gpu.json:

- parity: the hard cases of `aw stress` that apply to a GPU, against the float64 reference;
- a training of every method: seconds, Gaussians, PSNR of the test photos, frames a second, memory;
- milliseconds a step of every method and of gsplat's own loop, in turns, all with the final Gaussians of the
  first method and without density control, so that the load of the machine affects all alike;
- versions of torch and gsplat, the GPU, the alpha clamp.

Exits with 1 if a hard case fails.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from job_queue import write_section
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import environment
from ambiguous_wild.harness.evaluate import frames_per_second, load_test_photos, mean_psnr
from ambiguous_wild.harness.run_cost import peak_memory, reset_peak
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat import backend, readiness, training_loop
from ambiguous_wild.splat.backend import wait
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu_kernels import photometric_fused
from ambiguous_wild.splat.gsplat_calls import gsplat
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.stress import stress_table
from ambiguous_wild.stress.case import run

RESULTS = Path(__file__).parent / "results" / "gpu.json"
COUNTED = RESULTS.with_name("memory.md")
BLOCK = 50  # steps of a loop before the next loop has its turn


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, photo: Tensor) -> Tensor:
        l1, dssim, gradient = photometric_fused(image, photo, None, 0.2, "map")
        ctx.save_for_backward(gradient)
        return 0.8 * l1 + 0.2 * dssim

    @staticmethod
    def backward(ctx: Any, d_loss: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return d_loss * gradient, None


class PlainLoop:
    """gsplat's own loop: `rasterization`, autograd and torch's fused Adam, as in its example trainer.

    Trains copies of these Gaussians, one photo a step, spherical harmonics of degree 3, no density control.
    The loss is ours, so that SSIM takes the same time in both loops.
    """

    def __init__(self, gaussians: Gaussians, data: TrainData, rates: dict[str, float]) -> None:
        self.data, self.iteration = data, 0
        self.parameters = {name: torch.nn.Parameter(t.clone()) for name, t in gaussians.items()}
        self.optimisers = [
            torch.optim.Adam([p], lr=rates[name], eps=1e-15, fused=True)
            for name, p in self.parameters.items()
        ]

        def there(matrix: np.ndarray) -> Tensor:
            return torch.from_numpy(matrix.astype("float32"))[None].to(data.device)

        self.poses = [there(camera.cam_from_world) for camera in data.cameras]
        self.intrinsics = [there(camera.intrinsics) for camera in data.cameras]

    def step(self) -> Tensor:
        """One iteration; returns the loss, on the device."""
        view = self.iteration % len(self.data.photos)
        self.iteration += 1
        p, camera = self.parameters, self.data.cameras[view]
        picture, _, meta = gsplat().rasterization(
            means=p["means"],
            quats=p["quats"],
            scales=torch.exp(p["log_scales"]),
            opacities=torch.sigmoid(p["opacity_logits"]),
            colors=torch.cat([p["sh0"][:, None], p["sh_rest"]], dim=1),
            viewmats=self.poses[view],
            Ks=self.intrinsics[view],
            width=camera.width,
            height=camera.height,
            sh_degree=3,
            packed=False,
        )
        meta["means2d"].retain_grad()  # its density control reads it
        loss: Tensor = _Loss.apply(picture[0], self.data.photos[view])
        loss.backward()
        for optimiser in self.optimisers:
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        return loss.detach()


def trainer_of(args: argparse.Namespace, method: str, iterations: int) -> Trainer:
    """A trainer of the method on the scene, before training."""
    entry, device = get_method(method), torch.device(args.device)
    data = load_train_data(load_scene(args.scene), device=device, seed=0, cache_dir=args.work / "cache")
    config = TrainConfig(iterations=iterations, probes=0)
    return Trainer(data, entry.build(entry.options()), config, folder=args.work / f"{method}-{iterations}")


def late(trainer: Trainer, gaussians: Gaussians) -> Trainer:
    """The trainer in the middle of its run, with these Gaussians and no density control."""
    trainer.field.start_from(gaussians.clone())
    trainer.iteration = trainer.config.iterations // 2  # masks have begun, all harmonics are on
    # nothing grows, is reset or is dropped; statistics are gathered all the same
    trainer.density.config = dataclasses.replace(
        trainer.density.config, start=1e9, stop=1e9, resets=(), min_every=10**9
    )
    return trainer


def parity(args: argparse.Namespace) -> list[dict[str, Any]]:
    """The hard cases that apply to a GPU: error against float64, and the allowed error."""
    rows = [run(case, args.device).plain() for case in stress_table.CASES if "cuda" in case.devices]
    for row in rows:
        print({name: row[name] for name in ("key", "error", "tolerance", "passed")}, flush=True)
    return rows


def train(args: argparse.Namespace, method: str) -> tuple[Trainer, dict[str, Any]]:
    """A whole training, or the rest of one that was stopped, and its figures."""
    reset_peak(args.device)
    trainer = trainer_of(args, method, args.iterations)
    trainer.resume()
    training_loop.train(trainer)
    trainer.clock.settle()
    truth = load_test_photos(trainer.data.scene)
    row = {
        "method": method,
        "iterations": trainer.iteration,
        "train_s": trainer.clock.now(),
        "ms_per_iteration": trainer.ms_per_iteration,
        "ms_parts": {k: 1e3 * v / trainer.iteration for k, v in trainer.clock.parts_s.items()},
        "gaussians": len(trainer.gaussians),
        "psnr": mean_psnr(truth, lambda camera: trainer.render(camera).image.cpu().numpy()),
        **frames_per_second(trainer),
        **peak_memory(args.device),
    }
    print(row, flush=True)
    return trainer, row


def cost(args: argparse.Namespace, base: Trainer) -> dict[str, float]:
    """Milliseconds a step of every loop, the mean of all turns, with the Gaussians of `base`."""
    endless = 10**6
    trainers = {name: late(trainer_of(args, name, endless), base.gaussians) for name in args.methods}
    loops: dict[str, Callable[[], Any]] = {name: trainer.step for name, trainer in trainers.items()}
    loops["gsplat"] = PlainLoop(base.gaussians, base.data, base.run_schedule.learning_rates(1.0)).step
    for step in loops.values():  # every mask once, every kernel compiled
        for _ in range(args.warm_up):
            step()
    spent = dict.fromkeys(loops, 0.0)
    for _ in range(args.turns):
        for name, step in loops.items():
            wait(args.device)
            begin = time.perf_counter()
            for _ in range(BLOCK):
                step()
            wait(args.device)
            spent[name] += time.perf_counter() - begin
    return {name: 1e3 * seconds / (args.turns * BLOCK) for name, seconds in spent.items()}


class Tensors(TorchDispatchMode):
    """Bytes of the tensors that live, their peak and the launches in every part of a step."""

    def __init__(self) -> None:
        super().__init__()
        self.part = "set-up"
        self.living: dict[int, tuple[StorageWeakRef, int, str]] = {}
        self.peaks: dict[
            str, tuple[int, list[tuple[int, str]]]
        ] = {}  # bytes, and those of the largest tensors
        self.launches: Counter[str] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        given = {t.untyped_storage()._cdata for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)}
        made = {t.untyped_storage()._cdata: t for t in tree_leaves(out) if isinstance(t, Tensor)}
        self.living = {k: entry for k, entry in self.living.items() if not entry[0].expired()}
        for key in made.keys() - given - self.living.keys():
            storage, shape = made[key].untyped_storage(), list(made[key].shape)
            what = f"{str(made[key].dtype)[6:]} {shape} of {func._schema.name[6:]}"
            self.living[key] = StorageWeakRef(storage), storage.nbytes(), what
        # a view is no launch; what writes into its arguments is one
        self.launches[self.part] += bool(made.keys() - given) or func._schema.is_mutable
        total = sum(size for _, size, _ in self.living.values())
        if total > self.peaks.get(self.part, (-1, []))[0]:
            self.peaks[self.part] = total, [(size, what) for _, size, what in self.living.values()]
        return out

    @contextmanager
    def named(self, part: str) -> Iterator[None]:
        """Count for this part until the `with` ends."""
        before, self.part = self.part, part
        try:
            yield
        finally:
            self.part = before


def count(args: argparse.Namespace, method: str) -> list[str]:
    """Rows of a table: the parts of a step of the method, and its growth."""
    with (
        mock.patch.object(backend, "accelerated", lambda device: True),
        mock.patch.object(backend.GpuBackend, "render", backend.Backend.render),
        Tensors() as tensors,
    ):
        trainer = trainer_of(args, method, 10**6)
        photos = len(trainer.data.photos)
        rng = torch.Generator().manual_seed(0)
        rows = torch.randint(len(trainer.gaussians), (args.count,), generator=rng)
        gaussians = trainer.gaussians.select(rows)
        gaussians.means += gaussians.log_scales.exp() * torch.randn(gaussians.means.shape, generator=rng)
        gaussians.log_scales -= 1.0
        late(trainer, gaussians)
        trainer.clock.part = tensors.named  # type: ignore[method-assign]
        for _ in range(4 * photos + 1):  # every mask twice
            trainer.step()
        launches = {part: n / (4 * photos + 1) for part, n in tensors.launches.items()}
        trainer.density.config = dataclasses.replace(trainer.density.config, start=0.0, min_every=1)
        trainer.clock.part = lambda part: tensors.named("growth" if part == "density" else part)
        trainer.step()
    lines = []
    for part, (total, parts) in tensors.peaks.items():
        largest = "; ".join(f"{size / 1e6:.0f} {what}" for size, what in sorted(parts)[-3:][::-1])
        lines.append(f"| {method} | {part} | {total / 1e6:.0f} | {launches.get(part, 0):.0f} | {largest} |")
    return lines


def main(words: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--scene", type=Path, required=True, help="a scene folder, e.g. of aw build-scene")
    p.add_argument("--methods", nargs="+", default=["3dgs", "refinesplat"])
    p.add_argument("--iterations", type=int, default=7000)
    p.add_argument("--warm-up", type=int, default=300, help="steps of each loop before they are timed")
    p.add_argument("--turns", type=int, default=12, help=f"turns of {BLOCK} steps")
    p.add_argument("--work", type=Path, default=Path("gpu-benchmark"), help="checkpoints and caches")
    p.add_argument("--results", type=Path, default=RESULTS)
    p.add_argument("--count", type=int, metavar="GAUSSIANS", help="count tensors and launches, without a GPU")
    p.add_argument("--device", default="cuda", help=argparse.SUPPRESS)
    args = p.parse_args(words)
    if args.count:
        args.device = "cpu"
        head = [
            "| method | part | peak, MB | launches a step | largest tensors, MB |",
            "|---|---|---:|---:|---|",
        ]
        lines = head + [line for method in args.methods for line in count(args, method)]
        write_section(COUNTED, f"Tensors on a GPU, {args.count} Gaussians", "\n".join(lines))
        print("\n".join(lines))
        return 0
    try:
        if args.device == "cuda":
            readiness.require_gpu(readiness.gpu_facts())
        cases = parity(args)
        trained = [train(args, method) for method in args.methods]
        ms = cost(args, trained[0][0])
    except AwError as error:
        p.error(str(error))
    camera = trained[0][0].data.cameras[0]
    results = {
        "environment": environment(args.device),
        "scene": {"photos": len(trained[0][0].data.photos), "width": camera.width, "height": camera.height},
        "parity": cases,
        "trainings": [row for _, row in trained],
        "ms_a_step": ms,
        "gaussians_of_steps": len(trained[0][0].gaussians),
        "against_gsplat": {name: ms[name] / ms["gsplat"] for name in args.methods},
    }
    write_json(args.results, results)
    print(f"ms a step: {ms}; written to {args.results}")
    return int(not all(case["passed"] for case in cases))


if __name__ == "__main__":
    sys.exit(main())
