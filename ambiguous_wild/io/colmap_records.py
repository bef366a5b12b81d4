"""Records of a COLMAP sparse model, and the names and ids of COLMAP's camera models."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ambiguous_wild.core.camera import rigid, rotation_from_quat
from ambiguous_wild.core.errors import AwError

# name -> (COLMAP's id, number of parameters)
MODELS = {
    "SIMPLE_PINHOLE": (0, 3),
    "PINHOLE": (1, 4),
    "SIMPLE_RADIAL": (2, 4),
    "RADIAL": (3, 5),
    "OPENCV": (4, 8),
    "OPENCV_FISHEYE": (5, 8),
    "FULL_OPENCV": (6, 12),
    "FOV": (7, 5),
    "SIMPLE_RADIAL_FISHEYE": (8, 4),
    "RADIAL_FISHEYE": (9, 5),
    "THIN_PRISM_FISHEYE": (10, 12),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 16),  # from here on COLMAP 4
    "SIMPLE_DIVISION": (12, 4),
    "DIVISION": (13, 5),
    "SIMPLE_FISHEYE": (14, 3),
    "FISHEYE": (15, 4),
    "EUCM": (16, 6),
    "EQUIRECTANGULAR": (17, 2),  # refused by name, see `check_camera`
}
LARGEST_SIDE = 1_000_000  # px
LARGEST_COORDINATE = 1e18  # world units; its square is finite in float32
FOCAL_RANGE = (1e-3, 1e6)  # focal length over the longer side
ONE_FOCAL = {name for name in MODELS if name.startswith(("SIMPLE_", "RADIAL"))}
SPLIT_PANORAMAS = "'aw capture PHOTOS -o SPLIT' splits 360 degree photos into pinhole views"
_BY_ID = {number: (name, count) for name, (number, count) in MODELS.items()}


@dataclass(frozen=True)
class ModelCamera:
    """One camera of the model, at the size the model was made with."""

    camera_id: int
    model: str  # a key of MODELS
    width: int  # px
    height: int  # px
    params: tuple[float, ...]  # px and distortion, in COLMAP's order
    shear: float = 0.0  # px that x moves right per px below cy, after the lens; Metashape's b2, not COLMAP's

    def pinhole(self) -> tuple[float, float, float, float]:
        """Return (fx, fy, cx, cy) in px.

        Raises:
            AwError: the camera has lens distortion; training needs undistorted photos.
        """
        if self.model == "PINHOLE":
            fx, fy, cx, cy = self.params
            return fx, fy, cx, cy
        if self.model == "SIMPLE_PINHOLE":
            f, cx, cy = self.params
            return f, f, cx, cy
        raise AwError(
            f"camera {self.camera_id} is {self.model}, which has lens distortion; training needs PINHOLE: "
            "'aw import FOLDER -o SCENE' undistorts the photos of this model"
        )


@dataclass(frozen=True)
class ModelImage:
    """One registered photo."""

    image_id: int
    qvec: np.ndarray  # [4] float64 (w, x, y, z), world to camera
    tvec: np.ndarray  # [3] float64
    camera_id: int
    name: str  # relative to the image folder
    xys: np.ndarray  # [K, 2] float64, px; pixel centres at +0.5
    point_ids: np.ndarray  # [K] int64, -1 = no point

    def cam_from_world(self) -> np.ndarray:
        """Return the rigid transform [4, 4] float64.

        Raises:
            AwError: the quaternion is no rotation.
        """
        norm = float(np.linalg.norm(self.qvec))
        if not np.isfinite(norm) or norm == 0.0:
            raise AwError(f"pose with the quaternion {self.qvec.tolist()}: the COLMAP model is damaged")
        return rigid(rotation_from_quat(self.qvec), self.tvec)


@dataclass(frozen=True)
class ModelPoints:
    """All points, ordered as in the file; tracks in compressed rows."""

    ids: np.ndarray  # [M] int64
    xyz: np.ndarray  # [M, 3] float64
    rgb: np.ndarray  # [M, 3] uint8
    error_px: np.ndarray  # [M] float64
    track_offsets: np.ndarray  # [M + 1] int64
    track_image_ids: np.ndarray  # [L] int64
    track_point2d: np.ndarray  # [L] int64, index into ModelImage.xys

    @property
    def owners(self) -> np.ndarray:
        """Index into `ids` of every observation's point, [L] int64."""
        return np.repeat(np.arange(len(self.ids)), np.diff(self.track_offsets))

    def subset(
        self,
        points: np.ndarray,  # [M] bool
        observations: np.ndarray,  # [L] bool
    ) -> ModelPoints:
        """Return some of the points, with some of their observations."""
        rows = points[self.owners] & observations
        lengths = np.bincount(self.owners[rows], minlength=len(points))[points]
        return ModelPoints(
            self.ids[points],
            self.xyz[points],
            self.rgb[points],
            self.error_px[points],
            np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            self.track_image_ids[rows],
            self.track_point2d[rows],
        )

    def seen_in(self, image_ids: Collection[int]) -> ModelPoints:
        """Return all points, with their observations in some images only."""
        return self.subset(np.ones(len(self.ids), bool), np.isin(self.track_image_ids, sorted(image_ids)))


@dataclass(frozen=True)
class ColmapModel:
    """cameras, images and points of one sparse model."""

    cameras: dict[int, ModelCamera]
    images: dict[int, ModelImage]
    points: ModelPoints


def points_without_tracks(
    xyz: ArrayLike = (),  # [M, 3] world
    rgb: ArrayLike = (),  # [M, 3] uint8
) -> ModelPoints:
    """Make points without observations; without arguments there are none."""
    positions, none = np.asarray(xyz, np.float64).reshape(-1, 3), np.zeros(0, np.int64)
    count = len(positions)
    return ModelPoints(
        np.arange(1, count + 1, dtype=np.int64),
        positions,
        np.asarray(rgb, np.uint8).reshape(-1, 3),
        np.zeros(count),
        np.zeros(count + 1, np.int64),
        none,
        none,
    )


def model_of_id(number: int, where: str) -> tuple[str, int]:
    """Return name and number of parameters of COLMAP's camera model id.

    Raises:
        AwError: an unknown id.
    """
    if number not in _BY_ID:
        raise AwError(
            f"{where}: camera model {number} is not known; convert it with COLMAP's model_converter"
        )
    return _BY_ID[number]
