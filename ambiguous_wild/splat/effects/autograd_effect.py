"""Base of effects that a recipe writes as a forward function in torch.

A recipe declares what is learnt (`leaves`, `rows`) and how colours follow from it: `forward` over the visible
Gaussians, `change` over all of them, `tone` over the picture. Adam, the row of a test photo, checkpoints and
the vjps by autograd are here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.splat.effects.base import Effect, RowAdam, exponential_decay, rate_for_run_length
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians
from ambiguous_wild.splat.rendered import (
    Cotangents,
    Frame,
    FrameVjp,
    Gradients,
    ShadeGradients,
    ShadeVjp,
    Vjp,
    sum_effect_grads,
)
from ambiguous_wild.splat.step import TrainData, ViewContext

# which function of a recipe fills which hook
_FILLED_BY = {"model": "change", "shade": "forward", "image": "tone"}


@dataclass(frozen=True)
class Leaf:
    """A tensor that an effect learns."""

    values: Tensor  # any shape; [train photos, ...] if `per_photo`
    rate: float  # learning rate of Adam
    lr_decay: float = 1.0  # the rate decays exponentially to this share
    per_photo: bool = False  # a row for every photo, and one for a test photo
    fit_rate: float = 0.1  # learning rate while a test photo's row is fitted (WildGaussians)
    made_for: int | None = None  # run length that the rate is for, see `rate_for_run_length`


@dataclass(frozen=True)
class VisibleGaussians:
    """The visible Gaussians, argument of `AutogradEffect.forward`."""

    base: Tensor  # [M, 3] colours of the harmonics in this direction, SH + 0.5, not clamped
    means: Tensor  # [M, 3] world
    attributes: Mapping[str, Tensor] = field(default_factory=dict)  # [M, ...] rows of `Gaussians.attributes`


class AutogradEffect(Effect):
    """An effect with parameters. Override `leaves`, and one or more of `forward`, `change` and `tone`.

    Each gets `leaf`, the leaves by name; of a leaf per photo it gets the row of the view context's photo.
    """

    # row of a photo that was not trained on: the start of a fit, and the row of a picture without a photo
    unseen: ClassVar[Literal["zero", "mean"]] = "zero"

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        """Return what is learnt beside the attributes of Gaussians (`Effect.rows`)."""
        return {}

    def forward(self, visible: VisibleGaussians, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        """Return colours [M, 3] of the visible Gaussians; the renderer clamps them at 0."""
        return visible.base

    def change(
        self, gaussians: Gaussians, leaf: Mapping[str, Tensor], context: ViewContext
    ) -> Mapping[str, Tensor]:
        """Return by name those raw parameters [N, ...] that are drawn with other values."""
        return {}

    def tone(self, image: Tensor, alpha: Tensor, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        """Return the picture [H, W, 3] as it is compared with the photo."""
        return image

    # -- recipes override nothing below ------------------------------------------------------------

    def setup(self, data: TrainData) -> None:
        self.photos = len(data.photos)
        seed = [data.seed, *self.name.encode()]
        self._leaves = dict(self.leaves(data, np.random.default_rng(seed)))
        self._adam = {name: RowAdam(self._table(leaf).to(data.device)) for name, leaf in self._leaves.items()}

    def require_setup(self) -> None:
        """Raise AwError if the run lacks this effect: a mask policy that reads it was grafted alone."""
        if not hasattr(self, "_adam"):
            raise AwError(f"the masks of {self.name} need its effects: use both, or masks of another method")

    def _table(self, leaf: Leaf) -> Tensor:
        values = leaf.values.detach().to(torch.float32)
        if not leaf.per_photo:
            return values.clone()[None]
        return torch.cat([values, torch.zeros_like(values[:1])])

    def _leaf(self, context: ViewContext) -> dict[str, Tensor]:
        """Return copies of the leaves, to differentiate and to read after the optimiser's step."""
        return {name: self._row(name, context).detach().clone() for name in self._leaves}

    def _learns(self, leaf: dict[str, Tensor], context: ViewContext) -> dict[str, Tensor]:
        """Return the leaves to differentiate: of a test photo only its row."""
        if not context.fitting:
            return leaf
        return {name: tensor for name, tensor in leaf.items() if self._leaves[name].per_photo}

    def _row(self, name: str, context: ViewContext) -> Tensor:
        values = self._adam[name].values
        if not self._leaves[name].per_photo:
            return values[0]
        row = context.row(self.photos)
        return self._unseen(name) if row is None else values[row]

    def _unseen(self, name: str) -> Tensor:
        rows = self._adam[name].values[: self.photos]
        return rows.mean(dim=0) if self.unseen == "mean" else torch.zeros_like(rows[0])

    def acts(self, hook: str) -> bool:
        function = _FILLED_BY.get(hook)
        return (
            super().acts(hook)
            if function is None
            else getattr(type(self), function) is not getattr(AutogradEffect, function)
        )

    def model(self, gaussians: Gaussians, context: ViewContext) -> tuple[Gaussians, Vjp]:
        leaf = self._leaf(context)
        given = {name: tensor.detach().clone() for name, tensor in gaussians.named_tensors()}
        graph = _Graph(self._learns(leaf, context), given)
        with torch.enable_grad():
            attributes = {name: given[name] for name in gaussians.attributes}
            inputs = Gaussians(*(given[name] for name in PARAMETERS), attributes=attributes)
            changed = dict(self.change(inputs, leaf, context))

        def vjp(gradients: Gradients) -> Gradients:
            d = {name: getattr(gradients, name) for name in changed}
            gradients_of = graph.vjp([changed[name] for name in changed], [d[name] for name in changed])
            sums: dict[str, Any] = {}
            for name in PARAMETERS:
                unchanged = None if name in changed else getattr(gradients, name)
                sums[name] = _sum(unchanged, gradients_of.get(name), given[name])
            attributes = {
                name: _sum(gradients.attributes.get(name), gradients_of.get(name), given[name])
                for name in inputs.attributes
            }
            effect_grads = {name: gradients_of[name] for name in leaf if name in gradients_of}
            return replace(gradients, **sums, attributes=attributes).with_effect_grads(
                self.name, effect_grads
            )

        drawn: dict[str, Any] = {name: value.detach().contiguous() for name, value in changed.items()}
        return replace(gaussians, **drawn), vjp

    def shade(
        self, gaussians: Gaussians, rows: Tensor | slice, base: Tensor, context: ViewContext
    ) -> tuple[Tensor, ShadeVjp]:
        leaf = self._leaf(context)
        attributes = {name: values[rows].detach() for name, values in gaussians.attributes.items()}
        means, base = gaussians.means[rows].detach(), base.detach()
        geometry = () if context.fitting else ({"means": means}, attributes)
        graph = _Graph(self._learns(leaf, context), {"base": base}, *geometry)
        with torch.enable_grad():
            colours = self.forward(VisibleGaussians(base, means, attributes), leaf, context)

        def vjp(d_colours: Tensor) -> ShadeGradients:
            gradients_of = graph.vjp([colours], [d_colours])
            through = gradients_of.get("base")
            return ShadeGradients(
                torch.zeros_like(base) if through is None else through.contiguous(),
                {name: gradients_of[name] for name in attributes if name in gradients_of},
                gradients_of.get("means"),
                {self.name: {name: gradients_of[name] for name in leaf if name in gradients_of}},
            )

        return colours.detach(), vjp

    def image(self, frame: Frame, context: ViewContext) -> tuple[Frame, FrameVjp]:
        leaf, image, alpha = self._leaf(context), frame.image.detach().clone(), frame.alpha.detach().clone()
        graph = _Graph(self._learns(leaf, context), {"image": image, "alpha": alpha})
        with torch.enable_grad():
            toned = self.tone(image, alpha, leaf, context)

        def vjp(c: Cotangents) -> Cotangents:
            main = {} if c.image is None else graph.vjp([toned], [c.image])
            second = {} if c.extra is None else graph.vjp([toned], [c.extra])
            alphas = [a for a in (c.alpha, main.get("alpha"), second.get("alpha")) if a is not None]
            effect_grads = {name: main[name] for name in leaf if name in main}
            return replace(
                c,
                image=None if c.image is None else _sum(None, main.get("image"), image),
                extra=None if c.extra is None else _sum(None, second.get("image"), image),
                alpha=sum(alphas[1:], alphas[0]).contiguous() if alphas else None,
                effect_grads=sum_effect_grads(c.effect_grads, {self.name: effect_grads})
                if effect_grads
                else c.effect_grads,
            )

        return replace(frame, image=toned.detach().contiguous()), vjp

    def step(
        self, effect_grads: Mapping[str, Tensor], context: ViewContext, skip_step: Tensor | None = None
    ) -> None:
        for name, gradient in effect_grads.items():
            leaf = self._leaves[name]
            row = context.view if leaf.per_photo else 0
            assert row is not None
            rate = exponential_decay(leaf.rate, leaf.rate * leaf.lr_decay, context.progress)
            rate = rate if leaf.made_for is None else rate_for_run_length(rate, leaf.made_for, context)
            self._adam[name].step(row, gradient, rate, skip_step)

    def begin_fit(self) -> None:
        for name, leaf in self._leaves.items():
            if leaf.per_photo:
                self._adam[name].reset(self.photos)
                self._adam[name].values[self.photos] = self._unseen(name)

    def fit(self, effect_grads: Mapping[str, Tensor]) -> None:
        for name, gradient in effect_grads.items():
            if self._leaves[name].per_photo:
                self._adam[name].step(self.photos, gradient, self._leaves[name].fit_rate)

    def facts(self) -> Facts:
        tables = {
            n: self._adam[n].values[: self.photos] for n, leaf in self._leaves.items() if leaf.per_photo
        }
        return {f"{name}_std": float(rows.std(dim=0, unbiased=False).mean()) for name, rows in tables.items()}

    def state_dict(self) -> State:
        return {name: adam.state_dict() for name, adam in self._adam.items()}

    def load_state_dict(self, state: State) -> None:
        for name, adam in self._adam.items():
            adam.load_state_dict(state[name])


