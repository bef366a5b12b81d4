"""Fields beside the static one, and how the pictures of several fields become one.

Test views show the static field alone. DeSplat's distractors of a view, HybridGS's 2D Gaussians of a photo,
a deformed transient field or the twin of AsymGS are fields of their own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.field import Rates
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import (
    NOTHING,
    Cotangents,
    Frame,
    Gradients,
    Pull,
    Rendered,
    as_cotangents,
    frame_of,
    sum_own,
)
from ambiguous_wild.splat.step import Shot, Step, TrainData

STATIC = "static"  # name of the first field, the one that is the result
# dL/d(composed pictures) to those of every field's own pictures
ComposePull = Callable[[Cotangents], Mapping[str, Cotangents]]


@dataclass(frozen=True)
class FieldStart:
    """What a field starts from."""

    gaussians: Gaussians
    rates: Rates
    density: DensityControl | None = None
    most: int | None = 1_000_000  # its growth stops there; None = where the static field's does


class Fields(ABC):
    """A method whose pictures are made of several fields."""

    @abstractmethod
    def setup(self, data: TrainData, static: Gaussians, rates: Rates) -> Mapping[str, FieldStart]:
        """The other fields by name, once before the first step (and when a run resumes).

        Args:
            data: the training side.
            static: the first field's Gaussians.
            rates: the first field's learning rates.
        """

    def required_effect(self) -> Effect | None:
        """The effect of their method that they cannot work without; a graft that lacks it is refused."""
        return None

    def drawn(self, shot: Shot) -> Sequence[str]:
        """Fields that take part in this picture beside the static one; only asked for train photos."""
        return ()

    def deform(self, name: str, gaussians: Gaussians, shot: Shot) -> tuple[Gaussians, Pull]:
        """A field's Gaussians as they are drawn for this picture, and the pull to those that learn."""
        return gaussians, lambda gradients: gradients

    def compose(self, frames: Mapping[str, Frame], shot: Shot) -> tuple[Frame, ComposePull]:
        """One picture of the frames of `STATIC` and of those that `drawn` names, and the pull."""
        return frames[STATIC], lambda cotangents: {STATIC: cotangents}

    def regularise(self, frames: Mapping[str, Frame], shot: Shot) -> Mapping[str, Cotangents]:
        """Gradients of losses on the fields' own pictures (coverage, for one), by field."""
        return {}

    def gradients(self, step: Step, keep: Tensor | None) -> Mapping[str, Gradients]:
        """Gradients of pictures of one's own (`Step.draw`), added to the step's; by field."""
        return {}

    def facts(self) -> dict[str, Any]:
        """Plain values for the run's metrics."""
        return {}


class Composite:
    """A `Rendered` made of the pictures of several fields; gradients of the others lie in `fields`."""

    def __init__(
        self,
        fields: Fields,
        drawn: Mapping[str, Rendered],
        needs: Mapping[str, frozenset[str]],
        shot: Shot,
        bent: Mapping[str, Pull],
    ) -> None:
        """
        Args:
            fields: what composes.
            drawn: renders of `STATIC` and of the others.
            needs: statistics of the backward pass that each other field asks for.
            shot: of the picture.
            bent: pulls of `Fields.bend`, by field.
        """
        self._bent = bent
        frames = {name: frame_of(rendered) for name, rendered in drawn.items()}
        frame, self._pull = fields.compose(frames, shot)
        self._own = fields.regularise(frames, shot)
        self.renders, self._needs, self._frame, self.frames = drawn, needs, frame, frames
        self.image, self.alpha = frame.image, frame.alpha
        self.visible = drawn[STATIC].visible

    @property
    def depth(self) -> Tensor:
        return self._frame.depth

    @property
    def radii(self) -> Tensor:
        return self.renders[STATIC].radii

    @torch.no_grad()
    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NOTHING) -> Gradients:
        """As `Rendered.backward`, of the static field; see `Gradients.fields` for the others."""
        given = dict(self._pull(as_cotangents(cotangents)))
        for name, more in self._own.items():
            given[name] = given[name] + more if name in given else more
        found = {
            name: rendered.backward(given[name], needs if name == STATIC else self._needs.get(name, NOTHING))
            for name, rendered in self.renders.items()
            if name in given or name == STATIC
        }
        static = found.pop(STATIC)
        found = {name: self._bent[name](gradients) if name in self._bent else gradients
                 for name, gradients in found.items()}  # fmt: skip
        own = static.own
        for gradients in found.values():
            own = sum_own(own, gradients.own)
        return replace(static, fields=found, own=own)


def frames_of(rendered: Rendered) -> Mapping[str, Frame]:
    """The fields' own pictures that a picture is made of, by field; empty where there is one field."""
    found: Mapping[str, Frame] = getattr(rendered, "frames", {})
    return found


def renders_of(rendered: Rendered) -> Mapping[str, Rendered]:
    """The fields' own renders that a picture is made of, by field; empty where there is one field."""
    found: Mapping[str, Rendered] = getattr(rendered, "renders", {})
    return found


def over(front: Frame, back: Frame) -> tuple[Frame, Callable[[Cotangents], tuple[Cotangents, Cotangents]]]:
    """`front` over `back`, both premultiplied by their alpha: C = C_f + (1 - A_f) C_b, A likewise.

    Returns:
        The frame, with the depth of `back`, and the pull to the cotangents of front and back.
    """
    through = 1.0 - front.alpha
    image = front.image + through[..., None] * back.image
    frame = Frame(image, front.alpha + through * back.alpha, lambda: back.depth)

    def pull(c: Cotangents) -> tuple[Cotangents, Cotangents]:
        hidden = torch.zeros_like(front.alpha)
        below: dict[str, Tensor | None] = {"depth": c.depth}
        for name in ("image", "extra"):
            d = getattr(c, name)
            below[name] = None if d is None else (through[..., None] * d).contiguous()
            if d is not None:
                hidden = hidden - (d * back.image).sum(dim=2)
        if c.alpha is not None:
            below["alpha"] = through * c.alpha
            hidden = hidden + c.alpha * (1.0 - back.alpha)
        return Cotangents(c.image, c.extra, hidden), Cotangents(**below, own=c.own)

    return frame, pull
