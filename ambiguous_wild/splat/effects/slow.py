"""A slow average of the model, carried with every Gaussian: a teacher that density control keeps in step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.field import Row
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians
from ambiguous_wild.splat.step import Step


class SlowAverage(Effect):
    """p_slow = keep p_slow + (1 - keep) p of the raw parameters, after every step."""

    name = "slow-average"

    def __init__(self, keep: float) -> None:
        self.share = 1.0 - keep

    def rows(self, gaussians: Gaussians) -> Mapping[str, Row]:
        return {slow(name): Row(tensor.clone()) for name, tensor in gaussians.items()}

    @torch.no_grad()
    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        gaussians.settle()
        for name, tensor in gaussians.items():
            gaussians.extra[slow(name)].lerp_(tensor, self.share)


class SlowDensity(DensityControl):
    """The average of a split's child lies where the child lies and is as large; the rest is the parent's."""

    def _split_half(self, parents: Gaussians) -> Gaussians:
        child = super()._split_half(parents)
        for name in ("means", "log_scales"):
            if slow(name) in child.extra:
                child.extra[slow(name)].copy_(getattr(child, name))
        return child


def slow(name: str) -> str:
    """Under which name a parameter's average is carried."""
    return f"slow_{name}"


def slow_gaussians(gaussians: Gaussians) -> Gaussians | None:
    """The average as a model of its own; None where it is not carried. Its tensors are those of `extra`."""
    if slow("means") not in gaussians.extra:
        return None
    found: dict[str, Any] = {name: gaussians.extra[slow(name)] for name in PARAMETERS}
    return Gaussians(**found)