class _Graph:
    """The inputs of one forward pass; gradients can be taken to them more than once."""

    def __init__(self, *named: dict[str, Tensor]) -> None:
        self.inputs: dict[str, Tensor] = {}
        self.recorded = torch.is_grad_enabled()
        for group in named:
            for name, tensor in group.items():
                if name in self.inputs:
                    raise AwError(f"{name!r} names two inputs of an effect: rename its leaf or its attribute")
                group[name] = tensor.requires_grad_(self.recorded)
                self.inputs[name] = group[name]

    def vjp(self, outputs: Sequence[Tensor], cotangents: Sequence[Tensor]) -> dict[str, Tensor]:
        """Return the gradients, by name, of those inputs that the outputs depend on.

        Raises:
            RuntimeError: the forward pass ran under `torch.no_grad`.
        """
        if not self.recorded:
            raise RuntimeError("drawn under torch.no_grad: there is no backward pass")
        pairs = [(o, c.to(o)) for o, c in zip(outputs, cotangents) if o.requires_grad]
        if not pairs:
            return {}
        gradients = torch.autograd.grad(
            [o for o, _ in pairs], list(self.inputs.values()), [c for _, c in pairs], retain_graph=True,
            allow_unused=True,
        )  # fmt: skip
        return {name: gradient for name, gradient in zip(self.inputs, gradients) if gradient is not None}


