"""Train the model of a cell, once or twice; write its renders and masks, and measure them.

From top to bottom: the whole run, its trainer, its measurements; then the first of two trainings.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera, View
from ambiguous_wild.core.errors import counted
from ambiguous_wild.harness import evaluate, pictures
from ambiguous_wild.harness.cell import Cell, RunOptions
from ambiguous_wild.harness.command_lines import length_text
from ambiguous_wild.harness.measures import ImageRow
from ambiguous_wild.harness.meter import Meter
from ambiguous_wild.harness.result_file import MODEL, STOPPED, Cost, RunFacts, RunResult
from ambiguous_wild.harness.run_cost import (
    cost_of,
    is_out_of_gpu_memory,
    out_of_gpu_memory,
    reset_peak,
    two_pass_cost,
)
from ambiguous_wild.harness.start import with_start
from ambiguous_wild.io.files import atomic_dir, own_json, sha256_file, write_json
from ambiguous_wild.io.images import read_keep_map
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.methods.mask_policies import FixedMasks, makes_masks
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import Stopped, Tick, train

LOG = logging.getLogger(__name__)
FOLDER = "first-pass"  # in the run folder; holds a checkpoint while it trains, then masks/ and cost.json
COST, MASKS = "cost.json", "masks"
HASHES = "masks_sha256"  # in cost.json, in the order of the train views


@dataclass(frozen=True)
class FirstPass:
    """The masks and the cost of the first of two trainings."""

    keeps: list[Tensor]  # keep map of each train view, [H, W], 1 = static
    cost: Cost


def train_and_measure(cell: Cell, folder: Path, options: RunOptions, tick: Tick | None) -> RunResult:
    """Train the cell, or resume from its checkpoint; write the run's files; measure the test views.

    Raises:
        AwError: the GPU has too little memory; the error says what helps.
    """
    trainer: Trainer | None = None
    recorder: pictures.TrainingPictures | None = None
    problem: AwError
    try:
        torch.set_default_dtype(torch.float32)  # whatever the method before this one left
        reset_peak(cell.device)
        truth = evaluate.load_test_photos(cell.scene)
        first = None
        if cell.method.passes > 1:
            first = first_pass(cell, folder, options.cache_dir, tick)
        trainer = _make_trainer(cell, folder, options.cache_dir, truth, first)
        if trainer.resume():
            LOG.info("going on after %s", counted(trainer.iteration, "iteration"))
        recorder = pictures.TrainingPictures(trainer, folder) if options.pictures else None
        ticks = [call for call in (recorder, tick) if call is not None]

        def after_iteration(trained: Trainer) -> None:
            for call in ticks:
                call(trained)

        try:
            train(trainer, tick=after_iteration)
        except Stopped:
            raise Stopped(_keep_stopped(cell, trainer, truth)) from None
        return _measure(cell, trainer, truth, recorder, first)
    except Exception as error:
        if not is_out_of_gpu_memory(error):
            raise
        gaussians = None if trainer is None else len(trainer.gaussians)
        problem = out_of_gpu_memory(error, gaussians, cell.scene.info.get("loaded_factor"))
    # Outside of the handler nothing refers to the trainer: its memory is free for the next cell.
    trainer = recorder = None
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    raise problem


def _make_trainer(
    cell: Cell,
    folder: Path,
    cache_dir: Path,
    truth: Sequence[evaluate.TestPhoto] = (),
    first: FirstPass | None = None,
) -> Trainer:
    """Return a trainer whose time is measured; without `truth` the test PSNR is not probed on the way."""
    folder.mkdir(parents=True, exist_ok=True)
    device = torch.device(cell.device)
    data = load_train_data(
        cell.scene,
        device=device,
        seed=cell.train.seed,
        cache_dir=cache_dir,
        corrections=None if cell.corrections is None else cell.corrections.masks(cell.scene),
    )
    hooks = with_start(
        with_effects(cell.method.build(cell.options), cell.chosen.effects), cell.start, cell.scene
    )
    if first is not None:
        hooks = replace(hooks, mask=FixedMasks(first.keeps))

    def probe(draw: Callable[[Camera], torch.Tensor]) -> float:
        return evaluate.mean_psnr(truth, lambda camera: draw(camera).cpu().numpy())

    LOG.info("finding start points" if "dense" in cell.chosen.effects else "setting up")
    before = time.perf_counter()
    trainer = Trainer(data, hooks, config_of_one_pass(cell), folder=folder, probe=probe if truth else None)
    # Frozen inputs, instance masks and identities are part of what a method costs.
    trainer.setup_s = time.perf_counter() - before
    trainer.meter = Meter.of(cell.device)
    trainer.run_identity = {
        "hash": cell.identity,
        "about": f"{cell.method.name} on {cell.scene.name}, seed {cell.train.seed}, "
        + length_text(cell.train.iterations, cell.train.budget_s),
    }
    trainer.continues = frozenset(earlier["config_hash"] for earlier in cell.continued)
    if first is not None:
        trainer.timeline.before_s = first.cost["train_s"]
    return trainer


def _measure(
    cell: Cell,
    trainer: Trainer,
    truth: list[evaluate.TestPhoto],
    recorder: pictures.TrainingPictures | None,
    first: FirstPass | None,
) -> RunResult:
    """Write the model, renders, masks and pictures of a trained cell; return its result."""
    folder = trainer.folder
    shutil.rmtree(folder / STOPPED, ignore_errors=True)
    trainer.check_photos_used()
    cost = cost_of(cell, trainer)  # before the measurements below, which are no training
    if first is not None:
        cost = two_pass_cost(first.cost, cost)
    _write_model(trainer, folder / "point_cloud.ply")
    LOG.info("measuring %s", counted(len(truth), "test view"))
    per_image, missing = _measured_views(cell, trainer, truth, folder / "renders" / "test")
    evaluate.refuse_empty(truth, folder / "renders" / "test")
    LOG.info("drawing masks and pictures")
    masks = evaluate.write_masks(trainer, folder / "masks")
    if recorder is not None:
        pictures.draw_all(trainer, recorder, folder)
    facts = trainer.hooks.mask.facts() | {"skipped_views": trainer.skipped_views} | trainer.watchdog.facts()
    cost |= evaluate.frames_per_second(trainer)
    cost["model_mb"] = (folder / "point_cloud.ply").stat().st_size / 1e6
    return cell.result(
        per_image=per_image,
        missing=missing,
        masks=masks,
        facts=facts | _effect_facts(cell, trainer),
        cost=cost,
    )


def _measured_views(
    cell: Cell, trainer: Trainer, truth: list[evaluate.TestPhoto], folder: Path
) -> tuple[list[ImageRow], dict[str, str]]:
    half = cell.protocol == "half"
    draw = evaluate.trained_renderer(trainer, half)
    return evaluate.render_and_measure(draw, truth, folder, scene=cell.scene, half=half)


def _write_model(trainer: Trainer, path: Path) -> None:
    model = {k: v.cpu().numpy() for k, v in trainer.neutral_model().items()}
    write_splat_ply(path, model, trainer.data.scene.transform, trainer.hooks.antialias)


def _keep_stopped(cell: Cell, trainer: Trainer, truth: list[evaluate.TestPhoto]) -> str:
    """Measure and save the model after Ctrl-C; return a message. A second Ctrl-C leaves that out."""
    folder, train = trainer.folder, cell.train
    of = f" of {train.iterations}" if train.budget_s is None else f", {train.budget_s:g} s were asked for"
    done = f"stopped after {trainer.iteration} iterations{of}"
    end = "run the same command again to resume"
    try:
        with atomic_dir(folder / STOPPED) as kept:
            _write_model(trainer, kept / MODEL)
            rows, missing = _measured_views(cell, trainer, truth, kept / "renders")
            state = {"iteration": trainer.iteration, "train_s": trainer.clock.now()}
            write_json(kept / "measured.json", {**state, "per_image": rows, "missing": missing})
    except KeyboardInterrupt:
        return f"{done}; {end}"
    psnr = (
        f": {np.mean([row['psnr'] for row in rows]):.2f} dB over {counted(len(rows), 'test view')}"
        if rows
        else ""
    )
    return f"{done}{psnr}; model and renders in {folder / STOPPED}; {end}"


def _effect_facts(cell: Cell, trainer: Trainer) -> RunFacts:
    """Return which effects were on and what they learnt; empty without any."""
    facts: RunFacts = {}
    if cell.protocol == "half":
        facts |= {"protocol": "half", "fitted": trainer.effects.fitted()}
    if cell.chosen.effects:
        facts["effects"] = list(cell.chosen.effects)
    learnt = trainer.effects.facts()
    return facts | {"effect_facts": learnt} if learnt else facts


def config_of_one_pass(cell: Cell) -> TrainConfig:
    """Return the settings of each training: all iterations, but its share of a budget for the whole run."""
    budget = cell.train.budget_s
    if cell.method.passes == 1 or budget is None:
        return cell.train
    return replace(cell.train, budget_s=budget / cell.method.passes)


def check_passes(cell: Cell) -> None:
    """Raise AwError if the cell trains twice although its method makes no masks."""
    if cell.method.passes > 1:
        refuse_without_masks(cell.method.base, cell.method.build(cell.options))


def refuse_without_masks(name: str, hooks: MethodHooks) -> None:
    """Raise AwError if the method's mask policy keeps every pixel."""
    if not makes_masks(hooks):
        raise AwError(
            f"+2passes trains again with the final masks, and {name} has none: "
            "choose another method, or give it masks with --mask METHOD"
        )


