"""A scene: views with poses, sparse points and the split by name."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypedDict

import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import shortlist

Split = Literal["train", "test"]
_FEW_POINTS = 500  # no surface follows from fewer
_FAR_CAMERA = 30.0  # times the median distance of the cameras from their middle: a wrong pose
_FEW_CAMERAS = 0.1  # of the cameras: more of them are another part of the capture
_FAR_PLACE = 100.0  # times a scene's size from the origin: float32 still has a hundredth of a pixel
_ORDINARY = (0.1, 1000.0)  # sizes at which the nearest depth and the formats' ranges fit
_SIZE = 4.0  # about that of scenes of structure from motion


class FileEntry(TypedDict):
    """One file that scene.json lists."""

    sha256: str
    bytes: int


class SceneInfo(TypedDict, total=False):
    """The keys of scene.json that programs read, and what `load_scene` adds; the file may hold more."""

    schema_version: int
    name: str
    factor: int  # downsampling that the scene was built for
    images: str  # folder of that factor
    license: str
    dataset: str  # as result tables call it
    evaluation: dict[str, Any]  # how the dataset's papers measure: protocol, effects
    build_key: str
    inputs: dict[str, Any]  # what it was built from
    files: dict[str, FileEntry]  # by path relative to the scene
    loaded_factor: int  # added: of the pictures that were opened
    missing: dict[str, list[str]]  # added: per side the listed names that the model lacks
    warnings: list[str]  # the build's; after `load_scene` what it found


@dataclass(frozen=True)
class View:
    """One photo: its file, its camera and its side of the split.

    Keep maps follow one convention everywhere: 1 = static (kept), 0 = transient.
    """

    name: str  # path relative to the image folder, as COLMAP and the split lists write it
    image_path: Path  # the file that is trained on or measured against, already downsampled
    camera: Camera  # of that file: intrinsics match its size
    split: Split
    keep_path: Path | None = None  # PNG, white = keep; the user's or the capture's own mask
    image_id: int = -1  # COLMAP's id, -1 where there is none


@dataclass(frozen=True)
class Points:
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

    def __len__(self) -> int:
        return len(self.xyz)

    @property
    def sure_xyz(self) -> np.ndarray:
        """[K, 3] points that three photos or more show, for surfaces; all, where these are few."""
        sure = np.diff(self.track_offsets) >= 3
        return self.xyz[sure] if sure.sum() >= _FEW_POINTS else self.xyz


@dataclass(frozen=True)
class Place:
    """Where a scene lies in its files' coordinates: inside, a position x is ``R (x - centre) * scale``."""

    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0  # a power of two, so that positions lose no bit
    turn: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # R as w, x, y, z; of exports alone

    @property
    def rotation(self) -> np.ndarray:
        """R, [3, 3]."""
        w, x, y, z = np.array(self.turn) / np.linalg.norm(self.turn)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.eye(3) + 2.0 * (w * cross + cross @ cross)

    def inside(self, camera: Camera) -> Camera:
        """A camera of the files' coordinates, moved along."""
        if self == UNMOVED:
            return camera
        pose = camera.cam_from_world.copy()
        pose[:3, 3] = (pose[:3, :3] @ self.centre + pose[:3, 3]) * self.scale
        pose[:3, :3] = pose[:3, :3] @ self.rotation.T
        return replace(camera, cam_from_world=pose)


UNMOVED = Place()


@dataclass(frozen=True)
class Scene:
    """Views ordered by name, sparse points, and scene.json."""

    root: Path
    name: str
    views: tuple[View, ...]
    points: Points
    info: SceneInfo = field(default_factory=SceneInfo, repr=False)
    place: Place = UNMOVED  # of the coordinates of views and points in those of the files

    @cached_property
    def train(self) -> tuple[View, ...]:
        """Training views, ordered by name."""
        return tuple(v for v in self.views if v.split == "train")

    @cached_property
    def test(self) -> tuple[View, ...]:
        """Test views, ordered by name."""
        return tuple(v for v in self.views if v.split == "test")

    @cached_property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean (3DGS's scene extent).

        Test cameras do not enter: their poses are not known to a method that trains.
        """
        centers = np.array([v.camera.center for v in together(self.train or self.views)])
        radius = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max(initial=0.0))
        # A capture from one spot has no baseline: the points keep the learning rates finite.
        if radius <= 0.0 and len(self.points):
            radius = float(np.median(np.linalg.norm(self.points.xyz - centers.mean(axis=0), axis=1)))
        return 1.1 * radius if radius > 0.0 else 1.0


def centred(scene: Scene) -> Scene:
    """The scene near the origin and of ordinary size, with its place; as it is where it lies so already.

    What trains and draws counts in float32, from a nearest depth of 0.01 on.
    """
    centers = np.array([v.camera.center for v in together(scene.train or scene.views)])
    xyz, middle = scene.points.xyz, np.median(centers, axis=0)
    depth = float(np.median(np.linalg.norm(xyz - middle, axis=1))) if len(xyz) else 0.0
    size = max(_away(centers)[1], depth)
    if not (np.isfinite(size) and size > 0.0):
        return scene
    unit = 10.0 ** np.floor(np.log10(size))
    far = np.abs(middle).max() > _FAR_PLACE * size
    x, y, z = (np.round(middle / unit) * unit if far else np.zeros(3)).tolist()
    scale = 1.0 if _ORDINARY[0] <= size <= _ORDINARY[1] else float(2.0 ** np.round(np.log2(_SIZE / size)))
    place = Place((x, y, z), scale)
    if place == UNMOVED:
        return scene
    views = tuple(replace(v, camera=place.inside(v.camera)) for v in scene.views)
    points = replace(scene.points, xyz=(xyz - place.centre) * scale)
    return replace(scene, views=views, points=points, place=place)


def together(views: tuple[View, ...]) -> tuple[View, ...]:
    """The views without the few, if any, whose cameras lie far from the rest: their poses are wrong."""
    near = near_others(np.array([v.camera.center for v in views]))
    return views if near.all() else tuple(v for v, inside in zip(views, near) if inside)


def near_others(centers: np.ndarray) -> np.ndarray:
    """[N] bool, positions [N, 3] of cameras that do not lie far from all others; all, unless few lie so."""
    away, usual = _away(centers)
    near = away <= _FAR_CAMERA * usual
    few = usual > 0.0 and (~near).sum() <= max(1, _FEW_CAMERAS * len(centers))
    return near if few else np.ones(len(centers), bool)


def far_cameras(scene: Scene) -> list[str]:
    """A warning that names the training photos that `together` leaves out."""
    far = {view.name for view in scene.train} - {view.name for view in together(scene.train)}
    told = f"the cameras of {shortlist(sorted(far))} lie far from all others, so their poses are probably "
    told += "wrong; the scene's size is measured without them: check them, or take them out of train_list.txt"
    return [told] if far else []


def _away(centers: np.ndarray) -> tuple[np.ndarray, float]:
    """Distances [N] of positions [N, 3] from their median, and the median of these."""
    away = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    return away, float(np.median(away))
