"""Base of effects: changes before or after the render call, each with its own backward pass.

    camera -> [poses] -> model -> [appearance] -> [3D filter] -> render -> image -> [exposure]

Effects act in this order; gradients pass them in reverse. The mask policy and the loss get the changed
picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import (
    Cotangents,
    Frame,
    FrameVjp,
    Gradients,
    ShadeGradients,
    ShadeVjp,
    Vjp,
)
from ambiguous_wild.splat.step import Step, TrainData, ViewContext
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS


class Effect:
    """An effect that does nothing. Override the hooks of the places where yours acts; others are not called.

    Gradients pass a hook through the vjp that it returned: hooks store nothing about a picture.
    Gradients of the effect's own parameters are passed in `effect_grads`, under the effect's name.
    """

    name = ""
    reads_photo = False  # whether its colours come from the photo (of a test photo: from the part to fit to)
    antialias = False  # whether the renderer is to use Mip-Splatting's 2D filter, whatever the method says

    def acts(self, hook: str) -> bool:
        """Whether this hook is overridden, so that it must be called."""
        return getattr(type(self), hook) is not getattr(Effect, hook)

    def first_points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        """Return xyz [M, 3] and rgb [M, 3] uint8 of at most `most` further points to start from."""
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)

    def setup(self, data: TrainData) -> None:
        """Called once before the first step, and again when a run resumes."""

    def rows(self, gaussians: Gaussians) -> Mapping[str, GaussianAttribute]:
        """Return the attributes that the effect needs with every Gaussian, see `Gaussians.attributes`."""
        return {}

    def frozen_in_density_control(self, means: Tensor) -> Tensor:
        """Return the rows that density control must neither copy nor remove, [N] bool, from means [N, 3]."""
        return torch.zeros(len(means), dtype=torch.bool, device=means.device)

    def camera(self, context: ViewContext) -> Camera:
        """Return the camera of a train photo, at the resolution of the step."""
        return context.camera

    def model(self, gaussians: Gaussians, context: ViewContext) -> tuple[Gaussians, Vjp]:
        """Return the Gaussians as they are drawn, all rows, and a vjp that changes no tensor in place."""
        return gaussians, identity_vjp

    def shade(
        self, gaussians: Gaussians, rows: Tensor | slice, base: Tensor, context: ViewContext
    ) -> tuple[Tensor, ShadeVjp]:
        """Return colours [M, 3] of the visible rows from those of the harmonics, see `rendered.Shade`."""
        return base, ShadeGradients

    def image(self, frame: Frame, context: ViewContext) -> tuple[Frame, FrameVjp]:
        """Return the pictures as they are compared with the photo, as new tensors.

        The effect learns from `Cotangents.image` alone: what a method gives as `extra` tells nothing about a
        photo's exposure.
        """
        return frame, identity_frame_vjp

    def pose(self, gaussians: Gaussians, gradients: Gradients, context: ViewContext) -> Mapping[str, Tensor]:
        """Return own gradients from a train photo's camera, given Gaussians and gradients of the render."""
        return {}

    def step(
        self, effect_grads: Mapping[str, Tensor], context: ViewContext, skip_step: Tensor | None = None
    ) -> None:
        """Learn from the gradients of one step.

        Args:
            effect_grads: gradients of the effect's own parameters, as its vjps returned them.
            context: view context of the step.
            skip_step: on an accelerator [1] float32; 1 = change nothing, whatever the gradients are.
        """

    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        """Called last in every step, with the Gaussians that the next one starts from."""

    def rows_changed(self) -> None:
        """Called after density control made, split, merged or dropped Gaussians."""

    def begin_fit(self) -> None:
        """Called before a test photo is fitted: set its row to neutral."""

    def fit(self, effect_grads: Mapping[str, Tensor]) -> None:
        """Take one step of the test photo's row; nothing shared changes."""

    def facts(self) -> Facts:
        """Return plain values for the run's metrics."""
        return {}

    def state_dict(self) -> State:
        return {}

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; exact, so that a resumed run gives the same bits."""


def identity_vjp(gradients: Gradients) -> Gradients:
    """Return the gradients: vjp of a hook that changes no Gaussians."""
    return gradients


def identity_frame_vjp(cotangents: Cotangents) -> Cotangents:
    """Return the cotangents: vjp of a hook that changes no picture."""
    return cotangents


class RowAdam:
    """Adam over the rows of a table [V, ...], each with its own moments and step count.

    A row moves only in steps with its photo, so that momentum does not move it in the others.
    """

    betas, eps = (0.9, 0.999), 1e-15

    def __init__(self, values: Tensor) -> None:
        self.values = values
        self.first, self.second = torch.zeros_like(values), torch.zeros_like(values)
        self.steps = [0] * len(values)

    def step(self, row: int, gradient: Tensor, rate: float | Tensor, skip_step: Tensor | None = None) -> None:
        """Step one row; `rate` broadcasts over it, `skip_step` is that of `Effect.step`.

        A step that was skipped is counted, because the host does not know of it; this changes only the
        bias correction of the moments.
        """
        self.steps[row] += 1
        first, second = self.first[row], self.second[row]
        weights: tuple[Any, Any] = (1 - self.betas[0], 1 - self.betas[1])
        if skip_step is not None:
            go = step_factor(skip_step, gradient)
            gradient = gradient.masked_fill(go <= 0, 0.0)  # it may not be finite
            weights, rate = (weights[0] * go, weights[1] * go), rate * go
        first.lerp_(gradient, weights[0])
        second.lerp_(gradient * gradient, weights[1])
        bias1, bias2 = (1 - beta ** self.steps[row] for beta in self.betas)
        self.values[row] -= rate / bias1 * first / ((second / bias2).sqrt() + self.eps)

    def reset(self, row: int) -> None:
        """Set a row to zero, as if it had never been seen."""
        for tensor in (self.values, self.first, self.second):
            tensor[row] = 0.0
        self.steps[row] = 0

    def state_dict(self) -> State:
        return {"values": self.values, "first": self.first, "second": self.second, "steps": self.steps}

    def load_state_dict(self, state: State) -> None:
        for name in ("values", "first", "second"):
            getattr(self, name).copy_(state[name])
        self.steps = [int(n) for n in state["steps"]]


def step_factor(skip_step: Tensor, like: Tensor) -> Tensor:
    """Return 0 if the step was skipped, else 1, as a 0-d tensor in the type of `like`."""
    return 1.0 - skip_step.reshape(()).to(like)


def exponential_decay(first: float, last: float, progress: float) -> float:
    """Decay exponentially from `first` to `last` over the run."""
    return float(first * (last / first) ** progress)


def rate_for_run_length(rate: float, made_for: int, context: ViewContext) -> float:
    """Return Adam's learning rate for a run of another length than the rate was published for.

    It grows with the square root of the ratio of the lengths, at most tenfold; longer runs get the rate
    itself. Adam's steps have the size of the rate, and a random walk goes as far as the root of its number of
    steps.
    """
    length = (
        context.iteration * NOMINAL_ITERATIONS / max(context.nominal, 1e-9)
    )  # iterations of the whole run
    return rate * min(max(made_for / length, 1.0), 100.0) ** 0.5
