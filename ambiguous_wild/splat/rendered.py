"""What every back end of `render` returns, and the values that travel back through it.

A *cotangent* is the gradient of the loss with respect to something that came out of a call; a *pull* is a
function that turns it into the gradient with respect to what went in. Both are plain values: nothing is kept
in an object between the forward and the backward pass, so that two pictures of one step cannot mix.
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
Own = Mapping[str, Mapping[str, Tensor]]
# What density control can ask of the backward pass beyond the signed sums, see `Gradients`.
NEEDS = ("absolute", "squared", "count")
GSPLAT_SUMS = ("absolute",)  # of these, what gsplat can sum
NOTHING: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Cotangents:
    """dL/d(picture) of one render; None is zero."""

    image: Tensor | None = None  # [H, W, 3]
    extra: Tensor | None = None  # [H, W, 3] a second one of the image, added; its statistic is kept apart
    alpha: Tensor | None = None  # [H, W]
    depth: Tensor | None = None  # [H, W]
    _: KW_ONLY
    own: Own = field(default_factory=dict)  # collected on the way by effects that act on pictures

    def __add__(self, other: Cotangents) -> Cotangents:
        sums = {name: sum_where(getattr(self, name), getattr(other, name)) for name in _PICTURES}
        return Cotangents(**sums, own=sum_own(self.own, other.own))


_PICTURES = ("image", "extra", "alpha", "depth")


def as_cotangents(value: Cotangents | Tensor, extra: Cotangents | Tensor | None = None) -> Cotangents:
    """A tensor [H, W, 3] alone is dL/dimage; one given as `extra` is the second cotangent."""
    main = value if isinstance(value, Cotangents) else Cotangents(image=value)
    if extra is None:
        return main
    return main + (extra if isinstance(extra, Cotangents) else Cotangents(extra=extra))


@dataclass
class Gradients:
    """dL/dparameter of every Gaussian, and the screen-space statistics that density control reads.

    `screen` is dL/d(u, v) in 1/px of `Cotangents.image` (with alpha and depth) alone; `screen_extra` that of
    `Cotangents.extra` alone. What a method does not ask for is None.
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
    extra: Mapping[str, Tensor] = field(default_factory=dict)  # [N, ...] of `Gaussians.extra`
    own: Own = field(default_factory=dict)  # of the effects' own parameters
    fields: Mapping[str, Gradients] = field(default_factory=dict)  # of other fields in the same picture

    def __add__(self, other: Gradients) -> Gradients:
        """The gradients of the sum of two losses, for the same Gaussians and camera."""
        plain = {f.name for f in fields(self)} - {"visible", "extra", "own", "fields"}
        sums: dict[str, Any] = {name: sum_where(getattr(self, name), getattr(other, name)) for name in plain}
        seen = [g.visible for g in (self, other) if g.visible is not None]
        shared = self.fields.keys() & other.fields.keys()
        return Gradients(
            **sums,
            visible=torch.stack(seen).any(dim=0) if seen else None,
            extra=sum_named(self.extra, other.extra),
            own=sum_own(self.own, other.own),
            fields={**self.fields, **other.fields, **{k: self.fields[k] + other.fields[k] for k in shared}},
        )

    def with_own(self, effect: str, own: Mapping[str, Tensor]) -> Gradients:
        """The same, with gradients of that effect's own parameters added."""
        return replace(self, own=sum_own(self.own, {effect: own}))


Pull = Callable[[Gradients], Gradients]  # of what changes Gaussians
FramePull = Callable[[Cotangents], Cotangents]  # of what changes pictures


@dataclass(frozen=True)
class Frame:
    """The pictures of one render."""

    image: Tensor  # [H, W, 3] float32, not clamped
    alpha: Tensor  # [H, W] float32 in [0, 1]
    depth_of: Callable[[], Tensor]  # blended when it is asked for

    @property
    def depth(self) -> Tensor:
        """[H, W] float32, sum of weight times z; divide by alpha for the expected depth."""
        return self.depth_of()


