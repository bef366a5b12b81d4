"""One method on one scene with one seed: train, render the test views, measure, write the run folder."""

from __future__ import annotations

import dataclasses
import os
import shutil
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import yaml

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import flatten
from ambiguous_wild.harness import evaluate
from ambiguous_wild.harness import pictures as run_pictures
from ambiguous_wild.harness.cell import Cell, CellReport, Overwrite
from ambiguous_wild.harness.environment import environment
from ambiguous_wild.harness.identity import IGNORED
from ambiguous_wild.harness.identity import scene_identity as scene_identity  # as it always was here
from ambiguous_wild.harness.memory import (
    is_out_of_gpu_memory,
    out_of_gpu_memory,
    peak_memory,
    reset_peak,
)
from ambiguous_wild.harness.provenance import provenance
from ambiguous_wild.harness.result import result_of
from ambiguous_wild.harness.result_file import read_result, write_result
from ambiguous_wild.harness.shared_run import shared_cost, train_shared
from ambiguous_wild.io import plain_yaml
from ambiguous_wild.io.atomic import sweep, write_json, write_text
from ambiguous_wild.io.lock import folder_lock
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.methods.external.program import DONE, LOGS, WORK
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.shared import shards
from ambiguous_wild.splat.trainer import Trainer

RESULT = "metrics.json"
FAILED = "failed.json"
TRACEBACK = "traceback.txt"
EFFECTS = "effects.json"
# What a run leaves before anything worth keeping exists in its folder.
_WORTHLESS = {"config.yaml", "env.json", EFFECTS, FAILED, TRACEBACK}


def run_cell(
    cell: Cell,
    folder: Path,
    *,
    cache_dir: Path,
    overwrite: Overwrite = "missing",
    tick: Callable[[Trainer], None] | None = None,
    pictures: bool = True,
) -> CellReport:
    """Train and measure, or find that it is done.

    Args:
        cell: what to run.
        folder: the run folder.
        cache_dir: for features and instance masks shared between runs.
        overwrite: "missing" keeps a finished run and resumes a stopped one, "always" starts anew,
            "never" leaves a folder that exists as it is.
        tick: called after every iteration.
        pictures: draw what the method saw into pictures/; changes no other file.

    Raises:
        AwError: the folder holds a run of another configuration, or is in use.
    """
    folder = Path(os.path.realpath(folder))  # one lock and one place, whatever links lead to it
    if folder.exists() and overwrite == "never":
        return CellReport(folder, "skipped")
    with folder_lock(folder, f"aw bench --method {cell.method.name}"):
        if folder.exists():
            refuse_strange_folder(folder)
            if overwrite == "always":
                shutil.rmtree(folder)
            else:
                refuse_other_config(folder, cell)
                if is_finished(folder):
                    return CellReport(folder, "kept")
        folder.mkdir(parents=True, exist_ok=True)
        sweep(folder)
        for name in (FAILED, TRACEBACK):
            (folder / name).unlink(missing_ok=True)
        config = cell.config | {"config_hash": cell.identity}
        write_text(folder / "config.yaml", yaml.safe_dump(config, sort_keys=False, allow_unicode=True))
        write_json(folder / "env.json", environment(cell.device))
        cell.chosen.write(folder / EFFECTS)
        try:
            if cell.method.program is not None:
                from ambiguous_wild.harness.external import run_program

                result = run_program(cell, folder)
            else:
                result = _with_memory(cell, folder, cache_dir, tick, pictures)
            write_result(folder / RESULT, result | provenance(cell))
        except Exception as error:
            _record_failure(cell, folder, error)
            raise
    return CellReport(folder, "trained", result=result)


def is_finished(folder: Path) -> bool:
    """Whether the folder has a result that can be read; a damaged one is made again."""
    if not (folder / RESULT).is_file():
        return False
    try:
        read_result(folder / RESULT)
    except AwError:
        return False
    return True


def _record_failure(cell: Cell, folder: Path, error: Exception) -> None:
    """A run that failed says so in its folder: its error is its result."""
    if not isinstance(error, (AwError, OSError)):
        # Ours, not the user's: the whole story goes beside the run, one line into the table.
        write_text(folder / TRACEBACK, "".join(traceback.format_exception(error)))
    write_result(folder / FAILED, failed_result(cell, error_line(error)) | provenance(cell))


def error_line(error: Exception) -> str:
    """One line that says what went wrong."""
    if isinstance(error, AwError):
        return str(error)
    if isinstance(error, OSError):
        return f"{error.filename or 'input or output'}: {error.strerror or error}"
    return f"{type(error).__name__}: {error}"


def refuse_strange_folder(folder: Path) -> None:
    """Raise AwError if the folder holds something and no run of ours: it is somebody's."""
    if not folder.is_dir():
        raise AwError(f"{folder} is a file, not a run folder; choose another -o")
    names = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    if names and not names & {RESULT, FAILED, TRACEBACK} and not _is_our_config(folder / "config.yaml"):
        raise AwError(
            f"{folder} is not empty and no run of ours (no config.yaml with a config_hash); choose another -o"
        )


def _is_our_config(path: Path) -> bool:
    """Whether it is the settings of a run; a damaged one counts, one of somebody else's does not."""
    if not path.is_file():
        return False
    try:
        return "config_hash" in plain_yaml.read_mapping(path)
    except AwError:
        return True


