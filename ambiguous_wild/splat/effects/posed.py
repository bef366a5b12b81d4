"""A camera whose pose was learnt on an accelerator and stays there, and the rigid motions it is made of.

The renderer takes `pose`, `intrinsics_there` and `centre` as they lie. Whoever asks for the numpy pose of
`Camera` gets it too, and makes the host wait for it.
"""

from __future__ import annotations

import functools

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera


class PosedCamera(Camera):
    """`base` with another pose."""

    def __init__(self, base: Camera, pose: Tensor, intrinsics: Tensor) -> None:
        """
        Args:
            base: its size and focal lengths.
            pose: cam_from_world [4, 4] float64, rigid.
            intrinsics: K [3, 3] float64 of `base`, beside the pose.
        """
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, getattr(base, name))
        for name, value in (("base", base), ("pose", pose), ("intrinsics_there", intrinsics)):
            object.__setattr__(self, name, value)

    base: Camera
    pose: Tensor
    intrinsics_there: Tensor

    @functools.cached_property
    def cam_from_world(self) -> np.ndarray:
        """[4, 4] float64; read from the device when it is first asked for."""
        return self.pose.detach().cpu().numpy()

    @functools.cached_property
    def centre(self) -> Tensor:
        """Camera centre in the world, [3] float64 on the device."""
        return -self.pose[:3, 3] @ self.pose[:3, :3]

    def resized(self, width: int, height: int) -> Camera:
        """As `Camera.resized`, with the same pose."""
        return PosedCamera(
            self.base.resized(width, height),
            self.pose,
            scaled(self.intrinsics_there, width / self.width, height / self.height),
        )


def scaled(intrinsics: Tensor, x: float, y: float) -> Tensor:
    """K [3, 3] of a picture x times as wide and y times as high."""
    if x == 1.0 and y == 1.0:
        return intrinsics
    out = intrinsics.clone()
    out[0] *= x
    out[1] *= y
    return out


def hat(vector: Tensor) -> Tensor:
    """[3, 3] matrix of x -> vector x x."""
    eye = torch.eye(3, dtype=vector.dtype, device=vector.device)
    return torch.linalg.cross(vector.expand(3, 3), eye).T


def turned(rotation: Tensor) -> Tensor:
    """exp(w) [3, 3] of a rotation vector [3], rad; smooth at zero and without a look at its length."""
    a, b, _ = _coefficients(rotation)
    cross = hat(rotation)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + a * cross + b * cross @ cross


def left_jacobian(rotation: Tensor) -> Tensor:
    """J [3, 3] of exp(w + dw) = exp(J dw) exp(w)."""
    _, b, c = _coefficients(rotation)
    cross = hat(rotation)
    eye = torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    return eye + b * cross + c * cross @ cross


def _coefficients(rotation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 of the angle t, 0-d each."""
    squared = (rotation * rotation).sum()
    angle = squared.sqrt()
    a = torch.sinc(angle / torch.pi)
    b = 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2
    # below 0.01 rad the difference loses digits that two terms of the series have
    series = 1.0 / 6.0 - squared / 120.0
    c = torch.where(squared < 1e-4, series, (1.0 - a) / squared.clamp(min=1e-8))
    return a, b, c
