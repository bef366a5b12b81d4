"""Train the model of a cell, write what it renders and masks, and measure that."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import torch

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.harness.pictures import training as pictures_of_training
from ambiguous_wild.harness.running import evaluate
from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.memory import (
    is_out_of_gpu_memory,
    out_of_gpu_memory,
    peak_memory,
    reset_peak,
)
from ambiguous_wild.harness.running.meter import Meter
from ambiguous_wild.harness.running.multi_gpu import multi_gpu_cost, train_multi_gpu
from ambiguous_wild.harness.running.records import Cost, RunResult
from ambiguous_wild.harness.running.result import finished_result
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.multi_gpu import shards
from ambiguous_wild.splat.trainer import Trainer

Tick = Callable[[Any], None]  # gets the `Trainer` after every iteration, with its clock stopped


def train_and_measure(
    cell: Cell, folder: Path, cache_dir: Path, tick: Tick | None, pictures: bool
) -> RunResult:
    """Train the cell, or go on from its checkpoint; write the run's files; measure the test views.

    Raises:
        AwError: the GPU has too little memory; says what helps.
    """
    trainer: Trainer | None = None
    problem: AwError
    try:
        reset_peak(cell.device)
        if cell.gpus > 1:  # before photos lie on the first of them
            train_multi_gpu(cell, folder, cache_dir, tick)
        truth = evaluate.load_test_photos(cell.scene)
        trainer = _make_trainer(cell, folder, cache_dir, truth)
        return _train_and_measure(cell, trainer, truth, tick, pictures)
    except Exception as error:
        if not is_out_of_gpu_memory(error):
            raise
        gaussians = None if trainer is None else len(trainer.gaussians)
        problem = out_of_gpu_memory(error, gaussians, cell.scene.info.get("loaded_factor"))
    # Outside of the handler nothing refers to the trainer: its memory is free for the next cell.
    trainer = None
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    raise problem


def _make_trainer(cell: Cell, folder: Path, cache_dir: Path, truth: list[evaluate.TestPhoto]) -> Trainer:
    device = torch.device(cell.device)
    data = load_train_data(cell.scene, device=device, seed=cell.train.seed, cache_dir=cache_dir)
    parts = with_effects(cell.method.build(cell.options), cell.chosen.effects)

    def probe(draw: Callable[[Camera], torch.Tensor]) -> float:
        return evaluate.mean_psnr(truth, lambda camera: draw(camera).cpu().numpy())

    before = time.perf_counter()
    trainer = Trainer(data, parts, cell.train, folder=folder, probe=probe if truth else None)
    # Frozen inputs, instance masks and identities are part of what a method costs.
    trainer.setup_s = time.perf_counter() - before
    if cell.gpus == 1:
        trainer.meter = Meter(cell.device, int(numba.get_num_threads()) if cell.device == "cpu" else 1)
    return trainer


def _train_and_measure(
    cell: Cell, trainer: Trainer, truth: list[evaluate.TestPhoto], tick: Tick | None, pictures: bool
) -> RunResult:
    folder = trainer.folder
    ranks = shards.take_over(trainer, folder) if cell.gpus > 1 else []
    if not ranks:
        trainer.resume()
    recorder = pictures_of_training.Recorder(trainer, folder) if pictures else None

    def after_iteration(trainer: Trainer) -> None:
        if recorder is not None:
            recorder(trainer)
        if tick is not None:
            tick(trainer)

    if not ranks:
        trainer.train(tick=after_iteration)
    cost = _cost(cell, trainer)  # now: what follows measures, and is no training
    if ranks:
        cost |= multi_gpu_cost(cell, ranks)
    write_splat_ply(
        folder / "point_cloud.ply", {k: v.cpu().numpy() for k, v in trainer.neutral_model().items()}
    )
    per_image, missing = evaluate.render_and_measure(
        trainer, truth, folder / "renders" / "test", half=cell.protocol == "half", scene=cell.scene
    )
    masks = evaluate.write_masks(trainer, folder / "masks")
    if recorder is not None:
        pictures_of_training.draw_all(trainer, recorder, folder)
    facts = trainer.parts.mask.facts() | {"skipped_views": trainer.skipped_views} | trainer.watchdog.facts()
    cost |= evaluate.frames_per_second(trainer)
    cost["model_mb"] = (folder / "point_cloud.ply").stat().st_size / 1e6
    return finished_result(
        cell,
        per_image=per_image,
        missing=missing,
        masks=masks,
        facts=facts | _effect_facts(cell, trainer),
        cost=cost,
    )


def _effect_facts(cell: Cell, trainer: Trainer) -> dict[str, Any]:
    """Which effects were on and what they learnt; empty without any."""
    facts: dict[str, Any] = {} if cell.protocol == "full" else {"protocol": cell.protocol}
    if cell.chosen.effects:
        facts["effects"] = list(cell.chosen.effects)
    return facts if trainer.effects is None else facts | {"effect_facts": trainer.effects.facts()}


def _cost(cell: Cell, trainer: Trainer) -> Cost:
    n = max(trainer.iteration, 1)
    cost: Cost = {
        "train_s": trainer.clock.now(),
        "cpu_s": trainer.clock.cpu_s,
        "setup_s": trainer.setup_s,
        "iterations": trainer.iteration,
        "ms_per_iteration": trainer.ms_per_iteration,
        "ms_parts": {name: 1e3 * seconds / n for name, seconds in trainer.clock.parts_s.items()},
        "gaussians": len(trainer.gaussians),
    }
    if isinstance(trainer.meter, Meter):
        cost |= trainer.meter.cost(trainer.clock.now())
    cost |= peak_memory(cell.device)
    cost["device"] = cell.device
    cost["threads"] = int(numba.get_num_threads())
    return cost
