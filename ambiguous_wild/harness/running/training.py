"""Train the model of a cell, write what it renders and masks, and measure that."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.harness.pictures import training as pictures_of_training
from ambiguous_wild.harness.running import evaluate
from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.costs import both_passes, cost_of
from ambiguous_wild.harness.running.memory import is_out_of_gpu_memory, out_of_gpu_memory, reset_peak
from ambiguous_wild.harness.running.meter import Meter
from ambiguous_wild.harness.running.passes import FirstPass, first_pass, of_one_pass
from ambiguous_wild.harness.running.records import RunResult
from ambiguous_wild.harness.running.result import finished_result
from ambiguous_wild.io.atomic import atomic_dir, write_json
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.methods.fixed_masks import FixedMasks
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.run import Stopped
from ambiguous_wild.splat.trainer import Trainer

STOPPED = "stopped"  # folder of a run that Ctrl-C stopped: the model as it was then; gone when the run ends
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
        truth = evaluate.load_test_photos(cell.scene)
        first = None
        if cell.method.passes > 1:
            first = first_pass(cell, folder, cache_dir, tick)
        trainer = _make_trainer(cell, folder, cache_dir, truth, first)
        return _train_and_measure(cell, trainer, truth, tick, pictures, first)
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


def _make_trainer(
    cell: Cell, folder: Path, cache_dir: Path, truth: list[evaluate.TestPhoto], first: FirstPass | None
) -> Trainer:
    device = torch.device(cell.device)
    data = load_train_data(cell.scene, device=device, seed=cell.train.seed, cache_dir=cache_dir)
    parts = with_effects(cell.method.build(cell.options), cell.chosen.effects)
    if first is not None:
        parts = dataclasses.replace(parts, mask=FixedMasks(first.keeps))

    def probe(draw: Callable[[Camera], torch.Tensor]) -> float:
        return evaluate.mean_psnr(truth, lambda camera: draw(camera).cpu().numpy())

    before = time.perf_counter()
    train = of_one_pass(cell)
    trainer = Trainer(data, parts, train, folder=folder, probe=probe if truth else None)
    # Frozen inputs, instance masks and identities are part of what a method costs.
    trainer.setup_s = time.perf_counter() - before
    trainer.meter = Meter.of(cell.device)
    if first is not None:
        trainer.timeline.before_s = first.cost["train_s"]
    return trainer


def _train_and_measure(
    cell: Cell,
    trainer: Trainer,
    truth: list[evaluate.TestPhoto],
    tick: Tick | None,
    pictures: bool,
    first: FirstPass | None,
) -> RunResult:
    folder = trainer.folder
    trainer.resume()
    recorder = pictures_of_training.Recorder(trainer, folder) if pictures else None

    def after_iteration(trainer: Trainer) -> None:
        if recorder is not None:
            recorder(trainer)
        if tick is not None:
            tick(trainer)

    try:
        trainer.train(tick=after_iteration)
    except Stopped:
        raise Stopped(_keep_stopped(cell, trainer, truth)) from None
    shutil.rmtree(folder / STOPPED, ignore_errors=True)
    cost = cost_of(cell, trainer)  # now: what follows measures, and is no training
    if first is not None:
        cost = both_passes(first.cost, cost)
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


def _keep_stopped(cell: Cell, trainer: Trainer, truth: list[evaluate.TestPhoto]) -> str:
    """The model as it stood when Ctrl-C came, measured; returns what to tell. Ctrl-C again leaves it out."""
    folder, train = trainer.folder, cell.train
    of = f" of {train.iterations}" if train.budget_s is None else f", {train.budget_s:g} s were asked for"
    done = f"stopped after {trainer.iteration} iterations{of}"
    end = "the same command goes on"
    try:
        with atomic_dir(folder / STOPPED) as kept:
            model = {k: v.cpu().numpy() for k, v in trainer.neutral_model().items()}
            write_splat_ply(kept / "point_cloud.ply", model)
            half = cell.protocol == "half"
            rows, missing = evaluate.render_and_measure(
                trainer, truth, kept / "renders", half=half, scene=cell.scene
            )
            state = {"iteration": trainer.iteration, "train_s": trainer.clock.now()}
            write_json(kept / "measured.json", {**state, "per_image": rows, "missing": missing})
    except KeyboardInterrupt:
        return f"{done}; {end}"
    psnr = f": {np.mean([row['psnr'] for row in rows]):.2f} dB over {len(rows)} test views" if rows else ""
    return f"{done}{psnr}; model and renders in {folder / STOPPED}; {end}"


def _effect_facts(cell: Cell, trainer: Trainer) -> dict[str, Any]:
    """Which effects were on and what they learnt; empty without any."""
    facts: dict[str, Any] = {}
    if cell.protocol == "half":
        nothing = {"effects": [], "steps": 0}
        facts |= {
            "protocol": "half",
            "fitted": nothing if trainer.effects is None else trainer.effects.fitted(),
        }
    if cell.chosen.effects:
        facts["effects"] = list(cell.chosen.effects)
    return facts if trainer.effects is None else facts | {"effect_facts": trainer.effects.facts()}
