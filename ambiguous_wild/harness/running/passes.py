"""The first of two trainings: a run inside of the run's folder, of which masks and cost are kept."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.costs import cost_of
from ambiguous_wild.harness.running.meter import Meter
from ambiguous_wild.harness.running.records import Cost
from ambiguous_wild.io.atomic import atomic_dir, write_json
from ambiguous_wild.io.images import read_keep_map, write_png
from ambiguous_wild.methods.grafted_policy import GraftedPolicy
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import MaskPolicy, Parts
from ambiguous_wild.splat.trainer import Trainer

FOLDER = "first-pass"  # in the run's; holds a checkpoint while it trains, then masks/ and cost.json
COST, MASKS = "cost.json", "masks"


@dataclass(frozen=True)
class FirstPass:
    """What the second training needs of the first."""

    keeps: list[Tensor]  # of the train views, [H, W], 1 = static
    cost: Cost


def of_one_pass(cell: Cell) -> TrainConfig:
    """Length of each training: all iterations, but half of a budget, which is what the run may take."""
    budget = cell.train.budget_s
    if cell.method.passes == 1 or budget is None:
        return cell.train
    return replace(cell.train, budget_s=budget / cell.method.passes)


def check_passes(cell: Cell) -> None:
    """Raise AwError if the cell trains twice and its method has no masks."""
    if cell.method.passes > 1:
        refuse_without_masks(cell.method.base, cell.method.build(cell.options))


def refuse_without_masks(name: str, parts: Parts) -> None:
    """Raise AwError if the method's mask policy keeps everything."""
    policy = parts.mask
    own = type(policy.mask if isinstance(policy, GraftedPolicy) else policy)
    if own.keep is MaskPolicy.keep and own.predict is MaskPolicy.predict:
        raise AwError(
            f"--passes 2 trains again with the final masks, and {name} has none: "
            "choose another method, or give it masks with --mask METHOD"
        )


def first_pass(cell: Cell, folder: Path, cache_dir: Path, tick: Callable[[Any], None] | None) -> FirstPass:
    """Train the first pass, or go on with it, or read what it left."""
    place = folder / FOLDER
    if not (place / COST).is_file():
        _train(cell, place, cache_dir, tick)
    masks = [place / MASKS / Path(view.name).with_suffix(".png") for view in cell.scene.train]
    size = [(view.camera.height, view.camera.width) for view in cell.scene.train]
    keeps = [torch.from_numpy(read_keep_map(path).astype(np.float32)) for path in masks]
    for path, keep, wanted in zip(masks, keeps, size):
        if tuple(keep.shape) != wanted:
            raise AwError(
                f"{path} is {list(keep.shape)}, its photo {list(wanted)}; bench with --overwrite always"
            )
    return FirstPass(keeps, cast(Cost, json.loads((place / COST).read_text(encoding="utf-8"))))


def _train(cell: Cell, place: Path, cache_dir: Path, tick: Callable[[Any], None] | None) -> None:
    place.mkdir(parents=True, exist_ok=True)
    device = torch.device(cell.device)
    data = load_train_data(cell.scene, device=device, seed=cell.train.seed, cache_dir=cache_dir)
    parts = with_effects(cell.method.build(cell.options), cell.chosen.effects)
    before = time.perf_counter()
    trainer = Trainer(data, parts, replace(of_one_pass(cell), probes=0), folder=place)
    trainer.setup_s = time.perf_counter() - before
    trainer.meter = Meter.of(cell.device)
    trainer.resume()
    trainer.train(tick=tick)
    cost = cost_of(cell, trainer)
    shutil.rmtree(place / MASKS, ignore_errors=True)
    with atomic_dir(place / MASKS) as temporary:
        for index, view in enumerate(cell.scene.train):
            step = trainer.make_step(max(trainer.iteration, 1), index, divisor=1)
            keep = trainer.parts.mask.predict(step)
            kept = np.ones(step.photo.shape[:2], bool) if keep is None else (keep > 0.5).cpu().numpy()
            path = temporary / Path(view.name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, kept.astype(np.uint8) * 255)
    write_json(place / COST, cost)  # last: with it the pass is done
