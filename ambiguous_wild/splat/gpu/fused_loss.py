"""The photometric loss on an accelerator: value and gradient in one function that torch can compile.

The gradient is written out, so that no graph is kept and every step runs the same few kernels: SSIM's window
is symmetric and padded with zeros, hence its own adjoint, and gradients of the three blurred pictures that
depend on the render are blurred once more.
Nothing here reads a tensor's values.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from ambiguous_wild.splat.gpu.compiled import compiled, compiles

_REACH = 5  # px, of the 11 taps to either side
_C1, _C2 = 0.01**2, 0.03**2


def _window() -> tuple[float, ...]:
    taps = [math.exp(-((i - _REACH) ** 2) / (2 * 1.5**2)) for i in range(2 * _REACH + 1)]
    return tuple(tap / sum(taps) for tap in taps)


_TAPS = _window()


def _blurred(maps: Tensor) -> Tensor:
    """[C, H, W] under the window, zeros beyond the border; shifted sums, which a compiler makes one pass."""
    for axis in (1, 2):
        size = maps.shape[axis]
        pad = (0, 0, _REACH, _REACH) if axis == 1 else (_REACH, _REACH, 0, 0)
        padded = torch.nn.functional.pad(maps, pad)
        maps = sum(
            (tap * padded.narrow(axis, i, size) for i, tap in enumerate(_TAPS)), start=torch.zeros_like(maps)
        )
    return maps


def _ssim(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """SSIM of [3, H, W] pictures, and its derivatives by blur(x), blur(x x) and blur(x y)."""
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
    """L1, 1 - SSIM (0-d) and the gradient of their mix [H, W, 3]; arguments as `losses.photometric`."""
    keep = None if keep is None else keep.to(render.dtype)
    found: tuple[Tensor, Tensor, Tensor] = _compiled_loss(
        render.detach(), photo, keep, lambda_dssim, weighting == "images"
    )
    return found


@torch.no_grad()
def ssim_map_fused(a: Tensor, b: Tensor) -> Tensor:
    """SSIM of every pixel and channel, [H, W, 3]."""
    found: Tensor = _compiled_map(a, b)
    return found


@functools.cache
def prepare(
    device: torch.device, sizes: frozenset[tuple[int, int]], lambda_dssim: float, weighting: str
) -> None:
    """Compile before the clock starts, once a process.

    Args:
        device: nothing is done unless it is a GPU.
        sizes: heights and widths that the run has. One version covers all sizes where the compiler keeps
            height and width as symbols; where it does not, every size is compiled here.
        lambda_dssim, weighting: as of `losses.photometric`.
    """
    if not compiles(device):
        return
    for height, width in sorted(sizes, reverse=True):
        render, photo = (torch.zeros(height, width, 3, device=device) for _ in range(2))
        for keep in (None, torch.ones(height, width, device=device)):
            photometric_fused(render, photo, keep, lambda_dssim, weighting)
