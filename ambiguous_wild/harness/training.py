"""Train the model of a cell, once or twice; write its renders and masks, and measure them."""

from __future__ import annotations

import json
import logging
import math
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera, View
from ambiguous_wild.core.errors import counted
from ambiguous_wild.harness import evaluate, pictures
from ambiguous_wild.harness.cell import Cell, RunOptions, asked_length
from ambiguous_wild.harness.measures import ImageRow
from ambiguous_wild.harness.meter import Meter
from ambiguous_wild.harness.result_file import Cost, RunFacts, RunResult, TimeRecord
from ambiguous_wild.harness.start import started
from ambiguous_wild.io.files import atomic_dir, write_json
from ambiguous_wild.io.images import read_keep_map
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.methods.given_masks import FixedMasks, GraftedPolicy
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.run import Stopped
from ambiguous_wild.splat.trainer import Trainer

LOG = logging.getLogger(__name__)
_PROC = Path("/proc/self")
_NO_MEMORY = ("CUDA out of memory", "CUDA error: out of memory")
_SUMS = ("train_s", "cpu_s", "reference_s", "setup_s", "iterations")
_WORST_FIRST = ("contended", "unknown", "alone")
_PEAKS = ("peak_rss_mb", "peak_cuda_mb")
FOLDER = "first-pass"  # in the run folder; holds a checkpoint while it trains, then masks/ and cost.json
COST, MASKS = "cost.json", "masks"
STOPPED = "stopped"  # folder with the model as it was when Ctrl-C came; removed when the run ends


def reset_peak(device: str = "cpu") -> None:
    """Start new peaks of memory: of the process where the system can (Linux), and of a GPU."""
    if device.startswith("cuda"):
        torch.cuda.reset_peak_memory_stats(device)
    try:
        (_PROC / "clear_refs").write_text("5")
    except OSError:
        return


def peak_memory(device: str = "cpu") -> Cost:
    """Return peak_rss_mb, and on a GPU peak_cuda_mb, the most that its tensors held since `reset_peak`."""
    rss = peak_rss_mb()
    peaks: Cost = {"peak_rss_mb": rss} if math.isfinite(rss) else {}
    if device.startswith("cuda"):
        peaks["peak_cuda_mb"] = torch.cuda.max_memory_allocated(device) / 1e6
    return peaks


