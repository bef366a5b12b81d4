"""What every back end of `render` returns, and the values that its backward pass takes and gives.

A *cotangent* is the gradient of the loss with respect to an output of a call; a *vjp* is a function that
turns it into the gradient with respect to the inputs. Both are plain values: no object stores anything
between the forward and the backward pass, so that two pictures of one step cannot be mixed up.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, fields, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.splat.gaussians import Gaussians

# Gradients of an effect's own parameters, by the effect's name and the parameter's.
EffectGrads = Mapping[str, Mapping[str, Tensor]]
# Statistics that density control can ask for beyond the signed sums, see `Gradients`.
NEEDS = ("absolute", "squared", "count")
GSPLAT_SUMS = ("absolute",)  # those that gsplat offers
NO_STATISTICS: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Cotangents:
    """dL/d(picture) of one render; None is zero."""

    image: Tensor | None = None  # [H, W, 3]
    extra: Tensor | None = None  # [H, W, 3] second cotangent of the image, see `Gradients.screen_extra`
    alpha: Tensor | None = None  # [H, W]
    depth: Tensor | None = None  # [H, W]
    _: KW_ONLY
    effect_grads: EffectGrads = field(default_factory=dict)  # collected by effects that act on pictures

    def pictures(self) -> frozenset[str]:
        """Return the names of the pictures that have one."""
        return frozenset(name for name in _PICTURES if getattr(self, name) is not None)

    def __add__(self, other: Cotangents) -> Cotangents:
        sums = {name: sum_optional(getattr(self, name), getattr(other, name)) for name in _PICTURES}
        return Cotangents(**sums, effect_grads=sum_effect_grads(self.effect_grads, other.effect_grads))


_PICTURES = ("image", "extra", "alpha", "depth")


def as_cotangents(value: Cotangents | Tensor, extra: Cotangents | Tensor | None = None) -> Cotangents:
    """Add two cotangents. A tensor [H, W, 3] as `value` is that of the image, as `extra` the second one."""
    main = value if isinstance(value, Cotangents) else Cotangents(image=value)
    if extra is None:
        return main
    return main + (extra if isinstance(extra, Cotangents) else Cotangents(extra=extra))


@dataclass
class Gradients:
    """dL/dparameter of every Gaussian, and the screen-space statistics that density control reads.

    `screen` is dL/d(u, v) in 1/px from `Cotangents.image`, alpha and depth; `screen_extra` is that from
    `Cotangents.extra`, the second cotangent. Statistics that a method does not need are None.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    sh0: Tensor  # [N, 3]
    sh_rest: Tensor  # [N, K, 3]
    _: KW_ONLY
    screen: Tensor  # [N, 2]
    screen_extra: Tensor | None = None  # [N, 2]
    screen_abs: Tensor | None = None  # [N, 2] "absolute": |.| of every pixel before the sum (AbsGS)
    squared: Tensor | None = None  # [N] "squared": sum over pixels of |d/d(u, v)|^2, 1/px^2
    count: Tensor | None = None  # [N] "count": pixels in which the Gaussian was drawn
    visible: Tensor | None = None  # [N] bool, rows that were drawn; the others' gradients are zero
    attributes: Mapping[str, Tensor] = field(default_factory=dict)  # [N, ...] of `Gaussians.attributes`
    effect_grads: EffectGrads = field(default_factory=dict)  # gradients of the effects' own parameters
    fields: Mapping[str, Gradients] = field(default_factory=dict)  # those of other fields in the picture

    def __add__(self, other: Gradients) -> Gradients:
        """Return the gradients of the sum of two losses, for the same Gaussians and camera."""
        plain = {f.name for f in fields(self)} - {"visible", "attributes", "effect_grads", "fields"}
        sums: dict[str, Any] = {
            name: sum_optional(getattr(self, name), getattr(other, name)) for name in plain
        }
        seen = [g.visible for g in (self, other) if g.visible is not None]
        shared = self.fields.keys() & other.fields.keys()
        return Gradients(
            **sums,
            visible=torch.stack(seen).any(dim=0) if seen else None,
            attributes=sum_named(self.attributes, other.attributes),
            effect_grads=sum_effect_grads(self.effect_grads, other.effect_grads),
            fields={**self.fields, **other.fields, **{k: self.fields[k] + other.fields[k] for k in shared}},
        )

    def with_effect_grads(self, effect: str, effect_grads: Mapping[str, Tensor]) -> Gradients:
        """Return these gradients with those of an effect's own parameters added."""
        return replace(self, effect_grads=sum_effect_grads(self.effect_grads, {effect: effect_grads}))