def _sum(a: Tensor | None, b: Tensor | None, like: Tensor) -> Tensor:
    if a is None or b is None:
        one = b if a is None else a
        return torch.zeros_like(like) if one is None else one.contiguous()
    return (a + b).contiguous()


def mlp_leaves(name: str, widths: Sequence[int], rng: np.random.Generator, rate: float) -> dict[str, Leaf]:
    """Return weights and biases of a net with these widths, initialised as by torch.nn.Linear."""
    leaves = {}
    for i, (inputs, outputs) in enumerate(pairwise(widths)):
        for kind, shape in (("weight", (inputs, outputs)), ("bias", (outputs,))):
            values = rng.uniform(-1, 1, shape) / np.sqrt(inputs)
            leaves[f"{name}_{kind}{i}"] = Leaf(torch.tensor(values, dtype=torch.float32), rate)
    return leaves


def mlp(
    x: Tensor,  # [M, inputs]
    leaf: Mapping[str, Tensor],
    name: str,
    hidden: Callable[[Tensor], Tensor] = torch.relu,  # applied after every layer but the last
) -> Tensor:
    """Apply the net of `mlp_leaves`, [M, outputs]; the last layer has no activation."""
    layers = sum(key.startswith(f"{name}_weight") for key in leaf)
    for i in range(layers):
        x = torch.addmm(leaf[f"{name}_bias{i}"], x, leaf[f"{name}_weight{i}"])
        x = hidden(x) if i + 1 < layers else x
    return x
