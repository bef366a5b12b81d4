"""Matrices of cameras on a device, copied once, and cameras whose poses are learnt on the device.

The renderer reads `pose`, `intrinsics_there` and `centre` of a learnt pose on its device. Reading the numpy
pose of `Camera` also works, but makes the host of an accelerator wait.
"""

from __future__ import annotations

import functools
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera

_REMEMBERED = 8192  # cameras: enough for a thousand photos at three sizes and for test views


@dataclass(frozen=True)
class OnDevice:
    """A camera's matrices on a device."""

    viewmat: Tensor  # [1, 4, 4] cam_from_world
    intrinsics: Tensor  # [1, 3, 3]
    centre: Tensor  # [3]


_cameras: OrderedDict[tuple[int, torch.device, torch.dtype], tuple[Camera, OnDevice]] = OrderedDict()


def on_device(camera: Camera, device: torch.device, dtype: torch.dtype = torch.float32) -> OnDevice:
    """Return the camera's matrices on the device, copied once, so that the host need not wait in a step."""
    if isinstance(camera, PosedCamera):  # made by pose refinement on the device, anew in every step
        matrices = camera.pose[None], camera.intrinsics_there[None], camera.centre
        return OnDevice(*(matrix.to(device, dtype) for matrix in matrices))
    key = (id(camera), device, dtype)
    if key not in _cameras:
        host = camera.cam_from_world[None], camera.intrinsics[None], camera.center
        there = OnDevice(*(torch.tensor(matrix).to(dtype).to(device) for matrix in host))
        _cameras[key] = (camera, there)  # holds the camera too, so that no other object gets its id
        if len(_cameras) > _REMEMBERED:
            _cameras.popitem(last=False)
    _cameras.move_to_end(key)
    return _cameras[key][1]


class PosedCamera(Camera):
    """The camera `base` with another pose, a tensor."""

    def __init__(self, base: Camera, pose: Tensor, intrinsics: Tensor) -> None:
        """
        Args:
            base: camera that gives size and focal lengths.
            pose: cam_from_world [4, 4] float64, rigid.
            intrinsics: K [3, 3] float64 of `base`, on the device of the pose.
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
        """[4, 4] float64; read from the device at the first access."""
        return self.pose.detach().cpu().numpy()

    @functools.cached_property
    def centre(self) -> Tensor:
        """Camera centre in the world, [3] float64 on the device."""
        return -self.pose[:3, 3] @ self.pose[:3, :3]

    def resized(self, width: int, height: int) -> Camera:
        """Return what `Camera.resized` does, with the same pose."""
        return PosedCamera(
            self.base.resized(width, height),
            self.pose,
            scaled(self.intrinsics_there, width / self.width, height / self.height),
        )


def scaled(intrinsics: Tensor, x: float, y: float) -> Tensor:
    """Return K [3, 3] of a picture x times as wide and y times as high."""
    if x == 1.0 and y == 1.0:
        return intrinsics
    out = intrinsics.clone()
    out[0] *= x
    out[1] *= y
    return out
