"""A scene: views with poses, sparse points and the split by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path, PurePath
from typing import Literal, TypedDict

import numpy as np

from ambiguous_wild.core.camera import Camera, rotation_from_quat
from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import AwError

Split = Literal["train", "test"]
NO_PHOTO = Path()  # image path of views without a photo: of a splat file's scene, or hidden from methods
_FEW_POINTS = 500  # fewer points do not describe a surface
_FAR_CAMERA = 30.0  # times the cameras' median distance from their middle; farther away a pose is wrong
_FEW_CAMERAS = 0.1  # share of the cameras; if more lie far away, they are another part of the capture
_FAR_PLACE = 100.0  # times a scene's size; at this distance float32 still resolves 0.01 px
_ORDINARY = (0.1, 1000.0)  # scene sizes that suit the nearest depth and the ranges of file formats
_SIZE = 4.0  # other scenes are scaled to about this size, which structure from motion often gives


@dataclass(frozen=True)
class SceneTransform:
    """The change of coordinates from a scene's files to training: ``x -> R (x - centre) * scale``."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0  # a power of two, so that positions lose no bit
    quat: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # R as w, x, y, z; of exports alone

    @property
    def rotation(self) -> np.ndarray:
        """R, [3, 3]."""
        return rotation_from_quat(np.array(self.quat))

    def inside(self, camera: Camera) -> Camera:
        """Return a camera of the files' coordinates in those of training."""
        if self == UNMOVED:
            return camera
        pose = camera.cam_from_world.copy()
        pose[:3, 3] = (pose[:3, :3] @ self.centre + pose[:3, 3]) * self.scale
        pose[:3, :3] = pose[:3, :3] @ self.rotation.T
        return replace(camera, cam_from_world=pose)


UNMOVED = SceneTransform()


class FileEntry(TypedDict):
    """One file that scene.json lists."""

    sha256: str
    bytes: int


class Evaluation(TypedDict, total=False):
    """How the dataset's papers measure; the key "evaluation" of scene.json, which `aw bench` follows."""

    protocol: Literal["full", "half"]
    effects: list[str]  # fitted on the left half of a test photo
    source: str


class SceneInfo(TypedDict, total=False):
    """The keys of scene.json that programs read, and what `load_scene` adds; the file may hold more."""

    schema_version: int
    name: str
    factor: int  # downsampling that the scene was built for
    images: str  # folder of that factor
    license: str
    dataset: str  # name of the data set in result tables
    evaluation: Evaluation
    background: list[int]  # [3] sRGB codes, behind what the photos show; absent: black
    build_key: str
    inputs: Facts  # what it was built from
    files: dict[str, FileEntry]  # path relative to the scene -> its entry
    loaded_factor: int  # added by `load_scene`: downsampling of the pictures that it opened
    missing: dict[str, list[str]]  # added by `load_scene`: listed photos without a pose, by side of the split
    warnings: list[str]  # warnings of the build; `load_scene` replaces them


@dataclass(frozen=True)
class View:
    """One photo: its file, its camera and its side of the split.

    Keep maps follow one convention everywhere: 1 = static (kept), 0 = transient.
    """

    name: str  # path relative to the image folder, as in COLMAP's model and the split lists
    image_path: Path  # the file that is trained on or measured against, already downsampled
    camera: Camera  # its intrinsics match the size of that file
    split: Split
    keep_path: Path | None = None  # white = keep; of a test photo: what psnr_valid measures
    image_id: int = -1  # COLMAP's id, -1 where there is none


@dataclass(frozen=True)
class SparsePoints:
    """Sparse points of structure from motion; tracks in compressed rows (CSR).

    Observation k of point i, for ``track_offsets[i] <= k < track_offsets[i + 1]``, is at
    ``track_xy[k]`` of the view ``views[track_views[k]]``.
    """

    xyz: np.ndarray  # [M, 3] float64, world
    rgb: np.ndarray  # [M, 3] uint8
    error_px: np.ndarray  # [M] float64, mean reprojection error at full size
    track_offsets: np.ndarray  # [M + 1] int64
    track_views: np.ndarray  # [L] int32, index into Scene.views; -1 = a view out of the split, or no position
    track_xy: np.ndarray  # [L, 2] float32, px of the *loaded* image of that view

    @classmethod
    def without_tracks(cls, xyz: np.ndarray) -> SparsePoints:
        """Return black points [M, 3] that no view is known to see."""
        count, rows = len(xyz), np.zeros((0, 2), np.float32)
        rgb, offsets = np.zeros((count, 3), np.uint8), np.zeros(count + 1, np.int64)
        return cls(xyz, rgb, np.zeros(count), offsets, np.zeros(0, np.int32), rows)

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def owners(self) -> np.ndarray:
        """Index of every observation's point, [L] int64."""
        return np.repeat(np.arange(len(self)), np.diff(self.track_offsets))

    @property
    def sure_xyz(self) -> np.ndarray:
        """Points [K, 3] seen by at least three photos, for surfaces; all points if these are too few."""
        sure = np.diff(self.track_offsets) >= 3
        return self.xyz[sure] if sure.sum() >= _FEW_POINTS else self.xyz


