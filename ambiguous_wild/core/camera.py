"""A pinhole camera in OpenCV axes: x right, y down, z forward; pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ambiguous_wild.core.errors import AwError


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics and a world-to-camera pose.

    A point is seen at ``u = fx x / z + cx``; pixel (row i, column j) has its centre at
    ``(j + 0.5, i + 0.5)``, as in COLMAP and gsplat.
    """

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    cam_from_world: np.ndarray = field(repr=False)  # [4, 4] float64, rigid

    def __post_init__(self) -> None:
        pose = np.ascontiguousarray(self.cam_from_world, dtype=np.float64)
        if pose.shape != (4, 4):
            raise AwError(f"cam_from_world must be [4, 4], got {list(pose.shape)}")
        if self.width < 1 or self.height < 1 or not (self.fx > 0 and self.fy > 0):
            raise AwError(
                f"camera needs a positive size and focal length, got {self.width}x{self.height}, "
                f"fx {self.fx}, fy {self.fy}"
            )
        pose.setflags(write=False)
        object.__setattr__(self, "cam_from_world", pose)

    @property
    def center(self) -> np.ndarray:
        """Camera centre in the world, [3] float64."""
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        return -rotation.T @ translation

    @property
    def intrinsics(self) -> np.ndarray:
        """K, [3, 3] float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for an image of another size; each axis scales by actual over model size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )
