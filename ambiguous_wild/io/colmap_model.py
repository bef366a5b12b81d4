"""COLMAP sparse models in plain numpy: read and write, binary and text, without pycolmap.

Layouts: COLMAP documentation, "Output Format". Sizes in a binary file are checked against its length
before anything is allocated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from ambiguous_wild.core.errors import AwError

# name -> (COLMAP's id, number of parameters); the rest of COLMAP's list is known by count alone.
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
}
LARGEST_SIDE = 1_000_000  # px
LARGEST_COORDINATE = 1e18  # world units; squares of it are still numbers in float32
FOCAL_RANGE = (1e-3, 1e6)  # focal length over the longer side
_TWO_FOCALS = {"PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE"}
_BY_ID = {number: (name, count) for name, (number, count) in MODELS.items()}


@dataclass(frozen=True)
class ModelCamera:
    """One camera of the model, at the size the model was made with."""

    camera_id: int
    model: str  # a key of MODELS
    width: int  # px
    height: int  # px
    params: tuple[float, ...]  # px and distortion, in COLMAP's order

    def pinhole(self) -> tuple[float, float, float, float]:
        """(fx, fy, cx, cy) in px.

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
            "undistort the photos with 'aw build-scene PHOTOS -o SCENE'"
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
        """[4, 4] float64, rigid."""
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_quaternion(self.qvec)
        pose[:3, 3] = self.tvec
        return pose


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


@dataclass(frozen=True)
class Model:
    """cameras, images and points of one sparse model."""

    cameras: dict[int, ModelCamera]
    images: dict[int, ModelImage]
    points: ModelPoints


def rotation_from_quaternion(q: np.ndarray) -> np.ndarray:
    """[3, 3] rotation of the quaternion (w, x, y, z); it is normalised first."""
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm == 0.0:
        raise AwError(f"pose with the quaternion {[float(v) for v in q]}: the COLMAP model is damaged")
    w, x, y, z = np.asarray(q, dtype=np.float64) / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def read_model(folder: Path | str) -> Model:
    """Read cameras, images and points3D of a model folder: .bin if there, else .txt.

    Raises:
        AwError: files are missing, cut short or contradict each other.
    """
    root = Path(folder)
    for suffix in (".bin", ".txt"):
        paths = [root / (stem + suffix) for stem in ("cameras", "images", "points3D")]
        if all(p.is_file() for p in paths):
            break
    else:
        raise AwError(f"{root} holds no COLMAP model: cameras, images and points3D (.bin or .txt) are needed")
    if suffix == ".bin":
        from ambiguous_wild.io import colmap_binary as reader
    else:
        from ambiguous_wild.io import colmap_text as reader  # type: ignore[no-redef]
    model = Model(
        cameras=reader.read_cameras(paths[0]),
        images=reader.read_images(paths[1]),
        points=reader.read_points(paths[2]),
    )
    for camera in model.cameras.values():
        _check_camera(root, camera)
    names: set[str] = set()
    for image in model.images.values():
        if not PurePosixPath(image.name).name or "\0" in image.name:
            raise AwError(f"{root}: image {image.image_id} has no name: the model is damaged; build it again")
        if image.camera_id not in model.cameras:
            raise AwError(f"{root}: image {image.name!r} names camera {image.camera_id}, which is not there")
        if not (np.abs(image.tvec) < LARGEST_COORDINATE).all():
            raise AwError(
                f"{root}: image {image.name!r} has the translation {image.tvec.tolist()}: the model is "
                "damaged; build it again"
            )
        if image.name in names:
            raise AwError(
                f"{root}: image {image.name!r} is there twice: the model is damaged; build it again"
            )
        names.add(image.name)
    odd = np.flatnonzero(~(np.abs(model.points.xyz) < LARGEST_COORDINATE).all(axis=1))
    if len(odd):
        raise AwError(
            f"{root}: {len(odd)} points are nowhere, the first is {model.points.ids[odd[0]]} at "
            f"{model.points.xyz[odd[0]].tolist()}: the model is damaged; build it again or take them out"
        )
    return model


def _check_camera(root: Path, camera: ModelCamera) -> None:
    """Raise AwError for a camera that no lens has; its size is divided by, and allocated."""
    size = (camera.width, camera.height)
    whole = all(0 < side <= LARGEST_SIDE for side in size) and bool(np.isfinite(camera.params).all())
    focal = camera.params[:2] if camera.model in _TWO_FOCALS else camera.params[:1]
    if not whole or not all(FOCAL_RANGE[0] <= f / max(size) <= FOCAL_RANGE[1] for f in focal):
        raise AwError(
            f"{root}: camera {camera.camera_id} is {size[0]}x{size[1]} px with the parameters "
            f"{list(camera.params)}: the model is damaged; copy or build it again"
        )


def model_of_id(number: int, where: str) -> tuple[str, int]:
    """(name, number of parameters) of COLMAP's camera model id.

    Raises:
        AwError: an id COLMAP does not have, or one that is new to us.
    """
    if number not in _BY_ID:
        raise AwError(
            f"{where}: camera model {number} is not known; convert it with COLMAP's model_converter"
        )
    return _BY_ID[number]
