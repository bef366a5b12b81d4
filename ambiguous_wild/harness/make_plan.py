"""A plan from evidence: limits as the first guess, then paired probes within a tenth of the run.

Paired probes: does an effect pay on pixels that were left out of training?

Two short trainings differ in one effect. Both leave out the same blocks of every train photo and see the same
photos in the same order. In the second half every visit of a photo measures its blocks before it is learnt.

The Gaussians stay those of the sparse model, because growth is chaotic: with it, two seeds of one probe
differed by 1.9 dB in what antialiasing gives, without it by 0.02 dB.
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

MOST_PHOTOS = 60  # evenly spaced ones are tried on: 300 iterations visit each five times
HELD_BACK = 0.2  # of a photo's blocks
BLOCKS = 8  # along a photo's longest side
MEASURED_FROM = 0.5  # of a probe
FIXED = DensityConfig(start=1e9, stop=0.0)


class HeldBack(MaskPolicy):
    """Leaves blocks of every photo out of the loss and measures the render there."""

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
            blocks: of every train photo, [H, W] bool, True = left out.
            cameras: of the train photos as they were given.
            posed: poses are refined; a test view's are not, so the blocks are drawn from the given camera.
            patches: of every train photo, [H, W] bool: these pixels are not measured.
            masked: nor are they trained on.
        """
        seen = blocks if patches is None else [block & ~patch for block, patch in zip(blocks, patches)]
        left_out = [b | p for b, p in zip(blocks, patches)] if masked and patches is not None else blocks
        self.measured, self.keeps = seen, [(~pixels).float() for pixels in left_out]
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
    """Blocks [H, W] bool of every photo, at random; never where the capture's own mask lies."""
    found = []
    for view, (photo, keep) in enumerate(zip(data.photos, data.user_keep)):
        height, width = photo.shape[:2]
        side = max(max(height, width) // BLOCKS, 1)
        drawn = np.random.default_rng([seed, 0x68, view]).random((-(-height // side), -(-width // side)))
        chosen = drawn <= np.quantile(drawn, HELD_BACK)
        blocks = torch.from_numpy(np.kron(chosen, np.ones((side, side), bool))[:height, :width])
        found.append(blocks if keep is None else blocks & (keep > 0.5))
    return found


def sampled(scene: Scene) -> tuple[Scene, list[int]]:
    """The scene with `MOST_PHOTOS` train photos at most, and their places in `scene.train`.

    The others are not read.
    """
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
    """The sparse points without what they say of held-back pixels: effects start from colours at points."""
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
    """Photos and blocks of one scene, on which arms are trained."""

    def __init__(self, scene: Scene, folder: Path, *, seed: int = 0) -> None:
        """
        Args:
            scene: the scene.
            folder: for temporary files.
            seed: of the blocks and of training.
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
        """Train one arm.

        Args:
            effects: that are on.
            iterations: of the probe.
            patches, masked: see `HeldBack`.
            tick: called after every iteration.
        """
        posed, cameras = "poses" in effects, self.data.cameras
        policy = HeldBack(self.blocks, cameras, posed=posed, patches=patches, masked=masked)
        # "images" blanks both pictures outside: no window of SSIM reaches into the blocks
        parts = dataclasses.replace(Parts(), mask=policy, density_config=FIXED, weighting="images")
        config = TrainConfig(iterations=iterations, seed=self.seed, probes=0, checkpoint_every_s=1e9)
        trainer = Trainer(self.data, with_effects(parts, effects), config, folder=self.folder)

        def after(_: object) -> None:
            if tick is not None:
                tick()

        trainer.train(tick=after)
        names = [view.name for view in self.data.scene.train]
        return ProbeResult(
            {names[view]: float(np.mean(found)) for view, found in sorted(policy.visits.items())}
        )


SHARE = 0.1
LONGEST_ARM, SHORTEST_ARM = 300, 100  # iterations; a shorter probe tells no effect from noise
TIMED = (TIMED_ROUNDS + 1) * TIMED_STEPS  # iterations that time an effect, and as many without any
ARMS_OF_MASKS = 2


@dataclass(frozen=True)
class Allowance:
    """Expected reference seconds of a run, and of an iteration of the two kinds of probes."""

    run_s: float
    arm_step_s: float  # of a paired probe
    grown_step_s: float  # of the probe of masks, whose Gaussians grow

    def arm_iterations(self, arms: int, spent_s: float = 0.0) -> int:
        """Iterations of each of so many paired probes; 0 where the run is too short for them."""
        if arms == 0:
            return 0
        most = int((SHARE * self.run_s - spent_s) / (arms * self.arm_step_s) + 1e-9) - TIMED
        return 0 if most < SHORTEST_ARM else min(most, LONGEST_ARM)

    @property
    def masks_s(self) -> float:
        """What deciding about masks takes at most."""
        paired = ARMS_OF_MASKS * LONGEST_ARM * self.arm_step_s
        return (ITERATIONS + SETTLED) * self.grown_step_s + paired

    @property
    def masks_fit(self) -> bool:
        """Whether the run is long enough to decide about masks."""
        return self.masks_s <= SHARE * self.run_s

    def share(self, arm_iterations: int, grown_iterations: int = 0) -> float:
        """Expected share of the run."""
        spent = arm_iterations * self.arm_step_s + grown_iterations * self.grown_step_s
        return spent / self.run_s


def allowance(scene: Scene, train: TrainConfig) -> Allowance:
    """Of a run of that length; under a budget the kernels must be compiled.

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


VERSION = 1  # of the probes: another one does not read what an earlier one kept
SEED = 0  # a decision is the scene's: all seeds of a grid train with the same effects
TOO_SHORT = "a tenth of the run is too short for probes"

Bar = Callable[..., AbstractContextManager[Any]]


@contextlib.contextmanager
def no_bar(total: int) -> Iterator[Any]:
    """For those who show no progress."""
    yield SimpleNamespace(update=lambda: None)


class Kept:
    """Probes of one scene in a file, so that a plan that was interrupted or is made again goes on."""

    def __init__(self, scene: Scene, length: Mapping[str, float], folder: Path) -> None:
        """
        Args:
            scene: the scene.
            length: what says how long the probes are.
            folder: of the file.
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
        self.arms: dict[str, ProbeResult] = {}
        self.costs: dict[str, float] = {}  # ms an iteration
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
        """Keep what there is."""
        arms = {name: dict(arm.psnr) for name, arm in self.arms.items()}
        rows = {"key": self.key, "iterations": self.iterations, "costs": self.costs, "arms": arms}
        write_json(self.path, rows)


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in row.items()}


def plan(scene: Path | str, *, iterations: int = TrainConfig.iterations) -> Plan:
    """Which effects the scene in a folder needs in runs of this length: what `aw plan` does."""
    loaded, train = load_scene(scene), TrainConfig(iterations=iterations)
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as kept:
        return plan_with_probes(loaded, train, Path(kept), masks=True, prepare=lambda: prepare_cpu(None))


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
    """The limits' decisions, tried where they call for something and the run is long enough.

    Args:
        scene: the scene.
        train: length of the run that the plan is for.
        folder: where probes are kept.
        masks: decide about masks too.
        prepare: makes the CPU kernels ready; called if anything is probed.
        say: told every decision.
        bar: called with total=iterations, a context whose `update` counts one; tqdm is one.

    Raises:
        AwError: a photo cannot be read.
    """
    plan = plan_without_training(scene)
    names = candidates(plan)
    if not names and not masks:
        return plan
    prepare()
    begin = time.perf_counter()
    room = allowance(scene, train)
    if masks and not room.masks_fit:
        say(f"{scene.name}: masks not tried: {TOO_SHORT}")
    masks = masks and room.masks_fit
    spent_s = room.masks_s if masks else 0.0
    paired = grown = 0
    with tempfile.TemporaryDirectory(prefix="aw-plan-") as name:
        bench = _Bench(scene, Path(name), bar)
        if names:
            length = room.arm_iterations(len(names) + 1, spent_s)
            # how fast the machine is now must not decide when a run under a budget goes on
            known = {"iterations": length} if train.budget_s is None else {"budget_s": train.budget_s}
            kept = Kept(scene, known, folder)
            if kept.iterations is None:
                kept.iterations = length
            plan, paired = _with_effects(plan, names, kept, bench, say)
        if masks:
            plan, more, grown = _with_masks(plan, scene, bench, say, bar)
            paired += more
    share = room.share(paired, grown)
    return dataclasses.replace(plan, cost=_cost(paired + grown, begin, share) if paired + grown else None)


def _with_effects(
    plan: Plan, names: Sequence[str], kept: Kept, bench: _Bench, say: Callable[[str], None]
) -> tuple[Plan, int]:
    """The plan with what the probes said of effects, and the iterations of all of them."""
    length = kept.iterations
    if not length:
        kept.write()
        say(f"{plan.scene}: {', '.join(names)} not tried: {TOO_SHORT}")
        return untried(plan, TOO_SHORT), 0

    def arm(effects: tuple[str, ...]) -> ProbeResult:
        key = "+".join(effects)
        if key not in kept.arms:
            kept.arms[key] = bench.train(effects, length)
            kept.write()
        return kept.arms[key]

    unknown = [name for name in names if name not in kept.costs]
    if unknown:
        kept.costs |= step_costs(bench.trials.data, unknown, bench.folder)
        kept.write()
    plan = try_effects(plan, names, arm, kept.costs, say)
    return plan, length * len(kept.arms) + TIMED * (len(names) + 1)


def _cost(iterations: int, begin: float, share: float) -> Cost:
    return Cost(iterations, round(time.perf_counter() - begin, 1), round(share, 4))


class _Bench:
    """Reads the photos when the first probe needs them."""

    def __init__(self, scene: Scene, folder: Path, bar: Bar) -> None:
        self.scene, self.folder, self.bar = scene, folder, bar
        self._trials: Trials | None = None

    @property
    def trials(self) -> Trials:
        if self._trials is None:
            self._trials = Trials(self.scene, self.folder, seed=SEED)
        return self._trials

    def train(self, effects: tuple[str, ...], length: int, **more: Any) -> ProbeResult:
        with self.bar(total=length) as shown:
            return self.trials.train(effects, length, tick=shown.update, **more)


def _with_masks(
    plan: Plan, scene: Scene, bench: _Bench, say: Callable[[str], None], bar: Bar
) -> tuple[Plan, int, int]:
    """The plan with the lines of masks, and the iterations of paired and of other probes."""
    colour = plan.effects(("exposure", "appearance"))
    found = persists(scene, colour, bar=bar)
    plan = with_occlusion(plan, found)
    if found.share < OCCLUSION:
        say(f"{scene.name}: masks off: {100 * found.share:.1f} % of the pixels unexplained")
        return plan, 0, found.iterations
    chosen = bench.trials.chosen
    patches = [torch.from_numpy(found.patches[place]) for place in chosen]
    base, without = (
        bench.train(colour, LONGEST_ARM, patches=patches, masked=masked) for masked in (False, True)
    )
    gain = compare(without, base)
    plan = with_masks_tried(plan, gain)
    answer = next(d.decision for d in plan.decisions if d.effect == "masks")
    said = "too few photos to try" if gain is None else format_gain(gain)
    say(f"{scene.name}: masks {answer}: {100 * found.share:.1f} % of the pixels unexplained, {said}")
    return plan, ARMS_OF_MASKS * LONGEST_ARM, found.iterations
