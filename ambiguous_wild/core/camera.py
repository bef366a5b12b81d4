"""A pinhole camera in OpenCV axes: x right, y down, z forward; pixel centres at +0.5. Poses and rotations."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from ambiguous_wild.core.errors import AwError


def rigid(
    rotation: np.ndarray,  # [3, 3]
    translation: np.ndarray,  # [3]
) -> np.ndarray:  # [4, 4] float64
    """Return the matrix of ``x -> rotation x + translation``."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return matrix


def pose_at(
    center: np.ndarray,  # [3], world
    rotation: np.ndarray,  # [3, 3], world to camera
) -> np.ndarray:  # [4, 4] float64
    """Return cam_from_world of a camera at `center`."""
    return rigid(rotation, -rotation @ center)


def rotation_from_quat(
    quat: np.ndarray,  # [4] w, x, y, z; of any length but 0
) -> np.ndarray:  # [3, 3] float64
    """Return the rotation of a quaternion, which is normalised first."""
    w, x, y, z = np.asarray(quat, dtype=np.float64) / float(np.linalg.norm(quat))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


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
        # not by BLAS, whose last digits depend on the processor: simulated pixels would
        return -(rotation * translation[:, None]).sum(0)

    @property
    def intrinsics(self) -> np.ndarray:
        """K, [3, 3] float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """Return points [..., 3] of the world in the camera's axes; z is the depth."""
        return points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the pixels [N, 2], NaN where z <= 0, and depths z [N] of points [N, 3] of the world."""
        local = self.to_camera(points)
        z = local[:, 2]
        front = np.where(z > 0, z, np.nan)
        return local[:, :2] / front[:, None] * [self.fx, self.fy] + [self.cx, self.cy], z

    def has(self, pixels: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return which pixels [N, 2] and depths [N] of `project` lie in the frame, [N] bool."""
        return (z > 0) & ((pixels >= 0) & (pixels < (self.width, self.height))).all(axis=1)

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """Return the points [N, 3] of the world at pixels [N, 2] and depths z [N]."""
        x, y = ((pixels - [self.cx, self.cy]) / [self.fx, self.fy] * depth[:, None]).T
        rotation, translation = self.cam_from_world[:3, :3], self.cam_from_world[:3, 3]
        return (np.stack([x, y, depth], axis=1) - translation) @ rotation

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
