"""SpotLessSplats' density control: no opacity reset, harmonics cut once, Gaussians without use removed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from ambiguous_wild.splat.density import NO_SIZE_PRUNING, DensityConfig, DensityControl
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step


@dataclass(frozen=True)
class SpotLessDensityConfig(DensityConfig):
    """3DGS's without opacity resets and without pruning by size."""

    resets: tuple[float, ...] = ()
    prune_scale: float = NO_SIZE_PRUNING
    free_colour: float = 8002.0  # nominal iteration at which higher harmonics are cut
    most_colour: float = 0.001  # what they are cut to from above
    least_use: float = (
        0.0  # prune below this sum of squared screen gradients; published, off there too: 1e-14
    )


class SpotLessDensity(DensityControl):
    """Clone, split and prune as in 3DGS."""

    config: SpotLessDensityConfig
    cut = False  # whether higher harmonics were

    @torch.no_grad()
    def refine(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> tuple[Gaussians, list[str]]:
        gaussians, events = super().refine(step, gaussians, optimiser)
        if self._cut_due(step):
            optimiser.bind(gaussians)
            optimiser.reset_moments(["sh_rest"])  # postponed steps are made first
            gaussians.sh_rest.clamp_(max=self.config.most_colour)
            self.cut = True
        return gaussians, events

    def due(self, step: Step) -> bool:
        return super().due(step) or self._cut_due(step)

    def _cut_due(self, step: Step) -> bool:
        return not self.cut and step.nominal >= self.config.free_colour

    def state_dict(self) -> dict[str, Any]:
        return super().state_dict() | {"cut": self.cut}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self.cut = bool(state["cut"])


class PruningDensity(SpotLessDensity):
    """Removes Gaussians on which pictures hardly depended since the last round."""

    needs: ClassVar[frozenset[str]] = frozenset({"squared"})
    sums: ClassVar[Mapping[str, tuple[int, ...]]] = {"grad_sum": (), "seen": (), "use_sum": ()}
    use_sum: Tensor  # [N] sum of squared screen gradients, 1/px^2

    @torch.no_grad()
    def observe(self, step: Step, gradients: Gradients, keep: Tensor | None = None) -> None:
        super().observe(step, gradients, keep)
        if step.nominal <= self.config.stop:
            assert gradients.squared is not None
            self.use_sum += gradients.squared

    def _grow(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        grown = super()._grow(step, gaussians, optimiser)
        new = self.log.now.cloned + 2 * self.log.now.split
        self.use_sum[len(grown) - new :] = 1.0  # nothing is known of them yet
        return grown

    def _prune(self, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        gaussians = super()._prune(gaussians, optimiser)
        drop = self.free(~(self.use_sum >= self.config.least_use), gaussians)
        if not bool(drop.any()) or self.empties(drop, gaussians):
            return gaussians
        self.log.now.pruned += int(drop.sum())
        return self.keep_rows(gaussians, optimiser, ~drop)
