"""Fields beside the static one, and how the pictures of several fields become one.

Test views show the static field alone. Other fields are DeSplat's distractors of a view, HybridGS's 2D
Gaussians of a photo, a deformed transient field, and the twin of AsymGS.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.field import Rates
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import (
    NO_STATISTICS,
    Cotangents,
    Frame,
    Gradients,
    Rendered,
    Vjp,
    as_cotangents,
    frame_of,
    sum_effect_grads,
)
from ambiguous_wild.splat.step import Step, TrainData, ViewContext

STATIC = "static"  # name of the first field, the one that is the result
# from dL/d(composed pictures) to dL/d(pictures of every field), by field
ComposeVjp = Callable[[Cotangents], Mapping[str, Cotangents]]


@dataclass(frozen=True)
class FieldStart:
    """What a field starts from."""

    gaussians: Gaussians
    rates: Rates
    density: DensityControl | None = None
    most: int | None = 1_000_000  # its growth stops there; None = at the limit of the static field


class Fields(ABC):
    """A method whose pictures are made of several fields."""

    layers: ClassVar[bool] = False  # True: fields lie `over` the static one, drawn without a background

    @abstractmethod
    def setup(self, data: TrainData, static: Gaussians, rates: Rates) -> Mapping[str, FieldStart]:
        """Return the other fields by name; called before the first step, and again when a run resumes.

        Args:
            data: the training side.
            static: the first field's Gaussians.
            rates: the first field's learning rates.
        """

    def required_effect(self) -> Effect | None:
        """Return the effect that the fields need to work; a graft without it is refused."""
        return None

    def drawn(self, context: ViewContext) -> Sequence[str]:
        """Return the names of the other fields in this picture; only called for train photos."""
        return ()

    def deform(self, name: str, gaussians: Gaussians, context: ViewContext) -> tuple[Gaussians, Vjp]:
        """Return a field's Gaussians as they are drawn for this picture, and the vjp to its parameters."""
        return gaussians, lambda gradients: gradients

    def compose(self, frames: Mapping[str, Frame], context: ViewContext) -> tuple[Frame, ComposeVjp]:
        """Compose the frames of `STATIC` and of the fields in `drawn` to one; also returns the vjp."""
        return frames[STATIC], lambda cotangents: {STATIC: cotangents}

    def regularise(self, frames: Mapping[str, Frame], context: ViewContext) -> Mapping[str, Cotangents]:
        """Return gradients of losses on the fields' own pictures, for example on their coverage, by field."""
        return {}

    def gradients(self, step: Step, keep: Tensor | None) -> Mapping[str, Gradients]:
        """Return gradients of further pictures (`Step.draw`) by field; they are added to the step's."""
        return {}


class Composite:
    """A `Rendered` composed of several fields; its gradients hold those of the other fields in `fields`."""

    def __init__(
        self,
        fields: Fields,
        drawn: Mapping[str, Rendered],
        needs: Mapping[str, frozenset[str]],
        context: ViewContext,
        vjps: Mapping[str, Vjp],
    ) -> None:
        """
        Args:
            fields: the method's fields, which compose.
            drawn: renders of `STATIC` and of the other fields.
            needs: statistics of the backward pass that each other field asks for.
            context: the view context that was drawn.
            vjps: vjps of `Fields.deform`, by field.
        """
        self._deform_vjps = vjps
        frames = {name: frame_of(rendered) for name, rendered in drawn.items()}
        frame, self._vjp = fields.compose(frames, context)
        self._own = fields.regularise(frames, context)
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
    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NO_STATISTICS) -> Gradients:
        """Return the gradients of the static field; those of the others are in `Gradients.fields`."""
        given = dict(self._vjp(as_cotangents(cotangents)))
        for name, more in self._own.items():
            given[name] = given[name] + more if name in given else more
        by_field = {
            name: rendered.backward(
                given[name], needs if name == STATIC else self._needs.get(name, NO_STATISTICS)
            )
            for name, rendered in self.renders.items()
            if name in given or name == STATIC
        }
        static = by_field.pop(STATIC)
        by_field = {name: self._deform_vjps[name](gradients) if name in self._deform_vjps else gradients
                 for name, gradients in by_field.items()}  # fmt: skip
        effect_grads = static.effect_grads
        for gradients in by_field.values():
            effect_grads = sum_effect_grads(effect_grads, gradients.effect_grads)
        return replace(static, fields=by_field, effect_grads=effect_grads)


def frames_of(rendered: Rendered) -> Mapping[str, Frame]:
    """Return the fields' own pictures that a picture is composed of; empty if there is one field."""
    frames: Mapping[str, Frame] = getattr(rendered, "frames", {})
    return frames


def renders_of(rendered: Rendered) -> Mapping[str, Rendered]:
    """Return the fields' own renders that a picture is composed of; empty if there is one field."""
    renders: Mapping[str, Rendered] = getattr(rendered, "renders", {})
    return renders


def over(front: Frame, back: Frame) -> tuple[Frame, Callable[[Cotangents], tuple[Cotangents, Cotangents]]]:
    """Blend `front` over `back`, both premultiplied by alpha: C = C_f + (1 - A_f) C_b, A likewise.

    Returns:
        The frame, with the depth of `back`, and the vjp to the cotangents of front and back.
    """
    through = 1.0 - front.alpha
    image = front.image + through[..., None] * back.image
    frame = Frame(image, front.alpha + through * back.alpha, lambda: back.depth)

    def vjp(c: Cotangents) -> tuple[Cotangents, Cotangents]:
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
        return Cotangents(c.image, c.extra, hidden), Cotangents(**below, effect_grads=c.effect_grads)

    return frame, vjp
