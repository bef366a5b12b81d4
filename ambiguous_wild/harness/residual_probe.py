"""Find distractors by the residual of a short run of plain 3DGS on small photos.

A render after few iterations lacks detail everywhere, but errors in detail have both signs and cancel in the
mean over a window. A distractor in one photo is a patch of one sign, which remains.
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

LONGEST = 160  # px, longer side of the probe's photos
ITERATIONS = 300
SETTLED = 1200  # iterations after which fine texture is learnt, but a distractor in one photo is not
WINDOW = 1 / 20  # side of the window, of the photo's longer side
STANDS_OUT = 0.12  # of the colour range: mean residual of a window in the worst channel
TIMED_ROUNDS, TIMED_STEPS = 12, 3  # to time an effect, after a first round
LARGE = 0.05  # of a photo: a larger patch is more than one instance

# Limits, as shares of the photos' pixels; benchmarks/results/presets.md lists the values of the presets.
OCCLUSION, LOCAL, GLOBAL, ENTROPY = 0.003, 0.003, 0.05, 0.01


@dataclass(frozen=True)
class Occlusion:
    """Shares of the train photos' pixels that the probe cannot explain."""

    share: float  # of all pixels
    compact: float  # in patches below LARGE
    worst: float  # in the tenth of the photos with the largest shares
    # [H, W] bool of every train photo: unexplained pixels, those near static points included
    patches: tuple[np.ndarray, ...] = field(default=(), repr=False, compare=False)
    iterations: int = field(default=0, compare=False)  # of all probes that were needed


def small_data(scene: Scene, folder: Path, seed: int = 0) -> TrainData:
    """Load the training data with photos of at most LONGEST px."""
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
    """Return where a window's mean of photo - render is large, [H, W] bool.

    Args:
        photo, render: [H, W, 3] in [0, 1].
        seen: [H, W] bool, pixels that are compared.
    """
    side = max(round(WINDOW * max(photo.shape[:2])), 3)
    weight = uniform_filter(seen.astype(np.float64), side, mode="constant")
    signed = uniform_filter((photo - render) * seen[..., None], (side, side, 1), mode="constant")
    mean = np.abs(signed / np.maximum(weight, 1e-6)[..., None]).max(axis=2)
    return (mean > STANDS_OUT) & seen & (weight > 0.25)


def seen_by_others(scene: Scene, index: int, size: tuple[int, int]) -> np.ndarray:
    """Return the pixels near projections of points with three observations or more, [H, W] bool.

    Elsewhere (the rim of an aerial capture, sky) few photos look, and a short run has learnt nothing. All
    pixels are True if the model has no tracks.
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
    near = np.zeros(size, bool)
    near[rows, columns] = True
    return maximum_filter(near, max(round(WINDOW * max(size)), 3))


def supported(scene: Scene, index: int, size: tuple[int, int]) -> np.ndarray:
    """Return the pixels within a window of an SfM point that this and two other photos see, [H, W] bool.

    What is visible there is static.

    Args:
        scene: a scene with tracks.
        index: index of the view in Scene.views.
        size: (height, width) of the map.
    """
    points, view = scene.points, scene.views[index]
    lengths = np.diff(points.track_offsets)
    rows = (points.track_views == index) & np.repeat(lengths >= 3, lengths)
    scale = np.array([size[1] / view.camera.width, size[0] / view.camera.height])
    where = (points.track_xy[rows] * scale).astype(int)
    near = np.zeros(size, bool)
    near[where[:, 1].clip(0, size[0] - 1), where[:, 0].clip(0, size[1] - 1)] = True
    return maximum_filter(near, max(round(WINDOW * max(size)), 3))


def summarise(patches: list[np.ndarray]) -> Occlusion:
    """Compute the shares of maps [H, W] bool, one for each photo."""
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
        effects: colour effects of the plan, so that another exposure is not taken for a distractor.
        iterations: length of the probe.
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
    """Measure what a probe of `ITERATIONS` cannot explain and, where that is much, one of `SETTLED`.

    Fine texture is learnt late, a distractor in one photo never. Example: drone photos of fields have 1.5 %
    after 300 iterations and 0.2 % after 1200, a thin distractor in a courtyard 1.5 and 1.4 %.

    Args:
        scene: the scene.
        effects: see `occlusion`.
        bar: called with total=iterations, returns a context whose `update` counts one, such as tqdm.
    """
    spent = 0
    for iterations in (ITERATIONS, SETTLED):
        with bar(total=iterations) as progress:
            result = occlusion(scene, effects, iterations=iterations, tick=progress.update)
        spent += iterations
        if result.share <= OCCLUSION:
            break
    return dataclasses.replace(result, iterations=spent)


def effect_costs(scene: Scene) -> dict[str, float]:
    """Measure the ms of CPU time per iteration that each effect adds on this machine, on small photos."""
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as name:
        return step_costs(small_data(scene, Path(name)), ALL, Path(name))


def step_costs(data: TrainData, effects: Sequence[str], folder: Path) -> dict[str, float]:
    """Measure the ms of CPU time per iteration that each of the effects adds when it is on alone.

    All take turns in every round, so that the load of the machine affects them alike; the median is taken.
    """
    config = TrainConfig(iterations=10_000, probes=0)
    trainers = {
        e: Trainer(data, with_effects(Parts(), (e,) if e else ()), config, folder=folder / e)
        for e in ("", *effects)
    }
    times: dict[str, list[float]] = {e: [] for e in trainers}
    for turn in range(TIMED_ROUNDS + 1):
        for effect, trainer in trainers.items():
            begin = time.process_time()  # excludes other programs
            for _ in range(TIMED_STEPS):
                trainer.step()
            if turn:  # the first round compiles and allocates
                times[effect].append(1e3 * (time.process_time() - begin) / TIMED_STEPS)
    plain = np.array(times[""])
    return {e: round(float(np.median(np.array(t) - plain)), 2) for e, t in times.items() if e}


def with_occlusion(plan: Plan, occlusion: Occlusion) -> Plan:
    """Return the plan with the lines about masks, which come first."""

    def line(
        effect: str, evidence: str, value: float, threshold: float, on: str, off: str, how: str
    ) -> Decision:
        decision = answer(value, threshold)
        why = on if decision == "on" else off
        return Decision(effect, evidence, value, threshold, "of the pixels", decision, why, how)

    lines = (
        line("masks", "patches that a probe cannot explain", occlusion.share, OCCLUSION,
             "distractors in front of the scene", "all photos agree", "--mask none where off"),
        line("masks, local", "those in patches below 5 % of a photo", occlusion.compact, LOCAL,
             "distractors of the size of instances", "no distractor of the size of an instance",
             "--set refinesplat.mask.use_local=false where off"),
        line("masks, global", "patches in the worst tenth of the photos", occlusion.worst, GLOBAL,
             "distractors cover large parts of some photos", "no photo is covered in large parts",
             "--set refinesplat.mask.use_global=false where off"),
        line("entropy density", "patches that a probe cannot explain", occlusion.share, ENTROPY,
             "growth should wait for masks", "growth need not wait for masks", "--density none where off"),
    )  # fmt: skip
    return dataclasses.replace(plan, decisions=(*lines, *plan.decisions), probed=True)
