"""Colours of spherical harmonics in torch, of the constant and the rest apart: a variant of a step.

gsplat takes one tensor of coefficients, so every step copies 48 floats a Gaussian into it and splits their
gradient again. Here one compiled kernel reads the two tensors where they are, and one writes the gradients.
Of degrees that are not on yet nothing is read.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.effects.placing import higher_harmonics
from ambiguous_wild.splat.gaussians import SH_C0
from ambiguous_wild.splat.gpu.compiled import Compiled


def _bands(means: Tensor, centre: Tensor, degree: int) -> Tensor:
    return higher_harmonics(torch.nn.functional.normalize(means - centre, dim=1), degree)


def _colours(means: Tensor, sh0: Tensor, sh_rest: Tensor, centre: Tensor, degree: int) -> Tensor:
    bands = _bands(means, centre, degree)
    return SH_C0 * sh0 + (bands[:, :, None] * sh_rest[:, : bands.shape[1]]).sum(1)


def _pull(
    means: Tensor, sh_rest: Tensor, centre: Tensor, cotangent: Tensor, degree: int
) -> tuple[Tensor, Tensor, Tensor]:
    bands, pull = torch.func.vjp(lambda m: _bands(m, centre, degree), means)[:2]  # types: also of `has_aux`
    used = bands.shape[1]
    d_rest = bands[:, :, None] * cotangent[:, None]
    d_rest = torch.nn.functional.pad(d_rest, (0, 0, 0, sh_rest.shape[1] - used))
    (d_means,) = pull((sh_rest[:, :used] * cotangent[:, None]).sum(2))
    return d_means, SH_C0 * cotangent, d_rest


_compiled_colours = Compiled(_colours, "the harmonics")
_compiled_pull = Compiled(_pull, "the harmonics' backward pass")


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, degree: int, means: Tensor, sh0: Tensor, sh_rest: Tensor, centre: Tensor) -> Tensor:
        ctx.save_for_backward(means, sh_rest, centre)
        ctx.degree = degree
        found: Tensor = _compiled_colours(means, sh0, sh_rest, centre, degree)
        return found

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return None, *_compiled_pull(*ctx.saved_tensors, cotangent, ctx.degree), None


def shade_split(
    degree: int,  # 1 to 3
    means: Tensor,  # [N, 3]
    sh0: Tensor,  # [N, 3]
    sh_rest: Tensor,  # [N, K, 3], K at least (degree + 1)^2 - 1
    centre: Tensor,  # [3] of the camera
) -> Tensor:
    """Colours [N, 3], 0.5 not added; differentiable in all but `centre`."""
    found: Tensor = _Harmonics.apply(degree, means, sh0, sh_rest, centre)
    return found
