"""Entropy-aware density control (RefineSplat, section 4.2): growth, places of clones, merging, support.

Ours is support: a Gaussian that is masked in every photo whose frame contains it is never corrected, and a
view between those photos shows it as a dark blotch in mid-air. Such Gaussians are removed. If one was right,
the hole that it leaves is no evidence for a mask (`least_alpha`) and is learnt again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import State, check_limits
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.refinesplat.merging import MergeConfig, merge_gaussians
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.density import (
    NO_SIZE_PRUNING,
    DensityConfig,
    DensityControl,
)
from ambiguous_wild.splat.gaussians import Gaussians, rotation_matrices
from ambiguous_wild.splat.rendered import Gradients

if TYPE_CHECKING:
    from ambiguous_wild.splat.optim import SplatAdam
    from ambiguous_wild.splat.step import Step


@dataclass(frozen=True)
class SupportConfig:
    """When a Gaussian counts as unsupported."""

    least_share: float = 0.1  # least share of looks that reach a kept pixel; 0 = never removed (printed)
    looks: int = 8  # number of looks, with its centre in the frame, before it is judged
    every: int = 4  # iterations between looks

    def __post_init__(self) -> None:
        whole = (1, math.inf)
        check_limits(self, "refinesplat.density.support", least_share=(0, 1), looks=whole, every=whole)


class Support:
    """Counts for each Gaussian how often its centre was in the frame, and how often on a kept pixel."""

    def __init__(self, config: SupportConfig) -> None:
        self.config = config
        self.looked = torch.zeros(0)  # [N]
        self.kept = torch.zeros(0)  # [N]

    def due(self, iteration: int) -> bool:
        """Whether a view is observed in this iteration."""
        return self.config.least_share > 0 and iteration % self.config.every == 0

    def observe(self, gaussians: Gaussians, visible: Tensor, camera: Camera, keep: Tensor | None) -> None:
        """Add one view.

        Args:
            gaussians: the N Gaussians.
            visible: [N] bool, rows that passed every cull of the render.
            camera: camera of the step.
            keep: [H, W] float32 at the camera's size, 1 = static; None = 1 everywhere.
        """
        backend = backend_of(gaussians.device)
        rows = backend.visible_rows(lambda: visible)
        means = gaussians.means[rows]
        inside, supported = _on_kept(means, camera, keep)
        if keep is not None:
            hidden = backend.visible_rows(lambda: inside & ~supported)
            # a large Gaussian may be supported at its flanks
            parts = means[hidden], gaussians.quats[rows][hidden], gaussians.log_scales[rows][hidden]
            supported[hidden] |= _flank_on_kept(*parts, camera, keep)
        inside &= visible[rows]
        self.looked[rows] += inside.to(self.looked.dtype)
        self.kept[rows] += (inside & supported).to(self.kept.dtype)

    def unsupported(self) -> Tensor:
        """Return the Gaussians to remove, [N] bool; the counts of judged ones that stay are halved."""
        judged = self.looked >= self.config.looks
        drop = judged & (self.kept < self.config.least_share * self.looked)
        half = torch.where(judged, 0.5, 1.0)
        self.looked, self.kept = self.looked * half, self.kept * half
        return drop

    def select(self, stay: Tensor) -> None:
        """Keep the rows `stay` [N] bool."""
        self.looked, self.kept = self.looked[stay], self.kept[stay]

    def match(self, count: int, device: torch.device) -> None:
        """Pad with zeros for new rows; after a resume, bring the counts to the device."""
        pad = torch.zeros(max(count - len(self.looked), 0), device=device)
        self.looked = torch.cat([self.looked.to(device), pad])
        self.kept = torch.cat([self.kept.to(device), pad])

    def state_dict(self) -> State:
        return {"looked": self.looked, "kept": self.kept}

    def load_state_dict(self, state: State) -> None:
        self.looked, self.kept = state["looked"], state["kept"]


def _flank_on_kept(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    log_scales: Tensor,  # [N, 3]
    camera: Camera,
    keep: Tensor | None,
) -> Tensor:
    """Return Gaussians whose flanks, a standard deviation along each axis, reach a kept pixel, [N] bool."""
    axes = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    ends = means[:, None, :] + torch.cat([axes, -axes], dim=2).transpose(1, 2)
    _, flanks = _on_kept(ends.reshape(-1, 3), camera, keep)
    return flanks.reshape(-1, 6).any(dim=1)


def _on_kept(points: Tensor, camera: Camera, keep: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return which world points [N, 3] are inside the frame, and which on a kept pixel, [N] bool each."""
    pose = backend_of(points.device).pose(camera, points)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    z = local[:, 2].clamp(min=1e-6)
    u = torch.floor((local[:, 0] / z * camera.fx + camera.cx).clamp(-1.0, camera.width)).long()
    v = torch.floor((local[:, 1] / z * camera.fy + camera.cy).clamp(-1.0, camera.height)).long()
    inside = (local[:, 2] > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    if keep is None:
        return inside, inside.clone()
    kept = keep[v.clamp(0, camera.height - 1), u.clamp(0, camera.width - 1)] > 0.5
    return inside, inside & kept


Decides = Literal["total", "photometric", "entropy"]


@dataclass(frozen=True)
class EntropyDensityConfig(DensityConfig):
    """Growth that starts late, as in RobustSplat, when the static scene and the masks are stable."""

    start: float = 10_000.0
    stop: float = 20_000.0
    resets: tuple[float, ...] = (15_000.0, 18_000.0)
    prune_scale: float = NO_SIZE_PRUNING  # as RobustSplat: sky and far walls are larger than any limit
    decides: Decides = "total"  # gradient that decides growth: of L, of L_GS, or of the entropy terms
    clone_shift: float = 0.5  # offset of a clone down the gradient, in its standard deviations
    merge_every: float = 1000.0  # nominal iterations between merges; 0 = never
    merge_grad: float = 5e-5  # tau_e: only Gaussians whose mean statistic is below it may merge
    merge: MergeConfig = field(default_factory=MergeConfig)
    support: SupportConfig = field(default_factory=SupportConfig)  # removal of always masked Gaussians

    def __post_init__(self) -> None:
        super().__post_init__()
        check_limits(
            self, "density", **dict.fromkeys(("clone_shift", "merge_every", "merge_grad"), (0, math.inf))
        )


class EntropyAwareDensity(DensityControl):
    """Grows by the gradient of the whole loss, entropy terms included, and merges overlapping Gaussians."""

    config: EntropyDensityConfig
    # [N, 3] sum of -dL/dmean over views, world
    sums: ClassVar[Mapping[str, tuple[int, ...]]] = {**DensityControl.sums, "downhill": (3,)}
    reads_keep: ClassVar[bool] = True  # for `support`
    saved = (*DensityControl.saved, "last_merge", "merged", "last_judged")
    downhill: Tensor

    def __init__(self, config: DensityConfig, extent: float, seed: int) -> None:
        if not isinstance(config, EntropyDensityConfig):
            raise TypeError(f"entropy-aware density control needs EntropyDensityConfig, got {type(config)}")
        if config.decides not in ("total", "photometric", "entropy"):
            raise unknown("gradient", config.decides, ("total", "photometric", "entropy"))
        super().__init__(config, extent, seed)
        self.last_merge = 0.0  # nominal iteration
        self.merged = 0  # number of Gaussians that merging has removed
        self.support = Support(config.support)
        self.last_judged = 0  # iteration

    def statistic(self, gradients: Gradients) -> Tensor:
        entropy = gradients.screen_extra
        if entropy is None:  # a step without entropy terms
            if self.config.decides != "entropy":
                return gradients.screen
            entropy = torch.zeros_like(gradients.screen)
        if self.config.decides == "total":
            return gradients.screen + entropy
        return gradients.screen if self.config.decides == "photometric" else entropy

    @torch.no_grad()
    def observe(self, step: Step, gradients: Gradients, keep: Tensor | None = None) -> None:
        super().observe(step, gradients, keep)
        with backend_of(step.gaussians.device).all_threads():
            if step.nominal <= self.config.stop:
                self.downhill -= gradients.means
            if self.support.due(step.iteration):
                self.support.match(len(step.gaussians), step.gaussians.device)
                self.support.observe(step.gaussians, step.rendered.visible, step.camera, keep)

    @torch.no_grad()
    def refine(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> tuple[Gaussians, list[str]]:
        """Refine as 3DGS; every `min_every` iterations also remove Gaussians without support."""
        gaussians, events = super().refine(step, gaussians, optimiser)
        if events or not self._judgement_due(step):
            return gaussians, events  # rows change at most once in an iteration
        self.last_judged = step.iteration
        self._match(gaussians)
        drop = self.mutable_rows(self.support.unsupported(), gaussians)
        if not bool(drop.any()) or self.leaves_only_protected(drop, gaussians):
            return gaussians, events
        optimiser.flush()
        self.log.now.pruned += int(drop.sum())
        gaussians = self.keep_rows(gaussians, optimiser, ~drop)
        self.log.now.count = len(gaussians)
        return gaussians, ["prune"]

    def due(self, step: Step) -> bool:
        return super().due(step) or self._judgement_due(step)

    def _judgement_due(self, step: Step) -> bool:
        due = step.iteration - self.last_judged >= self.config.min_every
        return due and self.config.support.least_share > 0

    def clone_offset(self, gaussians: Gaussians, rows: Tensor) -> Tensor | None:
        """Shift clones down the entropy-aware gradient (Fig. 3b), by a share of their deviation along it."""
        if self.config.clone_shift <= 0 or not len(rows):
            return None
        direction = self.downhill[rows]
        norm = torch.linalg.vector_norm(direction, dim=1, keepdim=True)
        direction = torch.where(norm > 0, direction / norm.clamp(min=1e-30), torch.zeros_like(direction))
        rotation = rotation_matrices(gaussians.quats[rows])
        local = (rotation.transpose(1, 2) @ direction[:, :, None]).squeeze(2)
        # sqrt(d^T Sigma d): the offset never leaves the Gaussian
        sigma = torch.linalg.vector_norm(local * gaussians.log_scales[rows].exp(), dim=1, keepdim=True)
        return self.config.clone_shift * sigma * direction

    def after_growth(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        """Merge by Algorithm 1, every `merge_every` nominal iterations."""
        config = self.config
        if config.merge_every <= 0 or step.nominal - self.last_merge < config.merge_every:
            return gaussians
        self.last_merge = step.nominal
        # rows that no view has seen since the last round, above all new copies, have no statistic
        candidates = (self.views_seen > 0) & (self.mean_gradient() < config.merge_grad)
        result = merge_gaussians(gaussians, candidates, config.merge)
        if result is None:
            return gaussians
        rows, new = result
        stay = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.device)
        stay[rows] = False
        gaussians = self.keep_rows(gaussians, optimiser, stay)
        gaussians = gaussians.cat(new)
        optimiser.append(len(new))  # new Gaussians start with zero moments
        self._match(gaussians)
        self.merged += len(rows) - len(new)
        self.log.merge(len(rows) - len(new), new.means)
        return gaussians

    def _select(self, stay: Tensor) -> None:
        super()._select(stay)
        self.support.select(stay)

    def _match(self, gaussians: Gaussians) -> None:
        super()._match(gaussians)
        self.support.match(len(gaussians), gaussians.device)

    def state_dict(self) -> State:
        return super().state_dict() | {"support": self.support.state_dict()}

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        self.support.load_state_dict(state["support"])
