"""What a GPU computes outside of gsplat: functions that torch compiles, and exact nearest neighbours.

Value and gradient of the photometric loss are one function. The gradient is written out, so that no graph is
kept and every step runs the same few kernels: SSIM's window is symmetric and padded with zeros, hence its own
adjoint, and gradients of the three blurred pictures that depend on the render are blurred once more.

gsplat does not tell whether a splat covers a pixel centre, and it loses the opacity of needles; the CPU's
kernels do neither, so both are computed here. Neighbours need no tree on the host. Nothing here reads a
tensor's values.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.gaussians import rotation_matrices

BOX = 128  # points in a box
FIRST = 8  # nearest boxes that are searched first
_AT_A_TIME = 2**25  # distances in memory at a time
_REACH = 5  # px to either side of a window of 11 taps
_C1, _C2 = 0.01**2, 0.03**2
_SMALLEST = 1e-30  # keeps the square root differentiable


def _window() -> tuple[float, ...]:
    taps = [math.exp(-((i - _REACH) ** 2) / (2 * 1.5**2)) for i in range(2 * _REACH + 1)]
    return tuple(tap / sum(taps) for tap in taps)


_TAPS = _window()


@torch.no_grad()
def nearest(points: Tensor, count: int) -> Tensor:
    """Return the rows of the points nearest to every point, the nearest first, itself among them.

    Points are halved along their longest side into boxes of `BOX`. Each box is compared with the boxes
    nearest to it, and with more boxes while another could hold a nearer point. Ties have no fixed order.

    Args:
        points: [M, 3] float, finite.
        count: neighbours, at most M.

    Returns:
        [M, count] int64.
    """
    rows = _boxes(points)  # [S, L], M = none
    ends = torch.cat([points, points.new_full((1, 3), torch.inf)])
    inside = ends[rows]
    filled = rows < len(points)
    low = inside.amin(1)
    high = torch.where(filled[..., None], inside, -torch.inf).amax(1)
    neighbours = rows.new_empty((len(points) + 1, count))
    open_boxes, searched = torch.arange(len(rows), device=points.device), min(FIRST, len(rows))
    while len(open_boxes):
        again = []
        for part in open_boxes.split(max(_AT_A_TIME // (searched * rows.shape[1] ** 2), 1)):
            gaps = torch.maximum(low[None] - high[part, None], low[part, None] - high[None])
            gaps = gaps.clamp(min=0).square().sum(2)
            gaps[torch.arange(len(part), device=part.device), part] = -1.0  # itself is first
            more = min(searched + 1, len(rows))
            distance, order = gaps.topk(more, dim=1, largest=False)
            others = rows[order[:, :searched]].flatten(1)  # [P, looked * L]
            squares = _squares(inside[part], ends[others])
            near = squares.topk(min(count, squares.shape[2]), dim=2, largest=False)
            chosen = others[:, None].expand(-1, rows.shape[1], -1).gather(2, near.indices)
            farthest = near.values[..., -1]
            enough = chosen.shape[2] == count
            if more == searched:
                unfinished = torch.zeros(len(part), dtype=torch.bool, device=part.device)
            elif not enough:
                unfinished = torch.ones(len(part), dtype=torch.bool, device=part.device)
            else:
                unfinished = (filled[part] & ~(farthest <= distance[:, searched, None])).any(1)
            if enough:
                neighbours[rows[part].flatten()] = chosen.flatten(0, 1)
            again.append(part[unfinished])
        open_boxes, searched = torch.cat(again), min(2 * searched, len(rows))
    return neighbours[: len(points)]


def _squares(points: Tensor, others: Tensor) -> Tensor:
    """Squared distances [P, L, K] by differences: a product of matrices cancels where points are close."""
    squares = points.new_zeros(*points.shape[:2], others.shape[1])
    for axis in range(3):
        squares += (points[:, :, None, axis] - others[:, None, :, axis]).square_()
    return squares


def _boxes(points: Tensor) -> Tensor:
    """Return the rows of the points in S boxes, [S, L], S a power of 2; M marks an empty place."""
    boxes = 1
    while boxes * BOX < len(points):
        boxes *= 2
    size = -(-len(points) // boxes)
    rows = torch.arange(boxes * size, device=points.device).clamp_(max=len(points))[None]
    ends = torch.cat([points, points.new_full((1, 3), torch.inf)])
    while len(rows) < boxes:
        inside = ends[rows]  # [s, l, 3]
        extent = torch.where(inside.isinf(), -torch.inf, inside).amax(1) - inside.amin(1)
        axis = extent.nan_to_num(nan=-torch.inf).argmax(1)
        along = inside.gather(2, axis[:, None, None].expand(-1, rows.shape[1], 1))[..., 0]
        rows = rows.gather(1, along.argsort(1)).view(2 * len(rows), -1)
    return rows


def compiled(function: Callable[..., Any], what: str) -> Callable[..., Any]:
    """Return a function that is compiled at its first call on a GPU, for tensors of any size.

    torch's compiler needs Triton, which comes with its CUDA builds on Linux. Where it fails, the function
    runs without it and a warning says why.
    """
    versions: list[Callable[..., Any]] = []

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        if not compiles(arguments[0].device):
            return function(*arguments)
        if not versions:
            versions.append(torch.compile(function, fullgraph=True, dynamic=True))
        try:
            return versions[0](*arguments)
        except torch.cuda.OutOfMemoryError:
            raise
        except Exception as error:  # the compiler raises many kinds, none of them caused by the user
            if versions[0] is function:
                raise
            versions[0] = function
            reason = str(error).strip().split("\n")[0][:200]
            warnings.warn(f"{what} is not compiled and slower for it: {reason}", stacklevel=2)
            return function(*arguments)

    return call


def compiles(device: torch.device) -> bool:
    """Whether functions are compiled for tensors on this device."""
    return device.type == "cuda"


def _blurred(maps: Tensor) -> Tensor:
    """Blur maps [C, H, W], with zeros beyond the border; a compiler fuses the shifted sums to one pass."""
    for axis in (1, 2):
        size = maps.shape[axis]
        pad = (0, 0, _REACH, _REACH) if axis == 1 else (_REACH, _REACH, 0, 0)
        padded = torch.nn.functional.pad(maps, pad)
        maps = sum(
            (tap * padded.narrow(axis, i, size) for i, tap in enumerate(_TAPS)), start=torch.zeros_like(maps)
        )
    return maps


def _ssim(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return SSIM of pictures [3, H, W], and its derivatives by blur(x), blur(x x) and blur(x y)."""
    mean_x, mean_y, xx, yy, xy = _blurred(torch.cat([x, y, x * x, y * y, x * y])).split(3)
    a1, a2 = 2 * mean_x * mean_y + _C1, 2 * (xy - mean_x * mean_y) + _C2
    b1 = mean_x**2 + mean_y**2 + _C1
    b2 = (xx - mean_x**2) + (yy - mean_y**2) + _C2
    ssim = a1 * a2 / (b1 * b2)
    by_xx = -ssim / b2
    by_xy = 2 * a1 / (b1 * b2)
    by_mean = 2 * mean_y * (a2 - a1) / (b1 * b2) - 2 * mean_x * ssim * (1 / b1 - 1 / b2)
    return ssim, by_mean, by_xx, by_xy


