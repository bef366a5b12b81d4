"""Find out whether distractors stand in front of a scene, for `aw plan`, and time effects.

A short run of plain 3DGS on small photos lacks detail everywhere, but errors in detail have both signs and
cancel in the mean over a window. A distractor in one photo is a patch of one sign, which remains.

Then two short trainings, with and without these patches, are measured on blocks of every photo that both
leave out: training on a distractor worsens other photos of the same place, a detail that is hard to learn
does not. Both see the same photos in the same order; in the second half every visit of a photo measures its
blocks. They neither add nor remove Gaussians: with growth two seeds differ by 1.9 dB, without by 0.02.
"""

from __future__ import annotations

import dataclasses
import functools
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.ndimage import label, maximum_filter, uniform_filter
from torch import Tensor
from tqdm import tqdm

from ambiguous_wild.core import Scene, SparsePoints
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.harness.effects_plan import Decision, EffectsPlan, decision_for, plan_effects
from ambiguous_wild.io.keep_resize import smaller_keep
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.calibration import prepare_cpu
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects import ALL, with_effects
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.splat.training_loop import train

MAX_SIDE = 160  # px, longer side of the probe's photos
ITERATIONS = 300
LONG_ITERATIONS = 1200  # iterations after which fine texture is learnt, but a distractor in one photo is not
WINDOW = 1 / 20  # side of the window, of the photo's longer side
STANDS_OUT = 0.12  # of the colour range: mean residual of a window in the worst channel
TIMED_ROUNDS, TIMED_STEPS = 12, 3  # to time an effect, after a first round
LARGE = 0.05  # of a photo: a larger patch is more than one instance

# Limits, as shares of the photos' pixels, set on the presets.
OCCLUSION, LOCAL, GLOBAL, ENTROPY = 0.003, 0.003, 0.05, 0.01
MAX_PHOTOS = 60  # evenly spaced photos of a pair: 300 iterations visit each five times
SEED = 0  # of the blocks and of the pair
MIN_PHOTOS = 4  # fewer give no useful standard error
# Without growth masks gain little: static captures -0.02 to +0.01 dB, captures with distractors from 0.05 dB
MIN_DB = 0.02
# Share of unexplained pixels: static captures have 0.0 to 0.9 %, captures with distractors 0.6 % or more.
CERTAIN = 0.03
MASK_LINES = ("masks", "masks, local", "masks, global", "entropy density")
STATIC = "static: leaving out the patches does not improve held-out pixels"
HELD_OUT_SHARE = 0.2  # share of a photo's blocks that is left out
BLOCKS = 8  # number along a photo's longest side
MEASURED_FROM = 0.5  # share of a probe after which visits measure
FIXED = DensityConfig(start=1e9, stop=0.0)
Bar = Callable[..., AbstractContextManager[Any]]
NO_BAR: Bar = functools.partial(tqdm, disable=True)


@dataclass(frozen=True)
class Occlusion:
    """Shares of the train photos' pixels that the probe cannot explain."""

    share: float  # of all pixels
    compact: float  # in patches below LARGE
    worst: float  # in the tenth of the photos with the largest shares
    # [H, W] bool of every train photo: unexplained pixels, those near static points included
    patches: tuple[np.ndarray, ...] = field(default=(), repr=False, compare=False)


def small_data(scene: Scene, folder: Path) -> TrainData:
    """Load the training data with photos of at most MAX_SIDE px."""
    data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=folder)
    photos, cameras, keeps = [], [], []
    for photo, camera, keep in zip(data.photos, data.cameras, data.user_keep):
        scale = min(1.0, MAX_SIDE / max(photo.shape[:2]))
        size = (max(round(photo.shape[0] * scale), 8), max(round(photo.shape[1] * scale), 8))
        chw = torch.nn.functional.interpolate(photo.permute(2, 0, 1)[None], size=size, mode="area")
        photos.append(chw[0].permute(1, 2, 0).contiguous())
        cameras.append(camera.resized(size[1], size[0]))
        keeps.append(None if keep is None else smaller_keep(keep, size, "any masked"))
    return dataclasses.replace(data, photos=photos, cameras=cameras, user_keep=keeps)


