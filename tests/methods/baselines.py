"""What the tests of the baselines share: a trainer on the tiny scene and one step at hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from ambiguous_wild.core.config import with_options
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train
from tests.tiny_scene import TRAIN


def data_of(scene: Path, cache: Path, seed: int = 0) -> TrainData:
    return load_train_data(load_scene(scene), device=torch.device("cpu"), seed=seed, cache_dir=cache)


def parts_of(method: str, **options: str) -> MethodHooks:
    entry = get_method(method)
    return entry.build(with_options(entry.options(), options))


def trainer_of(
    scene: Path, folder: Path, parts: MethodHooks, iterations: int = 120, seed: int = 0, *, behind: int = 0
) -> Trainer:
    data = data_of(scene, folder.parent / "cache", seed)
    info = {**data.scene.info, "background": [behind] * 3}
    data = replace(data, scene=replace(data.scene, info=info))
    config = TrainConfig(iterations=iterations, seed=seed, probes=0, checkpoint_every_s=1e9, torch_threads=1)
    return Trainer(data, parts, config, folder=folder)


def trained(scene: Path, folder: Path, parts: MethodHooks, iterations: int = 120, seed: int = 0) -> Trainer:
    trainer = trainer_of(scene, folder, parts, iterations, seed)
    train(trainer)
    return trainer


def step_of(
    data: TrainData, view: int, image: torch.Tensor, *, iteration: int = 1000, nominal: float = 10_000.0
) -> Step:
    """A step whose render is `image`; no Gaussians."""
    photo = data.photos[view]
    downsampling = photo.shape[0] // image.shape[0]
    rendered = SimpleNamespace(image=image, alpha=torch.ones(image.shape[:2]))
    return Step(
        iteration=iteration,
        nominal=nominal,
        view=view,
        downsampling=downsampling,
        growth_cap=1000,
        photo=photo[::downsampling, ::downsampling].contiguous(),
        camera=data.cameras[view].resized(image.shape[1], image.shape[0]),
        rendered=rendered,  # type: ignore[arg-type]
        gaussians=None,  # type: ignore[arg-type]
    )


def masked_more_inside(trainer: Trainer) -> tuple[float, float]:
    """Mean keep on the red squares, and elsewhere."""
    inside, outside = [], []
    for view in range(len(TRAIN)):
        keep = trainer.hooks.mask.predict(trainer.make_step(trainer.iteration, view)).numpy()
        square = np.zeros(keep.shape, bool)
        square[14:26, 14 + 4 * view : 26 + 4 * view] = True
        inside.append(keep[square].mean()), outside.append(keep[~square].mean())
    return float(np.mean(inside)), float(np.mean(outside))