@dataclass(frozen=True)
class Scene:
    """Views ordered by name, sparse points, and scene.json."""

    root: Path
    name: str
    views: tuple[View, ...]
    points: SparsePoints
    info: SceneInfo = field(default_factory=SceneInfo, repr=False)
    transform: SceneTransform = UNMOVED  # how views and points were moved from the coordinates of the files

    @cached_property
    def train(self) -> tuple[View, ...]:
        """Training views, ordered by name."""
        return tuple(v for v in self.views if v.split == "train")

    @cached_property
    def test(self) -> tuple[View, ...]:
        """Test views, ordered by name."""
        return tuple(v for v in self.views if v.split == "test")

    @property
    def background(self) -> tuple[float, float, float]:
        """Colour in [0, 1] that was put behind the photos, and is drawn behind the model."""
        red, green, blue = (code / 255 for code in self.info.get("background", (0, 0, 0)))
        return red, green, blue

    def truth_file(self, part: str, view: View) -> Path:
        """Return where a part of a photo's exact truth, a folder of truth/, lies if the capture has it."""
        return self.root / "truth" / part / Path(view.name).with_suffix(".png")

    @cached_property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean (3DGS's scene extent).

        Test cameras do not enter: their poses are not known to a method that trains.
        """
        centers = np.array([v.camera.center for v in without_outliers(self.train or self.views)])
        radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0))
        # A capture from one spot has no baseline: the points keep the learning rates finite.
        if radius <= 0.0 and len(self.points):
            radius = float(np.median(np.linalg.norm(self.points.xyz - centers.mean(axis=0), axis=1)))
        return 1.1 * radius if radius > 0.0 else 1.0


def find_view(views: Sequence[View], photo: str) -> View | None:
    """Find a view by its name, or by the name or the stem of its file; None if there is none.

    Raises:
        AwError: several views have this file name or stem.
    """
    found = [view for view in views if view.name == photo]
    found = found or [v for v in views if photo in (PurePath(v.name).name, PurePath(v.name).stem)]
    # a scene holds PNG files of photos that may have been JPEG files
    found = found or [v for v in views if PurePath(photo).stem == PurePath(v.name).stem]
    if len(found) > 1:
        names = ", ".join(view.name for view in found)
        raise AwError(f"{photo} names several photos: {names}; name one in full")
    return found[0] if found else None


def centred(scene: Scene) -> Scene:
    """Return the scene moved to the origin and scaled to an ordinary size, where it is not so already.

    Training and rendering use float32 and draw nothing nearer than 0.01.
    """
    centers = np.array([v.camera.center for v in without_outliers(scene.train or scene.views)])
    xyz, middle = scene.points.xyz, np.median(centers, axis=0)
    depth = float(np.median(np.linalg.norm(xyz - middle, axis=1))) if len(xyz) else 0.0
    size = max(_away(centers)[1], depth)
    if not (np.isfinite(size) and size > 0.0):
        return scene
    unit = 10.0 ** np.floor(np.log10(size))
    far = np.abs(middle).max() > _FAR_PLACE * size
    x, y, z = (np.round(middle / unit) * unit if far else np.zeros(3)).tolist()
    scale = 1.0 if _ORDINARY[0] <= size <= _ORDINARY[1] else float(2.0 ** np.round(np.log2(_SIZE / size)))
    transform = SceneTransform((x, y, z), scale)
    if transform == UNMOVED:
        return scene
    views = tuple(replace(v, camera=transform.inside(v.camera)) for v in scene.views)
    points = replace(scene.points, xyz=(xyz - transform.centre) * scale)
    return replace(scene, views=views, points=points, transform=transform)


def without_outliers(views: tuple[View, ...]) -> tuple[View, ...]:
    """Return the views without the few whose cameras lie far from the rest: their poses are wrong."""
    inlier = inlier_centers(np.array([v.camera.center for v in views]))
    return views if inlier.all() else tuple(v for v, kept in zip(views, inlier) if kept)


def inlier_centers(centers: np.ndarray) -> np.ndarray:
    """Whether each camera centre [N, 3] lies near the others, [N] bool; all True if many lie far away."""
    away, usual = _away(centers)
    near = away <= _FAR_CAMERA * usual
    few = usual > 0.0 and (~near).sum() <= max(1, _FEW_CAMERAS * len(centers))
    return near if few else np.ones(len(centers), bool)


def _away(centers: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the distances [N] of positions [N, 3] from their median, and the median distance."""
    away = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    return away, float(np.median(away))
