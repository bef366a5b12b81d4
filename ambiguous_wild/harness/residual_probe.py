"""Evidence that needs a render: the residual of a short run of plain 3DGS on small photos.

A render of few iterations lacks detail everywhere, but detail is signed: averaged over a window it vanishes.
A distractor in front of the scene in one photo is a patch of one sign, and stays.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import label, maximum_filter, uniform_filter

from ambiguous_wild.core import Scene
from ambiguous_wild.harness.effects_plan import Decision, Plan, answer
from ambiguous_wild.splat.data import load_train_data, shrink_keep
from ambiguous_wild.splat.effects import ALL, with_effects
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.trainer import Trainer

LONGEST = 160  # px of the probe's photos
ITERATIONS = 300
SETTLED = 1200  # iterations after which fine texture is learnt and a distractor in one photo still is not
WINDOW = 1 / 20  # of the longest side: side of the window
STANDS_OUT = 0.12  # code values of a window's mean residual, in the worst channel
TIMED_ROUNDS, TIMED_STEPS = 12, 3  # of timing an effect, after a first round
LARGE = 0.05  # of a photo: a patch above it is more than an instance

# Shares of the photos' pixels, see benchmarks/results/presets.md for what the presets give.
OCCLUSION, LOCAL, GLOBAL, ENTROPY = 0.003, 0.003, 0.05, 0.01


@dataclass(frozen=True)
class Occlusion:
    """Shares of the train photos' pixels that the probe cannot explain."""

    share: float  # of all pixels
    compact: float  # in patches below LARGE
    worst: float  # in the tenth of the photos that have most of it
    # [H, W] bool of every train photo: where the probe cannot explain it, points or not
    patches: tuple[np.ndarray, ...] = field(default=(), repr=False, compare=False)
    iterations: int = field(default=0, compare=False)  # that it took to find out


def small_data(scene: Scene, folder: Path, seed: int = 0) -> TrainData:
    """The training side with photos of LONGEST px at most."""
    data = load_train_data(scene, device=torch.device("cpu"), seed=seed, cache_dir=folder)
    photos, cameras, keeps = [], [], []
    for photo, camera, keep in zip(data.photos, data.cameras, data.user_keep):
        scale = min(1.0, LONGEST / max(photo.shape[:2]))
        size = (max(round(photo.shape[0] * scale), 8), max(round(photo.shape[1] * scale), 8))
        chw = torch.nn.functional.interpolate(photo.permute(2, 0, 1)[None], size=size, mode="area")
        photos.append(chw[0].permute(1, 2, 0).contiguous())
        cameras.append(camera.resized(size[1], size[0]))
        keeps.append(None if keep is None else _smaller(keep, size))
    return dataclasses.replace(data, photos=photos, cameras=cameras, user_keep=keeps)


