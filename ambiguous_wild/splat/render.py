"""One `render` call for every back end, with an explicit backward pass instead of autograd.

The loss of a training step is a sum of parts that compute their own gradient with respect to the image. They
pass it as a *cotangent* (dL/dimage), and one backward traversal turns cotangents into gradients of the
parameters. A second cotangent may go along: its gradients of the parameters are added, and its gradients in
screen space are kept apart, for entropy-aware density control.
"""

from __future__ import annotations

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import Rendered, Shade

BLUR = 0.3  # px^2


def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int = 3,  # active degree, at most gaussians.sh_degree
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    antialias: bool = False,  # Mip-Splatting's 2D filter: opacity times sqrt(det ratio)
    blur: float = BLUR,  # px^2 added to both variances of a splat; Mip-Splatting's own code has 0.1
    shade: Shade | None = None,  # function that colours the visible rows; None = harmonics
) -> Rendered:
    """Render the Gaussians for one camera on the device they live on.

    Conventions of both back ends: near plane 0.01, alpha clamped at 0.99 (at 0.999 by gsplat
    1.5.3, see gsplat_calls.py), alpha below 1/255 skipped, a pixel stops before transmittance
    reaches 1e-4, colours max(SH + 0.5, 0).

    Raises:
        AwError: the Gaussians are on a GPU, and gsplat is not installed.
    """
    return backend_of(gaussians.device).render(
        gaussians,
        camera,
        sh_degree=sh_degree,
        background=background,
        antialias=antialias,
        blur=blur,
        shade=shade,
    )
