"""Adaptive density control of 3DGS: clone, split, prune, reset opacity.

Source: 3D Gaussian Splatting (Kerbl et al. 2023), section 5; constants as in gsplat's DefaultStrategy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.config import State, check_limits
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import Gaussians, rotation_matrices
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS
from ambiguous_wild.splat.training_records import DensityLog

if TYPE_CHECKING:
    from ambiguous_wild.splat.optim import SplatAdam


NO_SIZE_PRUNING = 1e9  # `prune_scale` for methods that prune by opacity alone


@dataclass(frozen=True)
class DensityConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run."""

    start: float = 500.0
    stop: float = 15_000.0
    every: float = 100.0
    min_every: int = 50  # a short run densifies less often, so that each decision averages enough views
    resets: tuple[float, ...] = (3000.0, 6000.0, 9000.0, 12_000.0)
    # real iterations between resets, and before the first; at most the nominal time between them
    min_reset_spacing: int = 3000
    min_reset_rest: int = 6000  # real iterations left after a reset: until then it costs decibels
    grow_grad: float = 2e-4  # mean norm of dL/d(u, v) over the views that saw it, times half the image size
    grow_scale: float = 0.01  # of the scene extent: clone below, split above
    prune_opacity: float = 0.005
    prune_scale: float = 0.1  # of the scene extent, applied after the first reset
    reset_opacity: float = 0.01
    max_gaussians: int = 1_000_000  # growth stops here; largest gradients first

    def __post_init__(self) -> None:
        check_limits(
            self, "density",
            every=(1e-6, math.inf), min_every=(1, math.inf), max_gaussians=(1, math.inf),
            prune_opacity=(0, 1), reset_opacity=(1e-6, 1),
            **dict.fromkeys(
                ("start", "stop", "resets", "min_reset_spacing", "min_reset_rest", "grow_grad", "grow_scale",
                 "prune_scale"), (0, math.inf),
            ),
        )  # fmt: skip


@dataclass(frozen=True)
class Growth:
    """The rows that one round of growth copies or splits."""

    clones: Tensor  # [a] int64, rows that are copied
    splits: Tensor  # [b] int64, rows that two smaller samples replace

    @classmethod
    def of(cls, chosen: Tensor, small: Tensor) -> Growth:
        """Clone those of the chosen rows [N] bool that are small [N] bool, and split the others."""
        return cls(*(torch.nonzero(chosen & rows).squeeze(1) for rows in (small, ~small)))