def residual_mask(photo: np.ndarray, render: np.ndarray, seen: np.ndarray) -> np.ndarray:
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
    uv = camera.project(scene.points.xyz[well])[0] * [size[1] / camera.width, size[0] / camera.height]
    columns, rows = uv[((uv >= 0) & (uv < [size[1], size[0]])).all(axis=1)].astype(int).T
    near = np.zeros(size, bool)
    near[rows, columns] = True
    return maximum_filter(near, max(round(WINDOW * max(size)), 3))


def has_sparse_points(scene: Scene, index: int, size: tuple[int, int]) -> np.ndarray:
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
    tick: Callable[[], None] = lambda: None,
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
        trainer = Trainer(data, with_effects(MethodHooks(), effects), config, folder=Path(folder))
        train(trainer, tick=lambda _: tick())
        patches, counted = [], []
        places = [i for i, v in enumerate(scene.views) if v.split == "train"]
        for view, photo in enumerate(data.photos):
            rendered = trainer.make_step(trainer.iteration, view, downsampling=1).rendered
            seen = rendered.alpha.numpy() > 0.5
            keep = data.user_keep[view]
            seen &= seen_by_others(scene, places[view], (photo.shape[0], photo.shape[1]))
            seen &= True if keep is None else keep.numpy() > 0.5
            patch = residual_mask(photo.numpy(), np.clip(rendered.image.numpy(), 0, 1), seen)
            patches.append(patch)
            counted.append(patch & ~has_sparse_points(scene, places[view], patch.shape))
        return dataclasses.replace(summarise(counted), patches=tuple(patches))


def measure_occlusion(
    scene: Scene,
    effects: tuple[str, ...] = (),
    *,
    bar: Bar,
) -> Occlusion:
    """Train a probe of `ITERATIONS`; where its residual mask is large, one of `LONG_ITERATIONS` counts.

    Fine texture is learnt late, a distractor in one photo never. Example: drone photos of fields have 1.5 %
    after 300 iterations and 0.2 % after 1200, a thin distractor in a courtyard 1.5 and 1.4 %.

    Args:
        scene: the scene.
        effects: see `occlusion`.
        bar: called with total=iterations, returns a context whose `update` counts one, such as tqdm.
    """
    for iterations in (ITERATIONS, LONG_ITERATIONS):
        with bar(total=iterations) as progress:
            result = occlusion(scene, effects, iterations=iterations, tick=progress.update)
        if result.share <= OCCLUSION:
            break
    return result


class HeldOutBlocks(MaskPolicy):
    """Leave blocks of every photo out of the loss and measure the render there."""

    def __init__(
        self,
        blocks: Sequence[Tensor],
        patches: Sequence[Tensor],
        masked: bool,
    ) -> None:
        """
        Args:
            blocks: a map for every train photo, [H, W] bool, True = left out.
            patches: a map for every train photo, [H, W] bool: these pixels are not measured.
            masked: leave the patches out of the loss too.
        """
        self.measured = [block & ~patch for block, patch in zip(blocks, patches)]
        left_out = [block | patch for block, patch in zip(blocks, patches)] if masked else blocks
        self.keeps = [(~pixels).float() for pixels in left_out]
        self.visits: dict[int, list[float]] = {}  # PSNR in dB by view

    def keep(self, step: Step) -> Tensor:
        measured = self.measured[step.view]
        if step.progress > MEASURED_FROM and bool(measured.any()):
            error = (step.rendered.image.clamp(0, 1) - step.photo)[measured].double().square().mean()
            self.visits.setdefault(step.view, []).append(float(-10 * torch.log10(error.clamp_min(1e-10))))
        return self.keeps[step.view]