class Rendered(Protocol):
    """What a back end returns: pictures, visible Gaussians, and the backward pass."""

    image: Tensor  # [H, W, 3] float32, background included, not clamped
    alpha: Tensor  # [H, W] float32 in [0, 1]
    visible: Tensor  # [N] bool, passed every cull

    @property
    def radii(self) -> Tensor:
        """[N] float32 px, largest half extent of the 1/255 contour; 0 where not visible."""
        ...

    @property
    def depth(self) -> Tensor:
        """[H, W] float32, sum of weight times z; divide by alpha for the expected depth."""
        ...

    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NOTHING) -> Gradients:
        """Gradients of sum(cotangent * picture) with respect to every raw parameter.

        Args:
            cotangents: of the pictures; a tensor is that of the image.
            needs: statistics beyond the signed sums, of `NEEDS`.
        """
        ...


def with_visible(rendered: Rendered, visible: Tensor) -> Rendered:
    """The same render, but these rows [N] bool count as drawn; the one given does not change."""
    found = copy.copy(rendered)
    found.visible = visible
    return found


def frame_of(rendered: Rendered) -> Frame:
    """The pictures alone."""
    return Frame(rendered.image, rendered.alpha, lambda: rendered.depth)


class Shade(Protocol):
    """Colours by a function of the visible rows instead of harmonics alone.

    Called between projection and blending.
    """

    def __call__(
        self,
        base: Tensor,  # [M, 3] SH(direction) + 0.5 of the rows, not clamped
        rows: Tensor | slice,  # [M] int64, visible Gaussians; on an accelerator all of them, a slice
    ) -> tuple[Tensor, ShadePull]:
        """Colours [M, 3], which the renderer clamps below at 0, and the pull."""
        ...


@dataclass(frozen=True)
class ShadeGradients:
    """Where the gradient of shaded colours goes."""

    base: Tensor  # [M, 3] dL/d(base), on to harmonics and means
    extra: Mapping[str, Tensor] = field(default_factory=dict)  # [M, ...] of `Gaussians.extra`
    means: Tensor | None = None  # [M, 3] of the positions that the function read
    own: Own = field(default_factory=dict)


ShadePull = Callable[[Tensor], ShadeGradients]  # of dL/dcolours [M, 3]


def spread(gradients: Gradients, found: ShadeGradients, rows: Tensor | slice, g: Gaussians) -> Gradients:
    """Add what a shading function found for its rows to the gradients of all rows; changes them in place."""
    if found.means is not None:
        gradients.means[rows] += found.means
    gradients.extra = {name: torch.zeros_like(g.extra[name]) for name in found.extra}
    for name, value in found.extra.items():
        gradients.extra[name][rows] = value
    gradients.own = sum_own(gradients.own, found.own)
    return gradients


def check_needs(needs: frozenset[str], offered: Sequence[str] = NEEDS) -> None:
    """Raise AwError where no back end knows a statistic, or this one does not offer it.

    Args:
        needs: asked for.
        offered: `Backend.statistics`.
    """
    for name in needs:
        if name not in NEEDS:
            raise unknown("statistic", name, NEEDS)
        if name not in offered:
            raise AwError(
                f"the statistic {name!r} of the backward pass is not offered by gsplat: run with --device cpu"
            )


def sum_own(a: Own, b: Own) -> Own:
    """Both, summed where both have one."""
    if not a or not b:
        return a or b
    return {name: sum_named(a.get(name, {}), b.get(name, {})) for name in {**a, **b}}


def sum_named(a: Mapping[str, Tensor], b: Mapping[str, Tensor]) -> Mapping[str, Tensor]:
    """Both, summed under the names that both have."""
    if not a or not b:
        return a or b
    return {name: a[name] + b[name] if name in a and name in b else {**a, **b}[name] for name in {**a, **b}}


def sum_where(a: Tensor | None, b: Tensor | None) -> Tensor | None:
    """The sum; None is zero."""
    if a is None or b is None:
        return a if b is None else b
    return a + b
