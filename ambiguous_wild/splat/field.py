"""A field: Gaussians that learn together, their optimiser and their density control."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step

Rates = Callable[[float], Mapping[str, float]]  # learning rate of every tensor at a progress in [0, 1]


@dataclass(frozen=True)
class GaussianAttribute:
    """What one method carries with every Gaussian."""

    values: Tensor  # [N, ...] float32
    rate: float = 0.0  # learning rate of Adam; 0 = carried, not learnt
    final: float | None = None  # it decays exponentially to here; None = it stays

    def at(self, progress: float) -> float:
        """The learning rate at this share of the run."""
        return self.rate if self.final is None else self.rate * (self.final / self.rate) ** progress


class Field:
    """A trainer has one or more; only the first is part of a test view."""

    def __init__(self, gaussians: Gaussians, rates: Rates, density: DensityControl | None = None) -> None:
        """
        Args:
            gaussians: to start from.
            rates: of every tensor, `extra` included where it learns.
            density: None = their number stays.
        """
        self.rates, self.density = rates, density
        self.start_from(gaussians)

    def start_from(self, gaussians: Gaussians) -> None:
        """Go on with these, with fresh moments."""
        self.gaussians = gaussians
        self.optimiser = SplatAdam(gaussians, self.rates(0.0))

    def learn(self, gradients: Gradients, progress: float, called_off: Tensor | None = None) -> None:
        """One step of Adam; `called_off` as in `SplatAdam.step`."""
        visible = gradients.visible
        if visible is None:
            visible = torch.ones(len(self.gaussians), dtype=torch.bool, device=self.gaussians.device)
        self.optimiser.step(gradients, visible, self.rates(progress), called_off=called_off)

    def refine(self, step: Step, gradients: Gradients, keep: Tensor | None) -> list[str]:
        """Density control after one view; returns what happened, see `DensityControl.refine`."""
        if self.density is None:
            return []
        self.density.observe(step, gradients, keep)
        self.gaussians, events = self.density.refine(step, self.gaussians, self.optimiser)
        self.optimiser.bind(self.gaussians)
        return events

    def state_dict(self) -> dict[str, Any]:
        return {
            "gaussians": dict(self.gaussians.items()),
            **({"extra": dict(self.gaussians.extra)} if self.gaussians.extra else {}),
            "optimiser": self.optimiser.state_dict(),
            **({} if self.density is None else {"density": self.density.state_dict()}),
        }

    def load_state_dict(self, state: Mapping[str, Any], device: torch.device) -> None:
        """Restore what `state_dict` returned; exact, so that a resumed run gives the same bits."""
        loaded = Gaussians(**state["gaussians"], extra=state.get("extra", {}))
        self.start_from(loaded.to(device))
        self.optimiser.load_state_dict(state["optimiser"])
        if self.density is not None:
            self.density.load_state_dict(state["density"])


def rates_with(rows: Mapping[str, GaussianAttribute], rates: Rates) -> Rates:
    """Learning rates of the parameters and of what is carried beside them."""
    learnt = {name: row for name, row in rows.items() if row.rate > 0}
    if not learnt:
        return rates
    return lambda progress: {**rates(progress), **{name: row.at(progress) for name, row in learnt.items()}}