def refuse_other_config(folder: Path, cell: Cell) -> None:
    """Raise AwError if the folder was made by another configuration; names the keys that differ."""
    path = folder / "config.yaml"
    present = {p.name for p in folder.iterdir() if not p.name.startswith(".")}
    if not (folder / WORK / DONE).exists():
        present -= {WORK, LOGS}  # of an external program that has not finished training
    if not path.exists() or present <= _WORTHLESS:
        return  # it stopped before the first checkpoint: there is nothing to lose
    try:
        old = plain_yaml.read_mapping(path)
    except AwError as error:
        raise AwError(f"{error}; start anew with --overwrite always") from None
    if old.get("config_hash") == cell.identity:
        return
    ignored = {f"{part}.{key}" for part, keys in IGNORED.items() for key in keys} | {"config_hash"}
    before, now = flatten(old), flatten(cell.config)
    names = [
        k for k in sorted(before.keys() | now.keys()) if before.get(k) != now.get(k) and k not in ignored
    ]
    shown = ", ".join(f"{k} was {before.get(k)}, is {now.get(k)}" for k in names[:4]) or "its hash"
    raise AwError(
        f"{folder} holds a run of another configuration ({shown}); "
        "choose another -o, or replace it with --overwrite always"
    )


def _with_memory(
    cell: Cell, folder: Path, cache_dir: Path, tick: Callable[[Trainer], None] | None, pictures: bool
) -> dict[str, Any]:
    """`_train_and_measure`; where the GPU's memory does not do, an AwError that says what helps."""
    made: list[Trainer] = []
    try:
        return _train_and_measure(cell, folder, cache_dir, tick, pictures, made)
    except Exception as error:
        if not is_out_of_gpu_memory(error):
            raise
        gaussians = len(made[0].gaussians) if made else None
        problem = out_of_gpu_memory(error, gaussians, cell.scene.info.get("loaded_factor"))
    # Outside of the handler, where nothing holds on to the trainer: the next cell needs its memory.
    made.clear()
    if torch.cuda.is_available():
        torch.cuda.empty_cache()
    raise problem


def _train_and_measure(
    cell: Cell,
    folder: Path,
    cache_dir: Path,
    tick: Callable[[Trainer], None] | None,
    pictures: bool,
    made: list[Trainer],  # the trainer, as soon as there is one
) -> dict[str, Any]:
    reset_peak(cell.device)
    if cell.gpus > 1:  # before photos lie on the first of them
        train_shared(cell, folder, cache_dir, tick)
    device = torch.device(cell.device)
    data = load_train_data(cell.scene, device=device, seed=cell.train.seed, cache_dir=cache_dir)
    parts = with_effects(cell.method.build(cell.options), cell.chosen.effects)
    truth = evaluate.load_test_photos(cell.scene)

    def probe(draw: Callable[[Camera], torch.Tensor]) -> float:
        return evaluate.mean_psnr(truth, lambda camera: draw(camera).cpu().numpy())

    before = time.perf_counter()
    trainer = Trainer(data, parts, cell.train, folder=folder, probe=probe if truth else None)
    made.append(trainer)
    # Frozen inputs, instance masks and identities are part of what a method costs.
    trainer.setup_s = time.perf_counter() - before
    ranks = shards.take_over(trainer, folder) if cell.gpus > 1 else []
    if not ranks:
        trainer.resume()
    recorder = run_pictures.Recorder(trainer, folder) if pictures else None

    def after_iteration(trainer: Trainer) -> None:
        if recorder is not None:
            recorder(trainer)
        if tick is not None:
            tick(trainer)

    if not ranks:
        trainer.train(tick=after_iteration)
    # now: what follows measures, and is no training
    cost = _cost(cell, trainer) | (shared_cost(cell, ranks) if ranks else {})

    write_splat_ply(
        folder / "point_cloud.ply", {k: v.cpu().numpy() for k, v in trainer.neutral_model().items()}
    )
    per_image, missing = evaluate.render_and_measure(
        trainer, truth, folder / "renders" / "test", half=cell.protocol == "half", scene=cell.scene
    )
    masks = evaluate.write_masks(trainer, folder / "masks")
    if recorder is not None:
        run_pictures.draw_all(trainer, recorder, folder)
    return result_of(
        cell,
        per_image=per_image,
        missing=missing,
        masks=masks,
        facts=trainer.parts.mask.facts()
        | {"skipped_views": trainer.skipped_views}
        | trainer.watchdog.facts()
        | _effect_facts(cell, trainer),
        cost=cost
        | evaluate.frames_per_second(trainer)
        | {"model_mb": (folder / "point_cloud.ply").stat().st_size / 1e6},
    )


def _effect_facts(cell: Cell, trainer: Trainer) -> dict[str, Any]:
    """What was on and what it learnt; nothing where there is nothing to say."""
    facts: dict[str, Any] = {} if cell.protocol == "full" else {"protocol": cell.protocol}
    if cell.chosen.effects:
        facts["effects"] = list(cell.chosen.effects)
    return facts if trainer.effects is None else facts | {"effect_facts": trainer.effects.facts()}


def _cost(cell: Cell, trainer: Trainer) -> dict[str, Any]:
    n = max(trainer.iteration, 1)
    return {
        "train_s": trainer.clock.now(),
        "setup_s": trainer.setup_s,
        "iterations": trainer.iteration,
        "ms_per_iteration": trainer.ms_per_iteration,
        "ms_parts": {name: 1e3 * seconds / n for name, seconds in trainer.clock.parts_s.items()},
        "gaussians": len(trainer.gaussians),
        **peak_memory(cell.device),
        "device": cell.device,
        "threads": _threads(),
    }


def _threads() -> int:
    import numba

    return int(numba.get_num_threads())


def failed_result(cell: Cell, error: str) -> dict[str, Any]:
    """The result of a cell that failed: its error is what it has to show."""
    return result_of(cell, status="failed", error=error)


def with_seed(config: TrainConfig, seed: int) -> TrainConfig:
    """The same training with another seed."""
    return dataclasses.replace(config, seed=seed)
