"""What the stages of `gpu.py` share; needs torch, numpy and a reader of images, no other package."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import ambiguous_wild
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.io.atomic import write_json
from ambiguous_wild.io.images import read_png_rgb, to_uint8
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.device import wait
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu import gsplat_seam
from ambiguous_wild.splat.multi_gpu.batch import BatchTrainer
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.trainer import Trainer

# the paper's: DINOv2 features, read by both entropy losses; without the losses masks read no features at all
DINO = "refinesplat-dinov2"
VARIANTS: dict[str, tuple[str, dict[str, str]]] = {
    DINO: ("refinesplat", {"features": "dinov2-small", "lambda_id": "1", "lambda_cr": "0.2"})
}
BATCHES = {"3dgs-2-views": 2, "3dgs-4-views": 4}  # photos a step
VARIANTS |= {name: ("3dgs", {}) for name in BATCHES}
FPS_ROUNDS, FPS_SECONDS = 5, 2.0


def method_of(name: str) -> str:
    """The method behind a name of `--methods`."""
    return VARIANTS.get(name, (name, {}))[0]


def trainer_of(args: argparse.Namespace, name: str, **config: Any) -> Trainer:
    """A trainer of a method, or of a variant of one, on the scene, before training."""
    config = {"iterations": args.iterations, "seed": args.seed, "probes": 0} | config
    method, options = VARIANTS.get(name, (name, {}))
    for setting in args.settings:
        whose, _, rest = setting.partition(".")
        if whose == method:
            key, _, value = rest.partition("=")
            options = options | {key: value}
    entry = get_method(method)
    chosen = with_options(entry.options(), options, method) if options else entry.options()
    device = torch.device(args.device)
    data = load_train_data(
        load_scene(args.scene, verify=False), device=device, seed=args.seed, cache_dir=args.work / "cache"
    )
    folder = folder_of(args, name)
    if "budget_s" in config:
        folder = folder.with_name(f"{folder.name}-{config['budget_s']:g}s")
    views = BATCHES.get(name)
    if views is not None:
        return BatchTrainer(data, entry.build(chosen), TrainConfig(**config), views=views, folder=folder)
    return Trainer(data, entry.build(chosen), TrainConfig(**config), folder=folder)


def folder_of(args: argparse.Namespace, name: str) -> Path:
    """Checkpoint and timeline of the training of a method."""
    place: Path = args.work / f"{name}-{args.seed}-{args.device}-{args.iterations}"
    return place


def ended(args: argparse.Namespace, name: str) -> Trainer:
    """The trainer at the end of its training, which goes on from its last checkpoint."""
    trainer = trainer_of(args, name)
    trainer.resume()
    trainer.train()
    return trainer


def late(trainer: Trainer, gaussians: Gaussians) -> Trainer:
    """A trainer in the middle of its run with these Gaussians and no density control."""
    trainer.gaussians = gaussians.clone()
    trainer.optimiser = SplatAdam(trainer.gaussians, trainer.pace.learning_rates(0.5))
    trainer.iteration = trainer.config.iterations // 2  # masks have begun, all harmonics are on
    # Nothing grows, is reset or is dropped; statistics are gathered all the same.
    trainer.density.config = dataclasses.replace(
        trainer.density.config, start=1e9, stop=1e9, resets=(), min_every=10**9
    )
    return trainer


@torch.no_grad()
def test_psnr(trainer: Trainer) -> float:
    """Mean PSNR over the test photos in dB, from 8-bit images, as `aw bench` measures it."""
    values = []
    for view in trainer.data.scene.test:
        drawn = to_uint8(trainer.render(view.camera).image.cpu().numpy()).astype(np.float64)
        error = float(np.mean((drawn - read_png_rgb(view.image_path)) ** 2))
        values.append(math.inf if error == 0 else 10 * math.log10(255.0**2 / error))
    return float(np.mean(values))


@torch.no_grad()
def frames_per_second(trainer: Trainer) -> dict[str, float]:
    """Median, slowest and fastest of several rounds over the test views, after a warm-up."""
    cameras = [v.camera for v in (trainer.data.scene.test or trainer.data.scene.train)]
    for camera in cameras[:3]:
        trainer.render(camera)
    wait(trainer.data.device)
    rounds = []
    for _ in range(FPS_ROUNDS):
        frames, begin, seconds = 0, time.perf_counter(), 0.0
        while seconds < FPS_SECONDS / FPS_ROUNDS:
            trainer.render(cameras[frames % len(cameras)])
            wait(trainer.data.device)
            frames += 1
            seconds = time.perf_counter() - begin
        rounds.append(frames / seconds)
    return {"fps": float(np.median(rounds)), "fps_low": min(rounds), "fps_high": max(rounds)}


def random_dino(folder: Path) -> Path:
    """A checkpoint of DINOv2 ViT-S/14 with random weights, made once: it takes the time of the real one.

    Raises:
        AwError: transformers is not installed.
    """
    place = folder / "dinov2-small"
    if (place / "model.safetensors").is_file():
        return folder
    try:
        from transformers import Dinov2Config, Dinov2Model
    except ImportError:
        raise AwError(
            f"{DINO} needs transformers, which is not installed: pip install transformers"
        ) from None
    torch.manual_seed(0)
    config = Dinov2Config(
        hidden_size=384,
        num_hidden_layers=12,
        num_attention_heads=6,
        mlp_ratio=4,
        image_size=518,
        patch_size=14,
    )
    Dinov2Model(config).save_pretrained(place)
    return folder


class Notes:
    """Finished parts of a stage, kept on disk: a stage that was stopped goes on after the last of them."""

    def __init__(self, args: argparse.Namespace, stage: str) -> None:
        known = {
            name: str(getattr(args, name))
            for name in ("scene", "iterations", "seed", "settings", "device", "warm_up", "turns", "budget")
        }
        key = json.dumps([stage, known, _code()], sort_keys=True)
        self.stage = stage
        self.path = args.work / "notes" / f"{stage}-{hashlib.sha256(key.encode()).hexdigest()[:12]}.json"
        self.rows: dict[str, Any] = {}
        if self.path.is_file():
            self.rows = json.loads(self.path.read_text(encoding="utf-8"))

    def get(self, name: str, make: Callable[[], Any]) -> Any:
        """The row of that name, made and written unless it is there."""
        if name in self.rows:
            words = [Path(word).name for word in name.split()]  # of a row of `same` the first is a folder
            print(f"{self.stage}: {' '.join(words)} was finished before", flush=True)
        else:
            self.rows[name] = make()
            self.path.parent.mkdir(parents=True, exist_ok=True)
            write_json(self.path, self.rows)
        return self.rows[name]


def _code() -> str:
    """Of all source files: figures of other code are not gone on with."""
    root = Path(ambiguous_wild.__file__).parent
    digest = hashlib.sha256()
    for path in sorted([*root.rglob("*.py"), *Path(__file__).parent.glob("gpu*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def write(args: argparse.Namespace, stage: str, found: dict[str, Any]) -> None:
    """Results of a stage, with the environment."""
    more = {"environment": environment(args.device), "gsplat": gsplat_seam.version()}
    args.results.mkdir(parents=True, exist_ok=True)
    write_json(args.results / f"gpu-{stage}.json", found | more)


def facts_of(args: argparse.Namespace) -> dict[str, Any]:
    scene = load_scene(args.scene, verify=False)
    camera = scene.train[0].camera
    return {
        "train": len(scene.train),
        "test": len(scene.test),
        "width": camera.width,
        "height": camera.height,
        "points": len(scene.points),
        "settings": args.settings,
    }