def first_pass(cell: Cell, folder: Path, cache_dir: Path, tick: Tick | None) -> FirstPass:
    """Train the first pass, or resume it; if it is finished, read its unchanged masks and its cost."""
    place = folder / FOLDER
    masks = [place / MASKS / Path(view.name).with_suffix(".png") for view in cell.scene.train]
    cost = own_json(place / COST)
    if cost.get(HASHES) != _hashes(masks):
        cost = _train_first_pass(cell, place, cache_dir, tick) | {HASHES: _hashes(masks)}
        write_json(place / COST, cost)  # written last: this file marks the pass as finished
    keeps = [torch.from_numpy(read_keep_map(path).astype(np.float32)) for path in masks]
    return FirstPass(keeps, cast(Cost, cost))


def _hashes(files: Sequence[Path]) -> list[str]:
    return [sha256_file(path) if path.is_file() else "" for path in files]


def _train_first_pass(cell: Cell, place: Path, cache_dir: Path, tick: Tick | None) -> dict[str, object]:
    trainer = _make_trainer(replace(cell, train=replace(cell.train, probes=0)), place, cache_dir)
    trainer.resume()
    train(trainer, tick=tick)
    cost = cost_of(cell, trainer)
    shutil.rmtree(place / MASKS, ignore_errors=True)

    def keeps() -> Iterator[tuple[View, np.ndarray]]:
        for index, view in enumerate(cell.scene.train):
            step = trainer.make_step(max(trainer.iteration, 1), index, downsampling=1)
            keep = trainer.hooks.mask.predict(step)
            yield view, np.ones(step.photo.shape[:2], bool) if keep is None else (keep > 0.5).cpu().numpy()

    evaluate.write_keeps(cell.scene, keeps(), place / MASKS)
    return dict(cost)
