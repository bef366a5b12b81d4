"""A cell whose model several GPUs share: a process for each GPU trains, this process measures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.harness.running import evaluate
from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.memory import is_out_of_gpu_memory, out_of_gpu_memory
from ambiguous_wild.harness.running.records import Cost
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.multi_gpu.launch import Tell, launch
from ambiguous_wild.splat.multi_gpu.ranks import Ranks
from ambiguous_wild.splat.multi_gpu.refuse import refuse
from ambiguous_wild.splat.multi_gpu.run import Progress, train_rank
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts


def check_multi_gpu(cell: Cell) -> None:
    """Raise AwError, one line, where several GPUs cannot train the cell."""
    if cell.gpus == 1:
        return
    if cell.method.program is not None:
        raise AwError(f"--gpus {cell.gpus}: {cell.method.name} is a program of its own; leave --gpus out")
    if cell.device != "cuda":
        raise AwError(f"--gpus {cell.gpus} is of GPUs: leave it out, or give --device cuda")
    refuse(_parts(cell), cell.train, cell.gpus)


def train_multi_gpu(
    cell: Cell, folder: Path, cache_dir: Path, tick: Callable[[Any], None] | None, backend: str = "nccl"
) -> None:
    """Train the cell on its GPUs, or go on; then the whole model lies in the folder (`shards.take_over`)."""

    def heard(message: Progress) -> None:
        if tick is not None:
            tick(
                SimpleNamespace(
                    config=cell.train,
                    iteration=min(message.iteration, cell.train.iterations),
                    done=message.done,
                    ms_per_iteration=message.ms_per_iteration,
                    gaussians=range(message.gaussians),
                    progress=lambda iteration: iteration / cell.train.iterations,
                )
            )

    order = (cell.scene, _parts(cell), cell.train, folder, cache_dir)
    launch(cell.gpus, train_cell_rank, order, backend=backend, heard=heard, logs=folder)


def train_cell_rank(
    ranks: Ranks, tell: Tell, scene: Scene, parts: Parts, train: TrainConfig, folder: Path, cache_dir: Path
) -> None:
    """One rank of it."""
    data = load_train_data(scene, device=ranks.device, seed=train.seed, cache_dir=cache_dir)
    truth = evaluate.load_test_photos(scene)

    def probe(draw: Callable[[Camera], torch.Tensor]) -> float:
        return evaluate.mean_psnr(truth, lambda camera: draw(camera).cpu().numpy())

    try:
        train_rank(ranks, tell, data, parts, train, folder, probe if truth else None)
    except Exception as error:
        if not is_out_of_gpu_memory(error):
            raise
        raise out_of_gpu_memory(error, None, scene.info.get("loaded_factor")) from None


def _parts(cell: Cell) -> Parts:
    return with_effects(cell.method.build(cell.options), cell.chosen.effects)


def multi_gpu_cost(cell: Cell, ranks: list[dict[str, Any]]) -> Cost:
    """What several GPUs change in the cost: their number, and the most that any of them held."""
    cost: Cost = {"gpus": cell.gpus}
    peaks = [rank["peak_cuda_mb"] for rank in ranks if "peak_cuda_mb" in rank]
    if peaks:
        cost["peak_cuda_mb"] = max(peaks)
    return cost