class DensityControl:
    """Accumulates the screen-space statistic and changes the set of Gaussians on schedule.

    Override `statistic` to decide by another gradient, `choose` to select other rows for growth,
    `before_step` to add a regulariser, `refine` for another schedule.
    """

    # statistics of the backward pass beyond the signed sums, of `rendered.NEEDS`
    needs: ClassVar[frozenset[str]] = frozenset()
    reads_keep: ClassVar[bool] = False  # whether `observe` reads the keep map
    needs_effect: ClassVar[str] = ""  # name of the effect without which a run is refused
    # sums for each Gaussian since the last round: attribute name, and the shape after [N]
    sums: ClassVar[Mapping[str, tuple[int, ...]]] = {"grad_sum": (), "views_seen": ()}

    # attributes with plain values that a checkpoint holds
    saved: ClassVar[tuple[str, ...]] = ("last_growth", "last_reset", "resets_done")

    def __init__(self, config: DensityConfig, extent: float, seed: int) -> None:
        self.config = config
        self.extent = extent
        self.rng = np.random.default_rng([seed, 0xD3])
        self.grad_sum: Tensor  # [N] sum of the statistic's norm over the views in which the row was visible
        self.views_seen: Tensor  # [N] number of those views alone: rarely seen rows are not diluted
        for name, shape in self.sums.items():
            setattr(self, name, torch.zeros(0, *shape))
        self.last_growth = 0  # iteration
        self.last_reset = 0  # iteration
        self.resets_done = 0
        self.log = DensityLog()  # for pictures; decides nothing
        # function of means [N, 3] that returns rows [N] bool which an effect protects; None = there are none
        self.protected: Callable[[Tensor], Tensor] | None = None
        self._halves: dict[tuple[int, int], Tensor] = {}

    def setup(self, data: TrainData) -> None:
        """Called once before the first step, and again when a run resumes."""

    def before_step(self, step: Step, gradients: Gradients) -> Gradients:
        """Return the gradients for the optimiser: a place for regularisers of the parameters."""
        return gradients

    def statistic(self, gradients: Gradients) -> Tensor:
        """Return the screen-space gradient [N, 2] in 1/px that decides growth."""
        return gradients.screen

    @torch.no_grad()
    def observe(self, step: Step, gradients: Gradients, keep: Tensor | None = None) -> None:
        """Add one view to the sums of the rows that are visible in it; other rows stay as they are.

        The statistic is multiplied by half the image size, so that it does not depend on the resolution.

        Args:
            step: the training step of the view.
            gradients: gradients of the whole loss.
            keep: [H, W] weights of the loss, 1 = static; None = 1 everywhere. Not read here.
        """
        if step.nominal > self.config.stop:
            return
        self._match(step.gaussians)
        scale = self._half(step.camera.width, step.camera.height, gradients.screen.device)
        visible, statistic = step.rendered.visible, self.statistic(gradients)
        with backend_of(visible.device).all_threads():
            norms = torch.linalg.vector_norm(statistic * scale, dim=1)
            self.grad_sum += norms.masked_fill_(~visible, 0.0)
            self.views_seen += visible

    @torch.no_grad()
    def refine(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> tuple[Gaussians, list[str]]:
        """Grow, prune and reset if it is time.

        Returns:
            The Gaussians to go on with, and the events: any of "grow", "reset".
        """
        events: list[str] = []
        if self._growth_due(step):
            self._match(gaussians)
            # Bring pending rows up to date first: growth copies parameters.
            optimiser.flush()
            self.log.begin(step.iteration)
            self._ignore_protected(gaussians)
            gaussians = self._grow(step, gaussians, optimiser)
            gaussians = self._prune(gaussians, optimiser)
            gaussians = self.after_growth(step, gaussians, optimiser)
            self.log.now.count = len(gaussians)
            self._clear(gaussians)
            self.last_growth = step.iteration
            events.append("grow")
        if self._reset_due(step):
            self.reset_opacity(gaussians)
            optimiser.reset_moments(["opacity_logits"])
            self.last_reset = step.iteration
            events.append("reset")
        return gaussians, events

    def mutable_rows(self, rows: Tensor, gaussians: Gaussians) -> Tensor:
        """Return those of these rows that are not protected, [N] bool."""
        return rows if self.protected is None else rows & ~self.protected(gaussians.means)

    def leaves_only_protected(self, drop: Tensor, gaussians: Gaussians) -> bool:
        """Whether only protected rows would remain; then no row is dropped, or nothing could learn."""
        return not bool(self.mutable_rows(~drop, gaussians).any())

    def weights(self, gaussians: Gaussians) -> Tensor:
        """Return weights [N] for a mean over the Gaussians in a loss; protected ones have weight 0."""
        mutable = self.mutable_rows(
            torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.device), gaussians
        )
        return mutable / mutable.sum().clamp(min=1)

    def _ignore_protected(self, gaussians: Gaussians) -> None:
        """Zero the sums of protected rows, as if no view had seen them since the last round."""
        if self.protected is not None:
            rows = self.protected(gaussians.means)
            for name in self.sums:
                getattr(self, name)[rows] = 0.0

    def reset_opacity(self, gaussians: Gaussians) -> None:
        """Hook: lower the opacities, in place."""
        target = self.config.reset_opacity
        gaussians.opacity_logits.clamp_(max=float(np.log(target / (1 - target))))

    def due(self, step: Step) -> bool:
        """Whether `refine` may change something now; classes that override `refine` extend it.

        Only then does the host of an accelerator check whether the photo was fully masked.
        """
        config = self.config
        resets = self.resets_done < len(config.resets) and step.nominal >= config.resets[self.resets_done]
        return self._growth_due(step) or resets

    def _growth_due(self, step: Step) -> bool:
        config, since = self.config, step.iteration - self.last_growth
        due = since >= config.min_every and config.start <= step.nominal <= config.stop
        # in nominal iterations; in short runs `min_every` dominates
        return due and since * (step.nominal / step.iteration) >= config.every - 1e-6

    def after_growth(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        """Hook: change the set once more after growth and pruning, for example by merging."""
        return gaussians

    def clone_offset(self, gaussians: Gaussians, rows: Tensor) -> Tensor | None:
        """Hook: return the offsets of copies from their originals, [len(rows), 3]; None = none."""
        return None

    def _half(self, width: int, height: int, device: torch.device) -> Tensor:
        """Return half a picture's size [2], copied once: a copy in every step would make the host wait."""
        if (width, height) not in self._halves:
            self._halves[width, height] = torch.tensor([width / 2, height / 2]).to(device)
        return self._halves[width, height]

    def _reset_due(self, step: Step) -> bool:
        config = self.config
        for before, reset in list(zip((0.0, *config.resets), config.resets))[self.resets_done :]:
            if step.nominal < reset:
                break
            grows = reset <= config.stop  # as in 3DGS: no reset after growth ends
            self.resets_done += 1
            rest = step.iteration * (NOMINAL_ITERATIONS / step.nominal - 1.0)
            apart = step.iteration - self.last_reset >= min(config.min_reset_spacing, reset - before)
            if grows and apart and rest >= config.min_reset_rest:
                return True
        return False

    def choose(self, step: Step, gaussians: Gaussians) -> Growth:
        """Choose the rows that grow in this round, at most `room` of them."""
        score = self.mean_gradient()
        chosen = top_k_mask(score, score > self.config.grow_grad, self.room(step, gaussians))
        return Growth.of(chosen, self.small(gaussians))

    def mean_gradient(self) -> Tensor:
        """Return the mean norm of each row's statistic over the views that saw it, [N]; 0 where none did."""
        return self.grad_sum / self.views_seen.clamp(min=1)

    def room(self, step: Step, gaussians: Gaussians) -> int:
        """Return how many Gaussians may be added now."""
        return max(step.growth_cap - len(gaussians), 0)

    def small(self, gaussians: Gaussians) -> Tensor:
        """Return which Gaussians are small enough to be cloned, [N] bool; growth splits the others."""
        return gaussians.log_scales.exp().amax(dim=1) <= self.config.grow_scale * self.extent

    def _grow(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        growth = self.choose(step, gaussians)
        clones, splits = growth.clones, growth.splits
        copies = gaussians.select(clones)
        offset = self.clone_offset(gaussians, clones)
        if offset is not None:
            copies.means += offset
        halves = [self._split_half(gaussians.select(splits)) for _ in range(2)]
        stay = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.device)
        stay[splits] = False
        optimiser.select(stay)
        self._select(stay)
        new = copies.cat(halves[0]).cat(halves[1])
        self.log.grew(len(clones), len(splits), new.means)
        gaussians = gaussians.select(stay).cat(new)
        optimiser.append(len(new))
        self._match(gaussians)
        return gaussians

    def _split_half(self, parents: Gaussians) -> Gaussians:
        """Draw one sample from each parent, 1.6 times smaller."""
        noise = torch.from_numpy(self.rng.standard_normal((len(parents), 3)).astype(np.float32))
        parents.means += covariance_offsets(noise.to(parents.device), parents)
        parents.log_scales -= float(np.log(1.6))
        return parents

    def _prune(self, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        config = self.config
        drop = torch.sigmoid(gaussians.opacity_logits) < config.prune_opacity
        if self.last_reset:
            drop |= gaussians.log_scales.exp().amax(dim=1) > config.prune_scale * self.extent
        drop = self.mutable_rows(drop, gaussians) | ~torch.isfinite(gaussians.means).all(dim=1)
        return self.drop_rows(gaussians, optimiser, drop)

    def drop_rows(self, gaussians: Gaussians, optimiser: SplatAdam, drop: Tensor) -> Gaussians:
        """Prune these rows [N] bool, unless they are none or only protected ones would remain."""
        if not bool(drop.any()) or self.leaves_only_protected(drop, gaussians):
            return gaussians
        self.log.now.pruned += int(drop.sum())
        return self.keep_rows(gaussians, optimiser, ~drop)

    def keep_rows(self, gaussians: Gaussians, optimiser: SplatAdam, stay: Tensor) -> Gaussians:
        """Keep these rows and drop the others, in parameters, moments and statistics at once."""
        optimiser.select(stay)
        self._select(stay)
        return gaussians.select(stay)

    def _select(self, stay: Tensor) -> None:
        for name in self.sums:
            setattr(self, name, getattr(self, name)[stay])

    def _match(self, gaussians: Gaussians) -> None:
        """Pad the sums with zeros for new rows; after a resume, bring them to the device."""
        device = gaussians.device
        for name, shape in self.sums.items():
            values = getattr(self, name)
            pad = torch.zeros(max(len(gaussians) - len(values), 0), *shape, device=device)
            setattr(self, name, torch.cat([values.to(device), pad]))

    def _clear(self, gaussians: Gaussians) -> None:
        for name, shape in self.sums.items():
            setattr(self, name, torch.zeros(len(gaussians), *shape, device=gaussians.device))

    def state_dict(self) -> State:
        return {
            **{name: getattr(self, name) for name in (*self.sums, *self.saved)},
            "rng": self.rng.bit_generator.state,
            "log": self.log.state_dict(),
        }

    def load_state_dict(self, state: State) -> None:
        for name in (*self.sums, *self.saved):
            setattr(self, name, state[name])
        self.rng.bit_generator.state = state["rng"]
        self.log.load_state_dict(state["log"])


def top_k_mask(score: Tensor, chosen: Tensor, room: int) -> Tensor:
    """Return the `room` chosen rows with the largest score, [N] bool."""
    if int(chosen.sum()) <= room:
        return chosen
    # stable sort: ties are broken by row, so the same seed gives the same set
    order = torch.argsort(
        torch.where(chosen, score, torch.full_like(score, -1.0)), descending=True, stable=True
    )
    kept = torch.zeros_like(chosen)
    kept[order[:room]] = True
    return kept


def covariance_offsets(noise: Tensor, gaussians: Gaussians) -> Tensor:
    """Transform normal draws [N, 3] to offsets [N, 3] with the Gaussians' covariances."""
    local = noise * gaussians.log_scales.exp()
    return (rotation_matrices(gaussians.quats) @ local[:, :, None]).squeeze(2)