def _loss(
    render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, inside: bool
) -> tuple[Tensor, Tensor, Tensor]:
    x, y = render.permute(2, 0, 1), photo.permute(2, 0, 1)
    difference = x - y
    apart, sign = difference.abs(), torch.sign(difference)
    if keep is not None:
        apart, sign = keep * apart, keep * sign
    l1 = apart.mean()
    if keep is not None and inside:
        x, y = keep * x, keep * y
    ssim, by_mean, by_xx, by_xy = _ssim(x, y)
    lost = 1 - ssim
    if keep is not None and not inside:
        lost = keep * lost
        by_mean, by_xx, by_xy = keep * by_mean, keep * by_xx, keep * by_xy
    from_mean, from_xx, from_xy = _blurred(torch.cat([by_mean, by_xx, by_xy])).split(3)
    d_ssim = from_mean + 2 * x * from_xx + y * from_xy
    if keep is not None and inside:
        d_ssim = keep * d_ssim
    scale = 1 / render.numel()
    d_image = ((1 - lambda_dssim) * scale * sign - lambda_dssim * scale * d_ssim).permute(1, 2, 0)
    return l1, lost.mean(), d_image.contiguous()


def _map(a: Tensor, b: Tensor) -> Tensor:
    return _ssim(a.permute(2, 0, 1), b.permute(2, 0, 1))[0].permute(1, 2, 0).contiguous()


