"""What an effect is: a change around the render call, with its own way back for gradients.

    camera -> [poses] -> model -> [appearance] -> [3D filter] -> render -> image -> [exposure]

Forward in that order, backward in reverse. The mask policy and the loss see the changed picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import (
    Cotangents,
    Frame,
    FramePull,
    Gradients,
    Pull,
    ShadeGradients,
    ShadePull,
)
from ambiguous_wild.splat.step import NOMINAL_ITERATIONS, Shot, Step, TrainData

State = dict[str, Any]


class Effect:
    """Does nothing. Override the hooks of the places it acts in; the others are never called.

    What goes through a hook comes back through the pull that it returned: no hook keeps anything of one
    picture in the object. Gradients of the effect's own parameters travel in `own`, under its name.
    """

    name = ""
    reads_photo = (
        False  # its colours come from the photo itself: of a test photo, from the part that may be read
    )

    antialias = False  # whether the renderer is to use Mip-Splatting's 2D filter, whatever the method says

    def acts(self, hook: str) -> bool:
        """Whether that hook is to be called at all."""
        return getattr(type(self), hook) is not getattr(Effect, hook)

    def first_points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        """xyz [M, 3] and rgb [M, 3] uint8 of at most so many points to start from beside the method's."""
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)

    def setup(self, data: TrainData) -> None:
        """Called once before the first step, and again when a run resumes."""

    def rows(self, gaussians: Gaussians) -> Mapping[str, GaussianAttribute]:
        """What every Gaussian carries for this effect from the start, by name: `Gaussians.extra`."""
        return {}

    def spared(self, means: Tensor) -> Tensor:
        """[N] bool of means [N, 3]: rows that density control neither copies nor removes."""
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)

    def camera(self, shot: Shot) -> Camera:
        """The camera of a train photo, at the resolution of the step."""
        return shot.camera

    def model(self, gaussians: Gaussians, shot: Shot) -> tuple[Gaussians, Pull]:
        """The Gaussians as they are drawn, all rows; the pull must not change tensors in place."""
        return gaussians, same

    def shade(
        self, gaussians: Gaussians, rows: Tensor | slice, base: Tensor, shot: Shot
    ) -> tuple[Tensor, ShadePull]:
        """Colours [M, 3] of the visible rows from those of the harmonics, see `rendered.Shade`."""
        return base, ShadeGradients

    def image(self, frame: Frame, shot: Shot) -> tuple[Frame, FramePull]:
        """The pictures as they are compared; not in place.

        The effect learns from `Cotangents.image` alone: a method's own loss on the render (`extra`) is no
        statement about a photo's exposure.
        """
        return frame, unchanged

    def pose(self, gaussians: Gaussians, gradients: Gradients, shot: Shot) -> Mapping[str, Tensor]:
        """Own gradients of a train photo's camera; `gaussians` and `gradients` are the render call's."""
        return {}

    def step(self, own: Mapping[str, Tensor], shot: Shot, called_off: Tensor | None = None) -> None:
        """Learn from the gradients of one step.

        Args:
            own: of the effect's own parameters, as its pulls gave them.
            shot: whose they are.
            called_off: on an accelerator, [1] float32 there; 1 = nothing is to change, whatever they are.
        """

    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        """Called last in every step, with the Gaussians that the next one starts from."""

    def rows_changed(self) -> None:
        """Density control made, split, merged or dropped Gaussians."""

    def begin_fit(self) -> None:
        """A test photo is about to be fitted: its row starts neutral."""

    def fit(self, own: Mapping[str, Tensor]) -> None:
        """One step of that row alone; nothing shared changes."""

    def facts(self) -> dict[str, Any]:
        """Plain values for the run's metrics."""
        return {}

    def state_dict(self) -> State:
        return {}

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; exact, so that a resumed run gives the same bits."""


def same(gradients: Gradients) -> Gradients:
    """The pull of a model that was not changed."""
    return gradients


def unchanged(cotangents: Cotangents) -> Cotangents:
    """The pull of a picture that was not changed."""
    return cotangents


class RowAdam:
    """Adam over the rows of a table [V, ...], each with moments and a count of its own.

    A row moves only when its photo was seen: Adam's momentum would carry the others along for nothing.
    """

    betas, eps = (0.9, 0.999), 1e-15

    def __init__(self, values: Tensor) -> None:
        self.values = values
        self.first, self.second = torch.zeros_like(values), torch.zeros_like(values)
        self.steps = [0] * len(values)

    def step(
        self, row: int, gradient: Tensor, rate: float | Tensor, called_off: Tensor | None = None
    ) -> None:
        """One step of one row; `rate` broadcasts over it, `called_off` is that of `Effect.step`.

        A step that was called off counts: the host does not know of it, and only the correction of the
        moments' bias is off by it.
        """
        self.steps[row] += 1
        first, second = self.first[row], self.second[row]
        weights: tuple[Any, Any] = (1 - self.betas[0], 1 - self.betas[1])
        if called_off is not None:
            go = share_of(called_off, gradient)
            gradient = gradient.masked_fill(go <= 0, 0.0)  # it may not be finite
            weights, rate = (weights[0] * go, weights[1] * go), rate * go
        first.lerp_(gradient, weights[0])
        second.lerp_(gradient * gradient, weights[1])
        bias1, bias2 = (1 - beta ** self.steps[row] for beta in self.betas)
        self.values[row] -= rate / bias1 * first / ((second / bias2).sqrt() + self.eps)

    def reset(self, row: int) -> None:
        """That row at zero, as if it had never been seen."""
        for tensor in (self.values, self.first, self.second):
            tensor[row] = 0.0
        self.steps[row] = 0

    def state_dict(self) -> State:
        return {"values": self.values, "first": self.first, "second": self.second, "steps": self.steps}

    def load_state_dict(self, state: State) -> None:
        for name in ("values", "first", "second"):
            getattr(self, name).copy_(state[name])
        self.steps = [int(n) for n in state["steps"]]


def share_of(called_off: Tensor, like: Tensor) -> Tensor:
    """0-d, in the type of `like`: 0 where the step was called off, 1 where not."""
    return 1.0 - called_off.reshape(()).to(like)


def decayed(first: float, last: float, progress: float) -> float:
    """Exponential decay from `first` to `last` over the run."""
    return float(first * (last / first) ** progress)


def rate_for_run_length(rate: float, made_for: int, shot: Shot) -> float:
    """A learning rate of Adam for a run of another length than the rate was published for.

    Times the root of how many times shorter the run is, at most 10; a longer run gets the rate itself. Adam's
    steps have the size of the rate, and a random walk of them goes as far as the root of their number.
    """
    length = shot.iteration * NOMINAL_ITERATIONS / max(shot.nominal, 1e-9)  # of the run, in iterations
    return rate * min(max(made_for / length, 1.0), 100.0) ** 0.5