Vjp = Callable[[Gradients], Gradients]  # through a change of Gaussians
FrameVjp = Callable[[Cotangents], Cotangents]  # through a change of pictures


@dataclass(frozen=True)
class Frame:
    """The pictures of one render."""

    image: Tensor  # [H, W, 3] float32, not clamped
    alpha: Tensor  # [H, W] float32 in [0, 1]
    depth_of: Callable[[], Tensor]  # blends the depth, on demand

    @property
    def depth(self) -> Tensor:
        """[H, W] float32, sum of weight times z; divide by alpha for the expected depth."""
        return self.depth_of()


class Rendered(Protocol):
    """What a back end returns: pictures, visible Gaussians, and the backward pass."""

    image: Tensor  # [H, W, 3] float32, background included, not clamped
    alpha: Tensor  # [H, W] float32 in [0, 1]
    visible: Tensor  # [N] bool, rows that passed every cull

    @property
    def radii(self) -> Tensor:
        """[N] float32 px, largest half extent of the 1/255 contour; 0 where not visible."""
        ...

    @property
    def depth(self) -> Tensor:
        """[H, W] float32, sum of weight times z; divide by alpha for the expected depth."""
        ...

    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NO_STATISTICS) -> Gradients:
        """Return the gradients of sum(cotangent * picture) with respect to every raw parameter.

        Args:
            cotangents: cotangents of the pictures; a tensor is that of the image.
            needs: names from `NEEDS` of statistics beyond the signed sums.
        """
        ...


def with_visible(rendered: Rendered, visible: Tensor) -> Rendered:
    """Return a copy of a render in which these rows [N] bool count as drawn."""
    changed = copy.copy(rendered)
    changed.visible = visible
    return changed


def frame_of(rendered: Rendered) -> Frame:
    """Return the pictures of a render."""
    return Frame(rendered.image, rendered.alpha, lambda: rendered.depth)


@dataclass(frozen=True)
class ShadeGradients:
    """The gradients that the vjp of shaded colours returns."""

    base: Tensor  # [M, 3] dL/d(base), which goes on to harmonics and means
    attributes: Mapping[str, Tensor] = field(default_factory=dict)  # [M, ...] of `Gaussians.attributes`
    means: Tensor | None = None  # [M, 3] dL/d(positions), if the function read them
    effect_grads: EffectGrads = field(default_factory=dict)


ShadeVjp = Callable[[Tensor], ShadeGradients]  # from dL/dcolours [M, 3]
# Colours the visible rows instead of harmonics alone, between projection and blending. Gets SH(direction) +
# 0.5 of the rows [M, 3], not clamped, and the rows [M] int64 (on an accelerator all of them, a slice);
# returns colours [M, 3], which the renderer clamps at 0, and their vjp.
Shade = Callable[[Tensor, Tensor | slice], tuple[Tensor, ShadeVjp]]


def scatter_gradients(
    gradients: Gradients, shading: ShadeGradients, rows: Tensor | slice, g: Gaussians
) -> Gradients:
    """Add the gradients of a shading function's rows to those of all rows, in place."""
    if shading.means is not None:
        gradients.means[rows] += shading.means
    gradients.attributes = {name: torch.zeros_like(g.attributes[name]) for name in shading.attributes}
    for name, value in shading.attributes.items():
        gradients.attributes[name][rows] = value
    gradients.effect_grads = sum_effect_grads(gradients.effect_grads, shading.effect_grads)
    return gradients


def check_needs(needs: frozenset[str], offered: Sequence[str] = NEEDS) -> None:
    """Raise AwError if a statistic is unknown, or this back end does not offer it.

    Args:
        needs: names of the statistics.
        offered: `Backend.statistics`.
    """
    for name in needs:
        if name not in NEEDS:
            raise unknown("statistic", name, NEEDS)
        if name not in offered:
            raise AwError(
                f"the statistic {name!r} of the backward pass is not offered by gsplat: run with --device cpu"
            )


def sum_effect_grads(a: EffectGrads, b: EffectGrads) -> EffectGrads:
    """Merge gradients of effects' parameters; entries in both are summed."""
    if not a or not b:
        return a or b
    return {name: sum_named(a.get(name, {}), b.get(name, {})) for name in {**a, **b}}


def sum_named(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Merge tensors by name; tensors under the same name are summed."""
    if not a or not b:
        return a or b
    return {name: a[name] + b[name] if name in a and name in b else {**a, **b}[name] for name in {**a, **b}}


def sum_optional(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    """Return the sum, where None is zero."""
    if a is None or b is None:
        return a if b is None else b
    return a + b
