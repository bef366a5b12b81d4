"""Make the plan of a scene: decide by limits first, then by paired probes that take a tenth of the run.

A pair of probes shows whether an effect improves pixels that were left out of training: two short trainings
differ in that effect alone. Both leave out the same blocks of every train photo and see the same photos in
the same order. In the second half of a training every visit of a photo measures its blocks.

Probes neither add nor remove Gaussians, because growth is chaotic: with growth, two seeds of one probe
differed by 1.9 dB in the gain of antialiasing, without it by 0.02 dB.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera, Points, Scene
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.harness.effects_plan import Cost, Plan, plan_without_training
from ambiguous_wild.harness.residual_probe import (
    ITERATIONS,
    LONGEST,
    OCCLUSION,
    SETTLED,
    TIMED_ROUNDS,
    TIMED_STEPS,
    persists,
    small_data,
    step_costs,
    with_occlusion,
)
from ambiguous_wild.harness.select_effects import (
    ProbeResult,
    candidates,
    compare,
    format_gain,
    try_effects,
    untried,
    with_masks_tried,
)
from ambiguous_wild.harness.timing import expected_s, slowness
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.splat.calibration import prepare_cpu
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import MaskPolicy, Parts
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.splat.trainer import Trainer

MOST_PHOTOS = 60  # evenly spaced photos of a probe: 300 iterations visit each five times
HELD_BACK = 0.2  # share of a photo's blocks that is left out
BLOCKS = 8  # number along a photo's longest side
MEASURED_FROM = 0.5  # share of a probe after which visits measure
FIXED = DensityConfig(start=1e9, stop=0.0)


class HeldBack(MaskPolicy):
    """Leave blocks of every photo out of the loss and measure the render there."""

    def __init__(
        self,
        blocks: Sequence[Tensor],
        cameras: Sequence[Camera],
        *,
        posed: bool = False,
        patches: Sequence[Tensor] | None = None,
        masked: bool = False,
    ) -> None:
        """
        Args:
            blocks: a map for every train photo, [H, W] bool, True = left out.
            cameras: the given cameras of the train photos.
            posed: poses are refined; then the blocks are measured from the given camera, like a test view.
            patches: a map for every train photo, [H, W] bool: these pixels are not measured.
            masked: leave the patches out of the loss too.
        """
        measured = blocks if patches is None else [block & ~patch for block, patch in zip(blocks, patches)]
        left_out = [b | p for b, p in zip(blocks, patches)] if masked and patches is not None else blocks
        self.measured, self.keeps = measured, [(~pixels).float() for pixels in left_out]
        self.cameras, self.posed = cameras, posed
        self.visits: dict[int, list[float]] = {}  # PSNR in dB by view

    def keep(self, step: Step) -> Tensor:
        measured = self.measured[step.view]
        if step.progress > MEASURED_FROM and bool(measured.any()):
            rendered = step.draw(self.cameras[step.view]) if self.posed else step.rendered
            error = (rendered.image.clamp(0, 1) - step.photo)[measured].double().square().mean()
            self.visits.setdefault(step.view, []).append(float(-10 * torch.log10(error.clamp_min(1e-10))))
        return self.keeps[step.view]


def held_back(data: TrainData, seed: int) -> list[Tensor]:
    """Choose blocks of every photo at random, [H, W] bool; never where the capture's own mask lies."""
    maps = []
    for view, (photo, keep) in enumerate(zip(data.photos, data.user_keep)):
        height, width = photo.shape[:2]
        side = max(max(height, width) // BLOCKS, 1)
        drawn = np.random.default_rng([seed, 0x68, view]).random((-(-height // side), -(-width // side)))
        chosen = drawn <= np.quantile(drawn, HELD_BACK)
        blocks = torch.from_numpy(np.kron(chosen, np.ones((side, side), bool))[:height, :width])
        maps.append(blocks if keep is None else blocks & (keep > 0.5))
    return maps


def sampled(scene: Scene) -> tuple[Scene, list[int]]:
    """Return the scene with at most `MOST_PHOTOS` train photos, and their indices in `scene.train`."""
    train = [index for index, view in enumerate(scene.views) if view.split == "train"]
    if len(train) <= MOST_PHOTOS:
        return scene, list(range(len(train)))
    places = np.linspace(0, len(train) - 1, MOST_PHOTOS).round().astype(int).tolist()
    chosen = {train[place] for place in places}
    views = tuple(
        dataclasses.replace(view, split="train" if index in chosen else "test")
        for index, view in enumerate(scene.views)
    )
    return dataclasses.replace(scene, views=views), places


def without_blocks(scene: Scene, blocks: Sequence[Tensor]) -> Points:
    """Return the points without observations in held-back pixels, from whose colours effects would start."""
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


class Trials:
    """The photos and blocks of one scene, on which probes are trained."""

    def __init__(self, scene: Scene, folder: Path, *, seed: int = 0) -> None:
        """
        Args:
            scene: the scene.
            folder: folder for temporary files.
            seed: seed of the blocks and of training.
        """
        scene, self.chosen = sampled(scene)
        data = small_data(scene, folder, seed)
        self.seed, self.folder = seed, folder
        self.blocks = held_back(data, seed)
        hidden = dataclasses.replace(scene, points=without_blocks(scene, self.blocks))
        self.data = dataclasses.replace(data, scene=hidden)

    def train(
        self,
        effects: Sequence[str],
        iterations: int,
        *,
        patches: Sequence[Tensor] | None = None,
        masked: bool = False,
        tick: Callable[[], object] | None = None,
    ) -> ProbeResult:
        """Train one probe.

        Args:
            effects: the effects that are on.
            iterations: length of the probe.
            patches, masked: see `HeldBack`.
            tick: called after every iteration.
        """
        posed, cameras = "poses" in effects, self.data.cameras
        policy = HeldBack(self.blocks, cameras, posed=posed, patches=patches, masked=masked)
        # "images" sets both pictures to zero in the blocks, so that no window of SSIM uses them
        parts = dataclasses.replace(Parts(), mask=policy, density_config=FIXED, weighting="images")
        config = TrainConfig(iterations=iterations, seed=self.seed, probes=0, checkpoint_every_s=1e9)
        trainer = Trainer(self.data, with_effects(parts, effects), config, folder=self.folder)

        def after(_: object) -> None:
            if tick is not None:
                tick()

        trainer.train(tick=after)
        names = [view.name for view in self.data.scene.train]
        return ProbeResult({names[view]: float(np.mean(dbs)) for view, dbs in sorted(policy.visits.items())})


SHARE = 0.1
LONGEST_ARM, SHORTEST_ARM = 300, 100  # iterations; a shorter probe cannot separate an effect from noise
TIMED = (TIMED_ROUNDS + 1) * TIMED_STEPS  # iterations to time an effect, and as many without any
ARMS_OF_MASKS = 2


@dataclass(frozen=True)
class Allowance:
    """Expected reference seconds of a run, and of an iteration of the two kinds of probes."""

    run_s: float
    arm_step_s: float  # of a paired probe
    grown_step_s: float  # of the probe for masks, in which Gaussians grow

    def arm_iterations(self, arms: int, spent_s: float = 0.0) -> int:
        """Return the iterations of each paired probe if there are `arms`; 0 if the run is too short."""
        if arms == 0:
            return 0
        most = int((SHARE * self.run_s - spent_s) / (arms * self.arm_step_s) + 1e-9) - TIMED
        return 0 if most < SHORTEST_ARM else min(most, LONGEST_ARM)

    @property
    def masks_s(self) -> float:
        """Largest time that deciding about masks can take, in reference seconds."""
        paired = ARMS_OF_MASKS * LONGEST_ARM * self.arm_step_s
        return (ITERATIONS + SETTLED) * self.grown_step_s + paired

    @property
    def masks_fit(self) -> bool:
        """True if the run is long enough to decide about masks."""
        return self.masks_s <= SHARE * self.run_s

    def share(self, arm_iterations: int, grown_iterations: int = 0) -> float:
        """Return the expected share of the run that these iterations take."""
        spent = arm_iterations * self.arm_step_s + grown_iterations * self.grown_step_s
        return spent / self.run_s


def allowance(scene: Scene, train: TrainConfig) -> Allowance:
    """Compute the allowance of a run; if it has a budget, the kernels must be compiled.

    Args:
        scene: the scene, at the size that is trained on.
        train: length of the run.
    """
    camera = scene.train[0].camera
    pixels = camera.width * camera.height
    small = int(pixels * min(1.0, LONGEST / max(camera.width, camera.height)) ** 2)
    points = len(scene.points)
    if train.budget_s is None:
        run_s = expected_s(train.iterations, pixels, min(train.max_gaussians or pixels, pixels))
    else:
        run_s = train.budget_s / slowness()
    arm, grown = (expected_s(1, small, n) for n in (points, max(points, small)))
    return Allowance(run_s, arm, grown)


VERSION = 1  # of the probes; saved probes of another version are not read
SEED = 0  # fixed: all seeds of a grid train with the same effects
TOO_SHORT = "probes may take a tenth of the run, which is too short for them"

Bar = Callable[..., AbstractContextManager[Any]]


@contextlib.contextmanager
def no_bar(total: int) -> Iterator[Any]:
    """A progress bar that shows nothing."""
    yield SimpleNamespace(update=lambda: None)


class SavedProbes:
    """The probes of one scene in a file, so that an interrupted plan, or one made again, reuses them."""

    def __init__(self, scene: Scene, length: Mapping[str, float], folder: Path) -> None:
        """
        Args:
            scene: the scene.
            length: the settings that decide how long the probes are.
            folder: folder of the file.
        """
        self.key = config_hash(
            {
                "scene": scene_identity(scene),
                "length": dict(length),
                "version": VERSION,
                "photos": MOST_PHOTOS,
                "blocks": [HELD_BACK, BLOCKS, MEASURED_FROM],
            }
        )
        self.path = folder / f"{scene.name}-{self.key[:12]}.json"
        self.iterations: int | None = None  # of a probe
        self.arms: dict[str, ProbeResult] = {}  # by the names of their effects
        self.costs: dict[str, float] = {}  # extra ms per iteration, by effect
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            rows = json.loads(self.path.read_text(encoding="utf-8"))
            if rows["key"] == self.key:
                arms = {name: ProbeResult(_numbers(psnr)) for name, psnr in rows["arms"].items()}
                self.iterations, self.costs, self.arms = (
                    int(rows["iterations"]),
                    _numbers(rows["costs"]),
                    arms,
                )

    def write(self) -> None:
        """Write the probes made so far."""
        arms = {name: dict(arm.psnr) for name, arm in self.arms.items()}
        rows = {"key": self.key, "iterations": self.iterations, "costs": self.costs, "arms": arms}
        write_json(self.path, rows)


def _numbers(row: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in row.items()}


def plan(scene: Path | str, *, iterations: int = TrainConfig.iterations) -> Plan:
    """Decide which effects a scene needs in runs of this length, as `aw plan` does."""
    loaded, train = load_scene(scene), TrainConfig(iterations=iterations)
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as folder:
        return plan_with_probes(loaded, train, Path(folder), masks=True, prepare=lambda: prepare_cpu(None))


def plan_with_probes(
    scene: Scene,
    train: TrainConfig,
    folder: Path,
    *,
    masks: bool,
    prepare: Callable[[], None],
    say: Callable[[str], None] = lambda text: None,
    bar: Bar = no_bar,
) -> Plan:
    """Decide by limits, then probe the effects that exceed them if the run is long enough.

    Args:
        scene: the scene.
        train: length of the run that the plan is for.
        folder: where probes are saved.
        masks: decide about masks too.
        prepare: compiles the CPU kernels; called before the first probe.
        say: gets a line for every decision.
        bar: called with total=iterations, returns a context whose `update` counts one, such as tqdm.

    Raises:
        AwError: a photo cannot be read.
    """
    plan = plan_without_training(scene)
    names = candidates(plan)
    if not names and not masks:
        return plan
    prepare()
    begin = time.perf_counter()
    allowed = allowance(scene, train)
    if masks and not allowed.masks_fit:
        say(f"{scene.name}: masks not tried: {TOO_SHORT}")
    masks = masks and allowed.masks_fit
    spent_s = allowed.masks_s if masks else 0.0
    paired = grown = 0
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as name:
        bench = _Bench(scene, Path(name), bar)
        if names:
            length = allowed.arm_iterations(len(names) + 1, spent_s)
            # under a budget, `length` depends on the speed of the machine now: it must not be part of the key
            key = {"iterations": length} if train.budget_s is None else {"budget_s": train.budget_s}
            saved = SavedProbes(scene, key, folder)
            if saved.iterations is None:
                saved.iterations = length
            plan, paired = _with_effects(plan, names, saved, bench, say)
        if masks:
            plan, more, grown = _with_masks(plan, scene, bench, say, bar)
            paired += more
    share = allowed.share(paired, grown)
    return dataclasses.replace(plan, cost=_cost(paired + grown, begin, share) if paired + grown else None)


def _with_effects(
    plan: Plan, names: Sequence[str], saved: SavedProbes, bench: _Bench, say: Callable[[str], None]
) -> tuple[Plan, int]:
    """Probe effects; return the plan with the decisions, and the iterations of all probes."""
    length = saved.iterations
    if not length:
        saved.write()
        say(f"{plan.scene}: {', '.join(names)} not tried: {TOO_SHORT}")
        return untried(plan, TOO_SHORT), 0

    def arm(effects: tuple[str, ...]) -> ProbeResult:
        key = "+".join(effects)
        if key not in saved.arms:
            saved.arms[key] = bench.train(effects, length)
            saved.write()
        return saved.arms[key]

    unknown = [name for name in names if name not in saved.costs]
    if unknown:
        saved.costs |= step_costs(bench.trials.data, unknown, bench.folder)
        saved.write()
    plan = try_effects(plan, names, arm, saved.costs, say)
    return plan, length * len(saved.arms) + TIMED * (len(names) + 1)


def _cost(iterations: int, begin: float, share: float) -> Cost:
    return Cost(iterations, round(time.perf_counter() - begin, 1), round(share, 4))


class _Bench:
    """Trains probes; the photos are read when the first probe needs them."""

    def __init__(self, scene: Scene, folder: Path, bar: Bar) -> None:
        self.scene, self.folder, self.bar = scene, folder, bar
        self._trials: Trials | None = None

    @property
    def trials(self) -> Trials:
        if self._trials is None:
            self._trials = Trials(self.scene, self.folder, seed=SEED)
        return self._trials

    def train(self, effects: tuple[str, ...], length: int, **more: Any) -> ProbeResult:
        with self.bar(total=length) as progress:
            return self.trials.train(effects, length, tick=progress.update, **more)


def _with_masks(
    plan: Plan, scene: Scene, bench: _Bench, say: Callable[[str], None], bar: Bar
) -> tuple[Plan, int, int]:
    """Probe masks; return the plan with their lines, and the iterations of paired and of other probes."""
    colour = plan.effects(("exposure", "appearance"))
    occlusion = persists(scene, colour, bar=bar)
    plan = with_occlusion(plan, occlusion)
    unexplained = f"{100 * occlusion.share:.1f} % of the pixels unexplained"
    if occlusion.share < OCCLUSION:
        say(f"{scene.name}: masks off: {unexplained}")
        return plan, 0, occlusion.iterations
    chosen = bench.trials.chosen
    patches = [torch.from_numpy(occlusion.patches[place]) for place in chosen]
    base, without = (
        bench.train(colour, LONGEST_ARM, patches=patches, masked=masked) for masked in (False, True)
    )
    gain = compare(without, base)
    plan = with_masks_tried(plan, gain)
    answer = next(d.decision for d in plan.decisions if d.effect == "masks")
    outcome = "too few photos to try" if gain is None else format_gain(gain)
    say(f"{scene.name}: masks {answer}: {unexplained}, {outcome}")
    return plan, ARMS_OF_MASKS * LONGEST_ARM, occlusion.iterations