_compiled_loss, _compiled_map = compiled(_loss, "the loss"), compiled(_map, "SSIM")


@torch.no_grad()
def photometric_fused(
    render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, weighting: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return L1, 1 - SSIM (0-d) and the gradient of their mix [H, W, 3]; see `losses.photometric`."""
    keep = None if keep is None else keep.to(render.dtype)
    parts: tuple[Tensor, Tensor, Tensor] = _compiled_loss(
        render.detach(), photo, keep, lambda_dssim, weighting == "images"
    )
    return parts


@torch.no_grad()
def ssim_map_fused(a: Tensor, b: Tensor) -> Tensor:
    """Return SSIM of every pixel and channel, [H, W, 3]."""
    ssim: Tensor = _compiled_map(a, b)
    return ssim


@functools.cache
def prepare(
    device: torch.device, sizes: frozenset[tuple[int, int]], lambda_dssim: float, weighting: str
) -> None:
    """Compile the loss before the clock starts, once a process.

    Args:
        device: nothing is done unless it is a GPU.
        sizes: heights and widths of the run's photos. Where the compiler keeps them as symbols, one version
            serves all sizes; where it does not, every size is compiled here.
        lambda_dssim, weighting: as for `losses.photometric`.
    """
    if not compiles(device):
        return
    for height, width in sorted(sizes, reverse=True):
        render, photo = (torch.zeros(height, width, 3, device=device) for _ in range(2))
        for keep in (None, torch.ones(height, width, device=device)):
            photometric_fused(render, photo, keep, lambda_dssim, weighting)


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
    """Return which splats are drawn and have a pixel centre in the box of the 1/255 contour, [N] bool.

    gsplat rounds this box up to whole pixels. Splats between pixel centres, or beyond the last ones, have
    no gradient, and the mean statistic of growth must not count them.
    """
    covered: Tensor = _compiled_covers(radii, means2d.detach(), conics.detach(), opacities.detach(), size)
    return covered


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
    axes = rotation_matrices(quats) * scales[:, None, :]
    p = (right[:, :, None] * axes).sum(1)
    q = (down[:, :, None] * axes).sum(1)
    # the determinant as the square of a cross product: the difference of products cancels for needles
    sharp = torch.linalg.cross(p, q).square().sum(1)
    blurred = sharp + blur * (p.square().sum(1) + q.square().sum(1)) + blur * blur
    return (sharp / blurred).clamp(min=_SMALLEST).sqrt()


def _vjp(
    means: Tensor, quats: Tensor, scales: Tensor, viewmat: Tensor, intrinsics: Tensor, size: Tensor,
    cotangent: Tensor, blur: float,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    def ratio(m: Tensor, q: Tensor, s: Tensor) -> Tensor:
        return _ratio(m, q, s, viewmat, intrinsics, size, blur)

    vjp = torch.func.vjp(ratio, means, quats, scales)[1]
    gradients: tuple[Tensor, Tensor, Tensor] = vjp(cotangent)
    return gradients


_compiled_ratio = compiled(_ratio, "antialiasing")
_compiled_vjp = compiled(_vjp, "antialiasing's backward pass")


class _Compensation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, blur: float, *tensors: Tensor) -> Tensor:
        ctx.save_for_backward(*tensors)
        ctx.blur = blur
        ratio: Tensor = _compiled_ratio(*tensors, blur)
        return ratio

    @staticmethod
    def backward(ctx: Any, cotangent: Tensor) -> Any:
        return None, *_compiled_vjp(*ctx.saved_tensors, cotangent, ctx.blur), None, None, None


def compensation(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    viewmat: Tensor,  # [1, 4, 4]
    intrinsics: Tensor,  # [1, 3, 3]
    size: Tensor,  # [2]
    blur: float,  # px^2
) -> Tensor:
    """Return the factor of opacities under antialiasing, sqrt(|S| / |S + blur I|), [N]; differentiable.

    S is the 2D covariance. gsplat's own factor subtracts products in float32: for needles it and its gradient
    are 0.
    """
    factor: Tensor = _Compensation.apply(blur, means, quats, scales, viewmat, intrinsics, size)
    return factor
