"""Photometric loss of a training step: L1 and D-SSIM under a keep map, with its gradient to the render."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown

Weighting = Literal["map", "images", "none"]
_WEIGHTINGS = ("map", "images", "none")


@dataclass(frozen=True)
class PhotometricLoss:
    """A loss and its gradient."""

    value: float  # (1 - lambda) l1 + lambda dssim
    l1: float  # mean of keep |render - photo| over all pixels and channels
    dssim: float  # mean of keep (1 - SSIM) over all pixels and channels
    d_image: Tensor  # [H, W, 3] dvalue/drender


def photometric(
    render: Tensor,  # [H, W, 3] float32
    photo: Tensor,  # [H, W, 3] float32 in [0, 1]
    keep: Tensor | None = None,  # [H, W] in [0, 1], 1 = static
    *,
    lambda_dssim: float = 0.2,
    weighting: Weighting = "map",
) -> PhotometricLoss:
    """(1 - lambda) mean(keep |render - photo|) + lambda mean(keep (1 - SSIM)).

    Means run over all pixels and channels, masked or not, so a photo that is all masked has loss 0 and
    gradient 0. SSIM: 11 x 11 Gaussian window of sigma 1.5, zero padding, per channel.

    Args:
        render: the picture the gradient is for.
        photo: what it should be.
        keep: keep map; None for none.
        lambda_dssim: share of 1 - SSIM.
        weighting: ``"map"`` weighs the SSIM map (RefineSplat, RobustSplat); ``"images"`` multiplies both
            pictures by keep before SSIM; ``"none"`` ignores keep.

    Raises:
        AwError: shapes differ, or the weighting is unknown.
    """
    if weighting not in _WEIGHTINGS:
        raise unknown("loss weighting", weighting, _WEIGHTINGS)
    if render.dim() != 3 or render.shape[2] != 3 or render.shape != photo.shape:
        raise AwError(
            f"render and photo must both be [H, W, 3], got {list(render.shape)} and {list(photo.shape)}"
        )
    if keep is not None and keep.shape != render.shape[:2]:
        raise AwError(f"keep must be {list(render.shape[:2])} as the photo, got {list(keep.shape)}")
    if weighting == "none":
        keep = None
    if render.device.type == "cpu":
        from ambiguous_wild.splat.cpu.photometric import photometric_cpu

        l1, dssim, d_image = photometric_cpu(render, photo, keep, lambda_dssim, weighting)
    else:
        l1, dssim, d_image = _photometric_torch(render, photo, keep, lambda_dssim, weighting)
    return PhotometricLoss((1 - lambda_dssim) * l1 + lambda_dssim * dssim, l1, dssim, d_image)


def ssim_map(
    a: Tensor,  # [H, W, 3] in [0, 1]
    b: Tensor,  # [H, W, 3] in [0, 1]
) -> Tensor:
    """SSIM of every pixel and channel, [H, W, 3]; window as in `photometric`. Values in [-1, 1]."""
    if a.dim() != 3 or a.shape[2] != 3 or a.shape != b.shape:
        raise AwError(f"pictures must both be [H, W, 3], got {list(a.shape)} and {list(b.shape)}")
    if a.device.type == "cpu":
        from ambiguous_wild.splat.cpu.photometric import ssim_map_cpu

        return ssim_map_cpu(a, b)
    return _ssim_torch(a, b)


def _ssim_torch(a: Tensor, b: Tensor) -> Tensor:
    """The same map in torch, differentiable, any device and float type."""
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5.0) ** 2) / (2 * 1.5**2))
    taps = (taps / taps.sum()).to(a)

    def blur(x: Tensor) -> Tensor:
        x = torch.nn.functional.conv2d(
            x, taps.view(1, 1, 11, 1).expand(15, 1, 11, 1), padding=(5, 0), groups=15
        )
        return torch.nn.functional.conv2d(
            x, taps.view(1, 1, 1, 11).expand(15, 1, 1, 11), padding=(0, 5), groups=15
        )

    stack = torch.cat([a, b, a * a, b * b, a * b], 2).permute(2, 0, 1)[None]
    mean_a, mean_b, aa, bb, ab = blur(stack)[0].permute(1, 2, 0).split(3, 2)
    numerator = (2 * mean_a * mean_b + 0.01**2) * (2 * (ab - mean_a * mean_b) + 0.03**2)
    spread = (aa - mean_a**2) + (bb - mean_b**2) + 0.03**2
    return numerator / ((mean_a**2 + mean_b**2 + 0.01**2) * spread)


def _photometric_torch(
    render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, weighting: str
) -> tuple[float, float, Tensor]:
    """The same loss by autograd, for tensors on a GPU; also the oracle of the kernels in tests."""
    with torch.enable_grad():
        x = render.detach().requires_grad_(True)
        y = photo
        weight = torch.ones_like(x[..., :1]) if keep is None else keep.to(x)[..., None]
        l1 = (weight * (x - y).abs()).mean()
        if weighting == "images":
            dssim = (1 - _ssim_torch(weight * x, weight * y)).mean()
        else:
            dssim = (weight * (1 - _ssim_torch(x, y))).mean()
        (gradient,) = torch.autograd.grad((1 - lambda_dssim) * l1 + lambda_dssim * dssim, x)
    return float(l1.detach()), float(dssim.detach()), gradient