def _smaller(keep: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    if tuple(keep.shape) == size:
        return shrink_keep(keep, 1)
    return -torch.nn.functional.adaptive_max_pool2d(-keep[None, None], size)[0, 0]


def unexplained(photo: np.ndarray, render: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """[H, W] bool: where a window's mean of photo - render stands out.

    Args:
        photo, render: [H, W, 3] in [0, 1].
        seen: [H, W] bool, where the model has anything to say.
    """
    side = max(round(WINDOW * max(photo.shape[:2])), 3)
    weight = uniform_filter(seen.astype(np.float64), side, mode="constant")
    signed = uniform_filter((photo - render) * seen[..., None], (side, side, 1), mode="constant")
    mean = np.abs(signed / np.maximum(weight, 1e-6)[..., None]).max(axis=2)
    return (mean > STANDS_OUT) & seen & (weight > 0.25)


def seen_by_others(scene: Scene, index: int, size: tuple[int, int]) -> np.ndarray:
    """[H, W] bool: near where a point that three photos see projects, whether or not this photo saw it.

    Elsewhere (the rim of an aerial capture, sky) few photos look and a short run has learnt nothing. All of
    it where the model has no tracks.
    """
    camera = scene.views[index].camera
    well = np.diff(scene.points.track_offsets) >= 3
    if not well.any():
        return np.ones(size, bool)
    local = scene.points.xyz[well] @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    local = local[local[:, 2] > 1e-6]
    uv = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    uv = uv * [size[1] / camera.width, size[0] / camera.height]
    columns, rows = uv[((uv >= 0) & (uv < [size[1], size[0]])).all(axis=1)].astype(int).T
    found = np.zeros(size, bool)
    found[rows, columns] = True
    return maximum_filter(found, max(round(WINDOW * max(size)), 3))


def supported(scene: Scene, index: int, size: tuple[int, int]) -> np.ndarray:
    """[H, W] bool: within a window of an SfM point that three photos see, so what stands there stands still.

    Args:
        scene: with tracks.
        index: of the view, into Scene.views.
        size: (height, width) of the map.
    """
    points, view = scene.points, scene.views[index]
    lengths = np.diff(points.track_offsets)
    rows = (points.track_views == index) & np.repeat(lengths >= 3, lengths)
    scale = np.array([size[1] / view.camera.width, size[0] / view.camera.height])
    where = (points.track_xy[rows] * scale).astype(int)
    found = np.zeros(size, bool)
    found[where[:, 1].clip(0, size[0] - 1), where[:, 0].clip(0, size[1] - 1)] = True
    return maximum_filter(found, max(round(WINDOW * max(size)), 3))


def summarise(patches: list[np.ndarray]) -> Occlusion:
    """Shares of [H, W] bool maps, one a photo."""
    shares, compact = [], []
    for patch in patches:
        labels, count = label(patch)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:] / patch.size
        shares.append(float(patch.mean()))
        compact.append(float(sizes[sizes < LARGE].sum()))
    most = sorted(shares)[-max(len(shares) // 10, 1) :]
    return Occlusion(float(np.mean(shares)), float(np.mean(compact)), float(np.mean(most)))


def occlusion(
    scene: Scene,
    effects: tuple[str, ...] = (),
    *,
    iterations: int = ITERATIONS,
    tick: Callable[[], object] | None = None,
) -> Occlusion:
    """Train the probe and measure its residual.

    Args:
        scene: the scene.
        effects: colour effects that the plan found: a photo's exposure is no distractor.
        iterations: of the probe.
        tick: called after every iteration.
    """
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as folder:
        data = small_data(scene, Path(folder))
        config = TrainConfig(iterations=iterations, probes=0, checkpoint_every_s=1e9)
        trainer = Trainer(data, with_effects(Parts(), effects), config, folder=Path(folder))

        def after(_: Trainer) -> None:
            if tick is not None:
                tick()

        trainer.train(tick=after)
        patches, counted = [], []
        places = [i for i, v in enumerate(scene.views) if v.split == "train"]
        for view, photo in enumerate(data.photos):
            rendered = trainer.make_step(trainer.iteration, view, divisor=1).rendered
            seen = rendered.alpha.numpy() > 0.5
            keep = data.user_keep[view]
            seen &= seen_by_others(scene, places[view], (photo.shape[0], photo.shape[1]))
            seen &= True if keep is None else keep.numpy() > 0.5
            patch = unexplained(photo.numpy(), np.clip(rendered.image.numpy(), 0, 1), seen)
            patches.append(patch)
            counted.append(patch & ~supported(scene, places[view], patch.shape))
        return dataclasses.replace(summarise(counted), patches=tuple(patches), iterations=iterations)


def persists(
    scene: Scene,
    effects: tuple[str, ...] = (),
    *,
    bar: Callable[..., AbstractContextManager[Any]],
) -> Occlusion:
    """What the probe cannot explain; where that is much, what one of `SETTLED` iterations cannot.

    Fine texture is learnt late, and what stands before one photo not even then.
    Drone photos of fields: 1.5 % after 300 iterations, 0.2 % after 1200; a thin thing before a courtyard 1.5
    and 1.4 %. The longer run is made only where the short one found something.

    Args:
        scene: the scene.
        effects: see `occlusion`.
        bar: called with total=iterations, a context whose `update` counts one; tqdm is one.
    """
    spent = 0
    for iterations in (ITERATIONS, SETTLED):
        with bar(total=iterations) as shown:
            found = occlusion(scene, effects, iterations=iterations, tick=shown.update)
        spent += iterations
        if found.share <= OCCLUSION:
            break
    return dataclasses.replace(found, iterations=spent)


def effect_costs(scene: Scene) -> dict[str, float]:
    """ms of CPU time an iteration that each effect adds on this machine, on the probe's photos."""
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as name:
        return step_costs(small_data(scene, Path(name)), ALL, Path(name))


def step_costs(data: TrainData, effects: Sequence[str], folder: Path) -> dict[str, float]:
    """ms of CPU time an iteration that each of the effects adds, alone.

    All take turns within every round, so that they meet the same machine; the median round counts.
    """
    config = TrainConfig(iterations=10_000, probes=0)
    trainers = {
        e: Trainer(data, with_effects(Parts(), (e,) if e else ()), config, folder=folder / e)
        for e in ("", *effects)
    }
    times: dict[str, list[float]] = {e: [] for e in trainers}
    for turn in range(TIMED_ROUNDS + 1):
        for effect, trainer in trainers.items():
            begin = time.process_time()  # of the process: other programs do not count
            for _ in range(TIMED_STEPS):
                trainer.step()
            if turn:  # the first round compiles and allocates
                times[effect].append(1e3 * (time.process_time() - begin) / TIMED_STEPS)
    plain = np.array(times[""])
    return {e: round(float(np.median(np.array(t) - plain)), 2) for e, t in times.items() if e}


def with_occlusion(plan: Plan, found: Occlusion) -> Plan:
    """The plan with the lines that the probe answers, first."""

    def line(
        effect: str, evidence: str, value: float, threshold: float, on: str, off: str, how: str
    ) -> Decision:
        decision = answer(value, threshold)
        why = on if decision == "on" else off
        return Decision(effect, evidence, value, threshold, "of the pixels", decision, why, how)

    lines = (
        line("masks", "patches a probe cannot explain", found.share, OCCLUSION,
             "something stands before the scene", "photos agree", "--mask none where off"),
        line("masks, local", "of them in patches below 5 % of a photo", found.compact, LOCAL,
             "distractors as large as instances", "none of an instance's size",
             "--set refinesplat.mask.use_local=false where off"),
        line("masks, global", "patches in the worst tenth of the photos", found.worst, GLOBAL,
             "some photos are covered widely", "no photo is covered widely",
             "--set refinesplat.mask.use_global=false where off"),
        line("entropy density", "patches a probe cannot explain", found.share, ENTROPY,
             "growth must wait for masks", "nothing to keep growth from", "--density none where off"),
    )  # fmt: skip
    return dataclasses.replace(plan, decisions=(*lines, *plan.decisions), probed=True)