def peak_rss_mb() -> float:
    """Return the largest resident memory in MB since `reset_peak`.

    On macOS it counts from the start of the process; on Windows it is NaN.
    """
    try:
        for line in (_PROC / "status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    except OSError:
        pass
    try:
        import resource
    except ImportError:  # Windows
        return math.nan
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 1e6 if sys.platform == "darwin" else peak * 1024 / 1e6  # bytes there, KiB elsewhere


def is_out_of_gpu_memory(error: BaseException) -> bool:
    """Return whether a GPU had no memory left; gsplat's kernels raise a plain RuntimeError then."""
    if isinstance(error, torch.OutOfMemoryError):
        return True
    return isinstance(error, RuntimeError) and any(words in str(error) for words in _NO_MEMORY)


def out_of_gpu_memory(error: BaseException, gaussians: int | None, factor: int | None) -> AwError:
    """Return the error as one line that says what helps.

    Args:
        error: what torch raised.
        gaussians: number of Gaussians of the model then; None = there was no model yet.
        factor: N of the folder images_N that it trained on; None = not known.
    """
    match = re.search(r"Tried to allocate [\d.]+ \w+", str(error))
    request = f", {match[0][0].lower()}{match[0][1:]}" if match else ""
    size = f" with {gaussians:,} Gaussians" if gaussians else ""
    remedies = [f"--max-gaussians {max(gaussians // 2, 4)}"] if gaussians else []
    remedies.append(f"--factor {2 * (factor or 1)} (smaller photos, where the scene has them)")
    return AwError(
        f"out of GPU memory{size}{request}; what helps: {', '.join(remedies)}, a GPU with more memory, or no "
        "other program on this one"
    )


def cost_of(cell: Cell, trainer: Trainer) -> Cost:
    """Return the cost of the training that a trainer has done so far."""
    import numba

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


def both_passes(first: Cost, second: Cost) -> Cost:
    """Return the cost of two trainings that make one result: sums, means over iterations, higher peaks."""
    one, other = (cast("dict[str, float]", dict(cost)) for cost in (first, second))
    total = {name: one[name] + other[name] for name in _SUMS if name in one and name in other}
    total |= {name: max(cost[name] for cost in (one, other) if name in cost)
              for name in _PEAKS if name in one or name in other}  # fmt: skip
    share = one["iterations"] / max(total["iterations"], 1)

    def mixed(a: float, b: float) -> float:
        return share * a + (1.0 - share) * b

    total["ms_per_iteration"] = mixed(one["ms_per_iteration"], other["ms_per_iteration"])
    parts = {
        name: mixed(first["ms_parts"].get(name, 0.0), second["ms_parts"].get(name, 0.0))
        for name in {**first["ms_parts"], **second["ms_parts"]}
    }
    extra: dict[str, object] = {"ms_parts": parts, "passes": 2, "first_pass_s": first["train_s"]}
    if "timing" in first and "timing" in second:
        extra["timing"] = _both_timings(first["timing"], second["timing"], first["train_s"])
    return cast(Cost, {**second, **total, **extra})


def _both_timings(first: TimeRecord, second: TimeRecord, first_s: float) -> TimeRecord:
    """Join the records of two trainings in a row: the worse verdict, and all calibrations."""
    worse = min((first, second), key=lambda record: _WORST_FIRST.index(record["verdict"]))
    both: TimeRecord = {**second, "verdict": worse["verdict"], "reason": worse["reason"]}
    both["samples"] = [*first["samples"], *([first_s + s, kernel] for s, kernel in second["samples"])]
    both["runs"] = max(first["runs"], second["runs"])
    if "others" in first and "others" in second:
        both["others"] = max(first["others"], second["others"])
    return both


Tick = Callable[[Any], None]  # gets the `Trainer` after every iteration, with its clock stopped


@dataclass(frozen=True)
class FirstPass:
    """The masks and the cost of the first of two trainings."""

    keeps: list[Tensor]  # keep map of each train view, [H, W], 1 = static
    cost: Cost


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


def refuse_without_masks(name: str, parts: MethodHooks) -> None:
    """Raise AwError if the method's mask policy keeps every pixel."""
    policy = parts.mask.mask if isinstance(parts.mask, GraftedPolicy) else parts.mask
    kind = type(policy)
    if kind.keep is MaskPolicy.keep and kind.predict is MaskPolicy.predict:
        raise AwError(
            f"+2passes trains again with the final masks, and {name} has none: "
            "choose another method, or give it masks with --mask METHOD"
        )


def first_pass(cell: Cell, folder: Path, cache_dir: Path, tick: Tick | None) -> FirstPass:
    """Train the first pass, or resume it; if it is finished, read its masks and cost."""
    place = folder / FOLDER
    if not (place / COST).is_file():
        _train_first_pass(cell, place, cache_dir, tick)
    masks = [place / MASKS / Path(view.name).with_suffix(".png") for view in cell.scene.train]
    size = [(view.camera.height, view.camera.width) for view in cell.scene.train]
    keeps = [torch.from_numpy(read_keep_map(path).astype(np.float32)) for path in masks]
    for path, keep, wanted in zip(masks, keeps, size):
        if tuple(keep.shape) != wanted:
            raise AwError(
                f"{path} is {list(keep.shape)}, its photo {list(wanted)}; bench with --overwrite always"
            )
    return FirstPass(keeps, cast(Cost, json.loads((place / COST).read_text(encoding="utf-8"))))


def _train_first_pass(cell: Cell, place: Path, cache_dir: Path, tick: Tick | None) -> None:
    trainer = _make_trainer(replace(cell, train=replace(cell.train, probes=0)), place, cache_dir)
    trainer.resume()
    trainer.train(tick=tick)
    cost = cost_of(cell, trainer)
    shutil.rmtree(place / MASKS, ignore_errors=True)

    def keeps() -> Iterator[tuple[View, np.ndarray]]:
        for index, view in enumerate(cell.scene.train):
            step = trainer.make_step(max(trainer.iteration, 1), index, divisor=1)
            keep = trainer.parts.mask.predict(step)
            yield view, np.ones(step.photo.shape[:2], bool) if keep is None else (keep > 0.5).cpu().numpy()

    evaluate.write_keeps(cell.scene, keeps(), place / MASKS)
    write_json(place / COST, cost)  # written last: this file marks the pass as finished


def train_and_measure(cell: Cell, folder: Path, options: RunOptions, tick: Tick | None) -> RunResult:
    """Train the cell, or resume from its checkpoint; write the run's files; measure the test views.

    Raises:
        AwError: the GPU has too little memory; the error says what helps.
    """
    trainer: Trainer | None = None
    recorder: pictures.Recorder | None = None
    problem: AwError
    try:
        torch.set_default_dtype(torch.float32)  # whatever the method before this one left
        reset_peak(cell.device)
        truth = evaluate.load_test_photos(cell.scene)
        first = None
        if cell.method.passes > 1:
            first = first_pass(cell, folder, options.cache_dir, tick)
        trainer = _make_trainer(cell, folder, options.cache_dir, truth, first)
        trainer.resume()
        recorder = pictures.Recorder(trainer, folder) if options.pictures else None
        ticks = [call for call in (recorder, tick) if call is not None]

        def after_iteration(trained: Trainer) -> None:
            for call in ticks:
                call(trained)

        try:
            trainer.train(tick=after_iteration)
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
    data = load_train_data(cell.scene, device=device, seed=cell.train.seed, cache_dir=cache_dir)
    parts = started(
        with_effects(cell.method.build(cell.options), cell.chosen.effects), cell.start, cell.scene
    )
    if first is not None:
        parts = replace(parts, mask=FixedMasks(first.keeps))

    def probe(draw: Callable[[Camera], torch.Tensor]) -> float:
        return evaluate.mean_psnr(truth, lambda camera: draw(camera).cpu().numpy())

    LOG.info("finding start points" if "dense" in cell.chosen.effects else "setting up")
    before = time.perf_counter()
    trainer = Trainer(data, parts, config_of_one_pass(cell), folder=folder, probe=probe if truth else None)
    # Frozen inputs, instance masks and identities are part of what a method costs.
    trainer.setup_s = time.perf_counter() - before
    trainer.meter = Meter.of(cell.device)
    trainer.whose = {
        "hash": cell.identity,
        "about": f"{cell.method.name} on {cell.scene.name}, seed {cell.train.seed}, "
        + asked_length(cell.train),
    }
    if first is not None:
        trainer.timeline.before_s = first.cost["train_s"]
    return trainer


def _measure(
    cell: Cell,
    trainer: Trainer,
    truth: list[evaluate.TestPhoto],
    recorder: pictures.Recorder | None,
    first: FirstPass | None,
) -> RunResult:
    """Write the model, renders, masks and pictures of a trained cell; return its result."""
    folder = trainer.folder
    shutil.rmtree(folder / STOPPED, ignore_errors=True)
    trainer.check_photos_used()
    cost = cost_of(cell, trainer)  # before the measurements below, which are no training
    if first is not None:
        cost = both_passes(first.cost, cost)
    write_splat_ply(
        folder / "point_cloud.ply",
        {k: v.cpu().numpy() for k, v in trainer.neutral_model().items()},
        trainer.data.scene.place,
    )
    LOG.info("measuring %s", counted(len(truth), "test view"))
    per_image, missing = _measured_views(cell, trainer, truth, folder / "renders" / "test")
    evaluate.refuse_empty(truth, folder / "renders" / "test")
    LOG.info("drawing masks and pictures")
    masks = evaluate.write_masks(trainer, folder / "masks")
    if recorder is not None:
        pictures.draw_all(trainer, recorder, folder)
    facts = trainer.parts.mask.facts() | {"skipped_views": trainer.skipped_views} | trainer.watchdog.facts()
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
    draw = evaluate.drawn_by(trainer, half)
    return evaluate.render_and_measure(draw, truth, folder, scene=cell.scene, half=half)


def _keep_stopped(cell: Cell, trainer: Trainer, truth: list[evaluate.TestPhoto]) -> str:
    """Measure and save the model after Ctrl-C; return a message. A second Ctrl-C leaves that out."""
    folder, train = trainer.folder, cell.train
    of = f" of {train.iterations}" if train.budget_s is None else f", {train.budget_s:g} s were asked for"
    done = f"stopped after {trainer.iteration} iterations{of}"
    end = "run the same command again to resume"
    try:
        with atomic_dir(folder / STOPPED) as kept:
            model = {k: v.cpu().numpy() for k, v in trainer.neutral_model().items()}
            write_splat_ply(kept / "point_cloud.ply", model, trainer.data.scene.place)
            rows, missing = _measured_views(cell, trainer, truth, kept / "renders")
            state = {"iteration": trainer.iteration, "train_s": trainer.clock.now()}
            write_json(kept / "measured.json", {**state, "per_image": rows, "missing": missing})
    except KeyboardInterrupt:
        return f"{done}; {end}"
    psnr = f": {np.mean([row['psnr'] for row in rows]):.2f} dB over {len(rows)} test views" if rows else ""
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
