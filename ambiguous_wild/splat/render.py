"""One `render` call for every back end, with an explicit backward pass instead of autograd.

The loss of a training step is a sum of parts that know their own gradient with respect to the image.
They hand it over as a *cotangent* (dL/dimage), and one traversal turns cotangents into parameter
gradients. A second cotangent rides along: its gradient is added to the parameters', and its
screen-space statistic is kept apart, which is what entropy-aware density control needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.gaussians import Gaussians


@dataclass
class Gradients:
    """dL/dparameter of every Gaussian, plus the screen-space statistics density control reads.

    `screen` is dL/d(u, v) in 1/px for the cotangent `d_image` (with d_alpha and d_depth) alone;
    `screen_extra` the same for `d_image_extra` alone. `screen_abs` sums absolute values over pixels
    before the sum over pixels (AbsGS) and is filled only on request.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    sh0: Tensor  # [N, 3]
    sh_rest: Tensor  # [N, K, 3]
    screen: Tensor  # [N, 2]
    screen_extra: Tensor | None = None  # [N, 2]
    screen_abs: Tensor | None = None  # [N, 2]


class Rendered(Protocol):
    """What a back end returns: the pictures, who was seen, and the way back."""

    image: Tensor  # [H, W, 3] float32, background included, not clamped
    alpha: Tensor  # [H, W] float32 in [0, 1]
    depth: Tensor  # [H, W] float32, sum of weight times z; divide by alpha for the expected depth
    visible: Tensor  # [N] bool, passed every cull
    radii: Tensor  # [N] float32 px, largest half extent of the 1/255 contour; 0 where not visible

    def backward(
        self,
        d_image: Tensor,  # [H, W, 3] dL/dimage
        *,
        d_image_extra: Tensor | None = None,  # [H, W, 3] a second cotangent, added; statistic kept apart
        d_alpha: Tensor | None = None,  # [H, W]
        d_depth: Tensor | None = None,  # [H, W]
        absolute: bool = False,  # fill Gradients.screen_abs
    ) -> Gradients:
        """Gradients of sum(d_image * image) + ... with respect to every raw parameter."""
        ...


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int = 3,  # active degree, at most gaussians.sh_degree
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialias: bool = False,  # Mip-Splatting's 2D filter: opacity times sqrt(det ratio)
) -> Rendered:
    """Render the Gaussians for one camera on the device they live on.

    Conventions of both back ends: near plane 0.01, blur +0.3 px^2, alpha clamped at 0.99, alpha below
    1/255 skipped, a pixel stops before transmittance reaches 1e-4, colours max(SH + 0.5, 0).

    Raises:
        AwError: the Gaussians are on a GPU and gsplat is not installed.
    """
    if gaussians.device.type == "cpu":
        from ambiguous_wild.splat.cpu.render import render_cpu

        return render_cpu(gaussians, camera, sh_degree=sh_degree, background=background, antialias=antialias)
    from ambiguous_wild.splat.cuda import render_cuda

    return render_cuda(gaussians, camera, sh_degree=sh_degree, background=background, antialias=antialias)
