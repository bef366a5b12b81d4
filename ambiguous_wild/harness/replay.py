"""Restore the trainer of a run: after its last step, or where a value was not finite."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import from_plain
from ambiguous_wild.harness.start import recorded_start, with_start
from ambiguous_wild.harness.trained_models import open_scene
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.corrections import CORRECTIONS, CorrectionsFile
from ambiguous_wild.io.files import own_json
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.watchdog import FOLDER, GOOD, REPORT, NonFinite


@dataclass(frozen=True)
class Replay:
    """The finding that the run reported, and the one of the replay."""

    reported: str
    reproduced: str  # "" = the replay met no such value
    started_at: int  # iteration

    @property
    def matches(self) -> bool:
        return self.reported == self.reproduced


def replay_run(run: Path) -> Replay:
    """Train a copy of the run from its last good state to where it failed; the run itself stays as it is.

    Args:
        run: a run folder with `nonfinite/` in it; the first finding is replayed.

    Raises:
        AwError: the run has no finding, its method is gone, its scene is gone or changed, or a file is
            damaged.
    """
    findings = sorted(p.parent for p in (run / FOLDER).glob(f"*/{REPORT}"))
    if not findings:
        raise AwError(f"{run} holds no {FOLDER}/*/{REPORT}: all its values were finite; name another run")
    report, config = own_json(findings[0] / REPORT), plain_yaml.read_mapping(run / "config.yaml")
    try:
        last, message = int(report["iteration"]), str(report["message"])
    except (KeyError, TypeError) as error:
        raise AwError(f"{run} cannot be replayed: its report is damaged: no {error}") from None
    with tempfile.TemporaryDirectory(prefix="aw-replay-") as name:
        trainer = _trainer(run, config, Path(name), findings[0] / GOOD)
        start = trainer.iteration
        try:
            while trainer.iteration < last:
                trainer.step()
            trainer.check_parameters()  # the training loop does so before it saves
        except NonFinite as error:
            return Replay(message, str(error), start)
    return Replay(message, "", start)


def open_run(run: Path | str) -> Trainer:
    """Return the trainer of a run as it was when the run was last saved, to look into it.

    `trainer.hooks.mask.predict(trainer.make_step(trainer.iteration, view, 1))` is the keep map of a train
    photo, at its own size. Nothing is written to the run.

    Raises:
        AwError: the folder is no run, its method is gone, its scene is gone or changed, or a file is damaged.
    """
    run = Path(run)
    if not (run / "config.yaml").is_file():
        raise AwError(f"{run} is no run of 'aw bench': it holds no config.yaml")
    saved = run / "checkpoint" / "last.safetensors"
    if not saved.is_file():
        raise AwError(f"{run} holds no checkpoint: run 'aw bench' again")
    folder = tempfile.TemporaryDirectory(prefix="aw-open-")
    trainer = _trainer(run, plain_yaml.read_mapping(run / "config.yaml"), Path(folder.name), saved)
    weakref.finalize(trainer, folder.cleanup)  # the folder lives as long as the trainer
    return trainer


def _trainer(run: Path, config: dict[Any, Any], folder: Path, saved: Path) -> Trainer:
    """Return the run's trainer as it was saved, or before its first step, with its files in `folder`."""
    try:
        method, device, options = config["method"], torch.device(config["device"]), config["options"]
        train = config["train"]
    except (KeyError, TypeError, RuntimeError) as error:
        what = str(error).splitlines()[0]
        raise AwError(f"{run} cannot be opened: its config.yaml is damaged (at {what})") from None
    try:
        entry = get_method(method)
    except AwError:
        raise AwError(
            f"{run} was trained by {method}, with a method or masks of yours: files are not loaded from a "
            "run's record; in Python, registry.load_reference('FILE.py:NAME' or 'masks:FOLDER') loads them"
        ) from None
    if entry.passes > 1:
        raise AwError(
            f"{run} was trained twice, the second time with the masks in {run / 'masks'}: look there"
        )
    hooks = entry.build(from_plain(type(entry.options()), options, f"options of {run}"))
    hooks = with_effects(hooks, tuple(config.get("effects", ())))
    settings = replace(from_plain(TrainConfig, train, f"train of {run}"), on_nonfinite="stop")
    scene = open_scene(run)
    corrections = CorrectionsFile.of(run / CORRECTIONS) if config.get("corrections") else None
    data = load_train_data(
        scene,
        device=device,
        seed=settings.seed,
        cache_dir=folder / "cache",
        corrections=None if corrections is None else corrections.masks(scene),
    )
    hooks = with_start(hooks, recorded_start(config.get("start")), scene)
    trainer = Trainer(data, hooks, settings, folder=folder)
    if saved.is_file():
        trainer.checkpoint_path.parent.mkdir(parents=True)
        shutil.copyfile(saved, trainer.checkpoint_path)
        trainer.resume()
    return trainer