def held_out_blocks(data: TrainData, seed: int) -> list[Tensor]:
    """Choose blocks of every photo at random, [H, W] bool; never where the capture's own mask lies."""
    maps = []
    for view, (photo, keep) in enumerate(zip(data.photos, data.user_keep)):
        height, width = photo.shape[:2]
        side = max(max(height, width) // BLOCKS, 1)
        drawn = np.random.default_rng([seed, 0x68, view]).random((-(-height // side), -(-width // side)))
        chosen = drawn <= np.quantile(drawn, HELD_OUT_SHARE)
        blocks = torch.from_numpy(np.kron(chosen, np.ones((side, side), bool))[:height, :width])
        maps.append(blocks if keep is None else blocks & (keep > 0.5))
    return maps


def sample_photos(scene: Scene) -> tuple[Scene, list[int]]:
    """Return the scene with at most `MAX_PHOTOS` train photos, and their indices in `scene.train`."""
    train = [index for index, view in enumerate(scene.views) if view.split == "train"]
    if len(train) <= MAX_PHOTOS:
        return scene, list(range(len(train)))
    places = np.linspace(0, len(train) - 1, MAX_PHOTOS).round().astype(int).tolist()
    chosen = {train[place] for place in places}
    views = tuple(
        dataclasses.replace(view, split="train" if index in chosen else "test")
        for index, view in enumerate(scene.views)
    )
    return dataclasses.replace(scene, views=views), places


def without_blocks(scene: Scene, blocks: Sequence[Tensor]) -> SparsePoints:
    """Return the points without observations in held-out pixels, which would leak to effects."""
    points, views = scene.points, scene.points.track_views.copy()
    train = [index for index, view in enumerate(scene.views) if view.split == "train"]
    for index, block in zip(train, blocks):
        camera = scene.views[index].camera
        rows = np.flatnonzero(points.track_views == index)
        scale = np.array([block.shape[1] / camera.width, block.shape[0] / camera.height])
        column, row = (points.track_xy[rows] * scale).astype(int).T
        inside = block.numpy()[row.clip(0, block.shape[0] - 1), column.clip(0, block.shape[1] - 1)]
        views[rows[inside]] = -1
    return dataclasses.replace(points, track_views=views)


class MaskComparison:
    """Compares trainings with and without masks on held-out blocks of one scene."""

    def __init__(self, scene: Scene, folder: Path) -> None:
        """
        Args:
            scene: the scene.
            folder: folder for temporary files.
        """
        scene, self.chosen = sample_photos(scene)
        data = small_data(scene, folder)
        self.folder = folder
        self.blocks = held_out_blocks(data, SEED)
        hidden = dataclasses.replace(scene, points=without_blocks(scene, self.blocks))
        self.data = dataclasses.replace(data, scene=hidden)
        # Colours of held-out pixels do not say which points the start leaves out.
        keeps = [
            ~block if keep is None else (keep > 0.5) & ~block
            for block, keep in zip(self.blocks, data.user_keep)
        ]
        self.first = MethodHooks().first_gaussians(dataclasses.replace(self.data, user_keep=keeps))

    def train(
        self,
        effects: Sequence[str],
        patches: Sequence[Tensor],
        masked: bool,
        tick: Callable[[], None],
        iterations: int = ITERATIONS,
    ) -> dict[str, float]:
        """Train one of the two; return the PSNR of every photo's blocks in dB, mean over visits, by its name.

        Args:
            effects: the colour effects of the plan.
            patches, masked: see `HeldOutBlocks`.
            tick: called after every iteration.
            iterations: length of the training.
        """
        policy = HeldOutBlocks(self.blocks, patches, masked)
        # "images" sets both pictures to zero in the blocks, so that no window of SSIM uses them
        hooks = MethodHooks(user_start=self.first, mask=policy, density_config=FIXED, weighting="images")
        config = TrainConfig(iterations=iterations, seed=SEED, probes=0, checkpoint_every_s=1e9)
        trainer = Trainer(self.data, with_effects(hooks, effects), config, folder=self.folder)
        train(trainer, tick=lambda _: tick())
        names = [view.name for view in self.data.scene.train]
        return {names[view]: float(np.mean(dbs)) for view, dbs in sorted(policy.visits.items())}


@dataclass(frozen=True)
class MaskingGain:
    """PSNR that masking the patches gains on held-out pixels of the same photos."""

    db: float  # mean over photos
    error_db: float  # standard error of that mean


def masking_gain(with_it: Mapping[str, float], without: Mapping[str, float]) -> MaskingGain | None:
    """Return the mean gain over photos; None if the trainings share too few photos."""
    difference = np.array([with_it[name] - without[name] for name in without if name in with_it])
    if len(difference) < MIN_PHOTOS:
        return None
    return MaskingGain(float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference))))


def plan(scene: Path | str) -> EffectsPlan:
    """Decide which effects a scene needs, and whether masks, as `aw plan` does."""
    prepare_cpu(None)
    loaded = load_scene(scene)
    return with_masks(replace(plan_effects(loaded), scene_hash=scene_identity(loaded)), loaded)


def with_masks(plan: EffectsPlan, scene: Scene, bar: Bar = NO_BAR) -> EffectsPlan:
    """Return the plan with its lines about masks, from probes.

    Args:
        plan: the plan of the effects.
        scene: the scene.
        bar: called with total=iterations, returns a context whose `update` counts one, such as tqdm.

    Raises:
        AwError: a photo cannot be read.
    """
    colour = plan.effects(("exposure", "appearance"))
    occlusion = measure_occlusion(scene, colour, bar=bar)
    plan = with_occlusion(plan, occlusion)
    if occlusion.share < OCCLUSION:
        return plan
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as folder:
        comparison = MaskComparison(scene, Path(folder))
        patches = [torch.from_numpy(occlusion.patches[place]) for place in comparison.chosen]
        psnr = []
        for masked in (True, False):
            with bar(total=ITERATIONS) as progress:
                psnr.append(comparison.train(colour, patches, masked, progress.update))
    return with_gain(plan, masking_gain(*psnr))


def with_gain(plan: EffectsPlan, gain: MaskingGain | None) -> EffectsPlan:
    """Return the plan with masks off if few pixels are unexplained and leaving them out does not help.

    From `CERTAIN` on masks stay on: a sparse model of few points is too coarse to show the difference.

    Args:
        plan: a plan with the lines of `with_occlusion`.
        gain: gain of training without the patches; None = too few photos.
    """
    masks = next(d for d in plan.decisions if d.effect == "masks")
    if gain is None or masks.decision != "on":
        return plan
    static = masks.value < CERTAIN and not (gain.db >= MIN_DB and gain.db > gain.error_db)

    def line(decision: Decision) -> Decision:
        if static and decision.effect in MASK_LINES:
            decision = replace(decision, decision="off", why=STATIC)
        if decision.effect != "masks":
            return decision
        return replace(decision, gain_db=gain.db, error_db=gain.error_db)

    return replace(plan, decisions=tuple(line(d) for d in plan.decisions))


def with_occlusion(plan: EffectsPlan, occlusion: Occlusion) -> EffectsPlan:
    """Return the plan with the lines about masks, which come first."""

    def line(
        effect: str, evidence: str, value: float, threshold: float, on: str, off: str, how: str
    ) -> Decision:
        decision = decision_for(value, threshold)
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
             "growth should wait for masks", "growth need not wait for masks",
             "METHOD@density=none where off"),
    )  # fmt: skip
    return replace(plan, decisions=(*lines, *plan.decisions), probed=True)


def effect_costs(scene: Scene) -> dict[str, float]:
    """Measure the ms of CPU time per iteration that each effect adds on this machine, on small photos.

    All take turns in every round, so that the load of the machine affects them alike; the median is taken.
    """
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as name:
        folder, config = Path(name), TrainConfig(iterations=10_000, probes=0)
        data = small_data(scene, folder)
        trainers = {
            e: Trainer(data, with_effects(MethodHooks(), (e,) if e else ()), config, folder=folder / e)
            for e in ("", *ALL)
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
