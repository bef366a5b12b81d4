"""What gsplat does not say of a splat as the CPU's kernels do: whether it covers a pixel, and needles' alpha.

Both are plain torch, one compiled kernel each on a GPU.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.gpu.compiled import compiled

_SMALLEST = 1e-30  # keeps the square root differentiable


def _covers(radii: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, size: Tensor) -> Tensor:
    a, b, c = conics.unbind(1)
    # variances along x and y of the inverse of the conic, times the squared reach of the 1/255 contour
    reach = 2.0 * (255.0 * opacities).clamp(min=1.0).log() / (a * c - b * b)
    extent = (reach[:, None] * torch.stack([c, a], 1)).sqrt()
    first = torch.ceil((means2d - extent - 0.5).clamp(min=0.0))
    last = torch.floor(torch.minimum(means2d + extent, size) - 0.5)
    # written so that NaN passes: a needle whose conic has lost its determinant is large
    return (radii > 0).all(1) & ~(first > last).any(1)


_compiled_covers = compiled(_covers, "the test of visibility")


@torch.no_grad()
def visible(
    radii: Tensor,  # [N, 2] int32 px, 0 where culled
    means2d: Tensor,  # [N, 2] px
    conics: Tensor,  # [N, 3]
    opacities: Tensor,  # [N], antialiasing included
    size: Tensor,  # [2] width and height in px
) -> Tensor:
    """[N] bool, drawn and with a pixel centre in the box of the 1/255 contour.

    gsplat's box is rounded up to whole pixels. Splats between pixel centres, or beyond the last ones, have
    no gradient; the mean statistic of growth must not count them.
    """
    found: Tensor = _compiled_covers(radii, means2d.detach(), conics.detach(), opacities.detach(), size)
    return found


def _ratio(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    intrinsics: Tensor,
    size: Tensor,
    blur: float,
) -> Tensor:
    pose, k = viewmat[0], intrinsics[0]
    x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
    z = torch.where(z > 0.01, z, 1.0)
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    # EWA: the Jacobian at the centre clamped to the frustum widened by 0.3 of half its size
    margin_x, margin_y = 0.15 * size[0] / fx, 0.15 * size[1] / fy
    u = torch.minimum(torch.maximum(x / z, -cx / fx - margin_x), (size[0] - cx) / fx + margin_x)
    v = torch.minimum(torch.maximum(y / z, -cy / fy - margin_y), (size[1] - cy) / fy + margin_y)
    right = (fx / z)[:, None] * (pose[0, :3] - u[:, None] * pose[2, :3])
    down = (fy / z)[:, None] * (pose[1, :3] - v[:, None] * pose[2, :3])
    axes = _rotations(quats) * scales[:, None, :]
    p = (right[:, :, None] * axes).sum(1)
    q = (down[:, :, None] * axes).sum(1)
    # the determinant as the square of a cross product: the difference of products cancels for needles
    sharp = torch.linalg.cross(p, q).square().sum(1)
    blurred = sharp + blur * (p.square().sum(1) + q.square().sum(1)) + blur * blur
    return (sharp / blurred).clamp(min=_SMALLEST).sqrt()


def _rotations(quats: Tensor) -> Tensor:
    """[N, 3, 3] of (w, x, y, z), any length."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)


def _pull(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, intrinsics: Tensor, size: Tensor,
    cotangent: Tensor, blur: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    def ratio(m: Tensor, q: Tensor, s: Tensor) -> Tensor:
        return _ratio(m, q, s, viewmat, intrinsics, size, blur)

    pull = torch.func.vjp(ratio, means, quats, scales)[1]
    found: tuple[Tensor, Tensor, Tensor] = pull(cotangent)
    return found


_compiled_ratio = compiled(_ratio, "antialiasing")
_compiled_pull = compiled(_pull, "antialiasing's backward pass")


class _Compensation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, blur: float, *tensors: Tensor) -> Tensor:
        ctx.save_for_backward(*tensors)
        ctx.blur = blur
        found: Tensor = _compiled_ratio(*tensors, blur)
        return found

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return None, *_compiled_pull(*ctx.saved_tensors, cotangent, ctx.blur), None, None, None


def compensation(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    viewmat: Tensor,  # [1, 4, 4]
    intrinsics: Tensor,  # [1, 3, 3]
    size: Tensor,  # [2]
    blur: float,  # px^2
) -> Tensor:
    """sqrt(|Sigma2| / |Sigma2 + blur I|), [N]: what antialiasing multiplies opacities by; differentiable.

    gsplat's own subtracts products in float32: 0 for needles, and for them its gradient is 0 as well.
    """
    found: Tensor = _Compensation.apply(blur, means, quats, scales, viewmat, intrinsics, size)
    return found
