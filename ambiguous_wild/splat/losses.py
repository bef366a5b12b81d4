"""Photometric loss of a training step: L1 and D-SSIM under a keep map, with its gradient to the render."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.splat.backend import backend_of

Weighting = Literal["map", "images"]
_WEIGHTINGS = ("map", "images")


@dataclass(frozen=True)
class PhotometricLoss:
    """A photometric loss and its gradient."""

    # numbers; on an accelerator 0-d tensors, because reading them makes the host wait
    value: float | Tensor  # (1 - lambda) l1 + lambda dssim
    l1: float | Tensor  # mean of keep |render - photo| over all pixels and channels
    dssim: float | Tensor  # mean of keep (1 - SSIM) over all pixels and channels
    d_image: Tensor  # [H, W, 3] dvalue/drender


def photometric(
    render: Tensor,  # [H, W, 3] float32
    photo: Tensor,  # [H, W, 3] float32 in [0, 1]
    keep: Tensor | None = None,  # [H, W] in [0, 1], 1 = static
    *,
    lambda_dssim: float = 0.2,
    weighting: Weighting = "map",
) -> PhotometricLoss:
    """Return (1 - lambda) mean(keep |render - photo|) + lambda mean(keep (1 - SSIM)) and its gradient.

    Means run over all pixels and channels, masked or not, so a fully masked photo has loss 0 and gradient 0.
    SSIM: 11 x 11 Gaussian window of sigma 1.5, zero padding, per channel.

    Args:
        render: the picture that the gradient is for.
        photo: the picture that it should become.
        keep: keep map; None = 1 everywhere.
        lambda_dssim: share of 1 - SSIM in the loss.
        weighting: ``"map"`` weighs the SSIM map (RefineSplat, RobustSplat); ``"images"`` multiplies both
            pictures by keep before SSIM.

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
    backend = backend_of(render.device)
    l1, dssim, d_image = backend.photometric(render, photo, keep, lambda_dssim, weighting)
    return PhotometricLoss((1 - lambda_dssim) * l1 + lambda_dssim * dssim, l1, dssim, d_image)


def ssim_map(
    a: Tensor,  # [H, W, 3] in [0, 1]
    b: Tensor,  # [H, W, 3] in [0, 1]
) -> Tensor:
    """Return SSIM in [-1, 1] of every pixel and channel, [H, W, 3]; window as in `photometric`."""
    if a.dim() != 3 or a.shape[2] != 3 or a.shape != b.shape:
        raise AwError(f"pictures must both be [H, W, 3], got {list(a.shape)} and {list(b.shape)}")
    return backend_of(a.device).ssim_map(a, b)
