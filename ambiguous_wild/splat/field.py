"""A field: Gaussians that learn together, their optimiser and their density control."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from ambiguous_wild.core.config import State
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step

Rates = Callable[[float], Mapping[str, float]]  # progress in [0, 1] -> learning rate of every tensor


@dataclass(frozen=True)
class GaussianAttribute:
    """A tensor that a method stores with every Gaussian."""

    values: Tensor  # [N, ...] float32
    rate: float = 0.0  # learning rate of Adam; 0 = not learnt
    final: float | None = None  # the rate decays exponentially to this one; None = it is constant

    def at(self, progress: float) -> float:
        """Return the learning rate at this share of the run."""
        return self.rate if self.final is None else self.rate * (self.final / self.rate) ** progress


class Field:
    """Gaussians with optimiser and density control; of several fields only the first is in a test view."""

    def __init__(self, gaussians: Gaussians, rates: Rates, density: DensityControl | None = None) -> None:
        """
        Args:
            gaussians: the Gaussians to start from.
            rates: learning rates of every tensor, attributes that learn included.
            density: density control; None = the number of Gaussians stays.
        """
        self.rates, self.density = rates, density
        self.start_from(gaussians)

    def start_from(self, gaussians: Gaussians) -> None:
        """Replace the Gaussians; Adam starts with zero moments."""
        self.gaussians = gaussians
        self.optimiser = SplatAdam(gaussians, self.rates(0.0))

    def learn(self, gradients: Gradients, progress: float, skip_step: Tensor | None = None) -> None:
        """Take one step of Adam; `skip_step` as in `SplatAdam.step`."""
        visible = gradients.visible
        if visible is None:
            visible = torch.ones(len(self.gaussians), dtype=torch.bool, device=self.gaussians.device)
        self.optimiser.step(gradients, visible, self.rates(progress), skip_step=skip_step)

    def refine(self, step: Step, gradients: Gradients, keep: Tensor | None) -> list[str]:
        """Run density control after one view; returns its events, see `DensityControl.refine`."""
        if self.density is None:
            return []
        self.density.observe(step, gradients, keep)
        self.gaussians, events = self.density.refine(step, self.gaussians, self.optimiser)
        self.optimiser.bind(self.gaussians)
        return events

    def state_dict(self) -> State:
        return {
            "gaussians": dict(self.gaussians.items()),
            **({"extra": dict(self.gaussians.attributes)} if self.gaussians.attributes else {}),
            "optimiser": self.optimiser.state_dict(),
            **({} if self.density is None else {"density": self.density.state_dict()}),
        }

    def load_state_dict(self, state: State, device: torch.device) -> None:
        """Restore what `state_dict` returned; exact, so that a resumed run gives the same bits."""
        loaded = Gaussians(**state["gaussians"], attributes=state.get("extra", {}))
        self.start_from(loaded.to(device))
        self.optimiser.load_state_dict(state["optimiser"])
        if self.density is not None:
            self.density.load_state_dict(state["density"])


def rates_with_attributes(attributes: Mapping[str, GaussianAttribute], rates: Rates) -> Rates:
    """Return the learning rates of the parameters and of these attributes."""
    learnt = {name: a for name, a in attributes.items() if a.rate > 0}
    if not learnt:
        return rates
    return lambda progress: {**rates(progress), **{name: a.at(progress) for name, a in learnt.items()}}
