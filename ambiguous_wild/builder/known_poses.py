"""Exact cameras of a simulated capture instead of estimated ones; known cameras in COLMAP's database."""

from __future__ import annotations

import dataclasses
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import msgspec
import numpy as np

from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.colmap_records import (
    MODELS,
    ColmapModel,
    ModelCamera,
    ModelImage,
    points_without_tracks,
)
from ambiguous_wild.io.untrusted import read_json

FILE = "cameras.json"  # in truth/ of a simulated capture
ROUNDING = 1e-6  # by which a rotation may differ from an exact one
ESTIMATE = "leave out --mapper truth to estimate the cameras"


@dataclass(frozen=True)
class KnownCamera:
    """One camera of cameras.json."""

    width: int  # px
    height: int  # px
    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    cam_from_world: list[list[float]]  # [4, 4]
    distortion: dict[str, float] = field(default_factory=dict)  # k1, k2, as in COLMAP's RADIAL


def read_known_cameras(truth: Path | None, photos: Sequence[ScreenedPhoto]) -> ColmapModel:
    """Read the exact cameras of the photos: a model without points, in which equal lenses are one camera.

    Args:
        truth: truth/ of the capture; None: it has none.
        photos: of the capture.

    Raises:
        AwError: there are no exact cameras, or not of every photo; or a lens that SIMPLE_RADIAL cannot hold.
    """
    path = truth / FILE if truth is not None else None
    if path is None or not path.is_file():
        raise AwError(
            f"--mapper truth: the capture has no truth/{FILE}, as those of 'aw simulate' have; {ESTIMATE}"
        )
    try:
        known = msgspec.convert(read_json(path), dict[str, KnownCamera])
    except msgspec.ValidationError as error:
        raise AwError(f"{path} holds no cameras of 'aw simulate' ({error}); {ESTIMATE}") from None
    names = [name_in_truth(photo.source) for photo in photos]
    if absent := [photo.source for photo, name in zip(photos, names) if name not in known]:
        raise AwError(
            f"{path} has no camera of {counted(len(absent), 'photo')}: {shortlist(absent, 3)}; take "
            f"these away, or {ESTIMATE}"
        )
    cameras: dict[tuple[object, ...], ModelCamera] = {}
    images = {}
    for number, (photo, name) in enumerate(zip(photos, names), 1):
        camera = known[name]
        lens = (camera.width, camera.height, _lens(f"{path}: {name}", camera, photo))
        cameras.setdefault(lens, ModelCamera(len(cameras) + 1, "SIMPLE_RADIAL", *lens))
        qvec, tvec = _pose(f"{path}: {name}", camera)
        no_points = np.zeros((0, 2)), np.zeros(0, np.int64)
        images[number] = ModelImage(number, qvec, tvec, cameras[lens].camera_id, photo.name, *no_points)
    return ColmapModel({c.camera_id: c for c in cameras.values()}, images, points_without_tracks())


def name_in_truth(source: str) -> str:
    """Return the name of a photo in the truth: its path below train/, test/ or images/."""
    parts = PurePosixPath(source).parts
    return "/".join(parts[parts[0] in ("train", "test", "images") :])


def _lens(where: str, camera: KnownCamera, photo: ScreenedPhoto) -> tuple[float, float, float, float]:
    """Return the parameters of SIMPLE_RADIAL: focal length, centre, k1."""
    if (camera.width, camera.height) != photo.size:
        raise AwError(
            f"{where} is {camera.width}x{camera.height}, but the photo {photo.width}x{photo.height}: "
            f"the cameras belong to another capture; {ESTIMATE}"
        )
    inside = 0 <= camera.cx <= camera.width and 0 <= camera.cy <= camera.height
    if not (inside and 0 < camera.fx < np.inf) or camera.distortion.keys() - {"k1", "k2"}:
        raise AwError(
            f"{where}: fx above 0, a centre in the photo and a distortion of k1 and k2 are needed; {ESTIMATE}"
        )
    k1, k2 = (camera.distortion.get(key, 0.0) for key in ("k1", "k2"))
    if k2 or camera.fx != camera.fy:
        why = f"k2 is {k2:g}" if k2 else f"fx is {camera.fx:g} and fy {camera.fy:g}"
        raise AwError(f"{where}: {why}, which COLMAP's SIMPLE_RADIAL cannot hold; {ESTIMATE}")
    return camera.fx, camera.cx, camera.cy, k1


def _pose(where: str, camera: KnownCamera) -> tuple[np.ndarray, np.ndarray]:
    """Return quaternion [4] (w, x, y, z) and translation [3] of a camera, from the world."""
    from scipy.spatial.transform import Rotation

    if [len(row) for row in camera.cam_from_world] != [4] * 4:
        raise AwError(f"{where}: cam_from_world is no matrix of 4x4")
    pose = np.array(camera.cam_from_world)
    rotation = pose[:3, :3]
    turned = np.abs(rotation @ rotation.T - np.eye(3)).max() < ROUNDING and np.linalg.det(rotation) > 0
    if not (np.isfinite(pose).all() and turned and (pose[3] == (0, 0, 0, 1)).all()):
        raise AwError(f"{where}: cam_from_world is no rotation with a translation")
    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1), pose[:3, 3]


def set_cameras(database: Path, known: Path, model: ColmapModel, used: Mapping[str, ModelImage]) -> None:
    """Write known cameras to COLMAP's database, and the model with the database's ids to the folder `known`.

    Raises:
        AwError: a camera has another size than in the database.
    """
    with closing(sqlite3.connect(database)) as db, db:
        rows = db.execute("SELECT name, image_id, camera_id FROM images").fetchall()
        sizes = {n: (w, h) for n, w, h in db.execute("SELECT camera_id, width, height FROM cameras")}
        cameras, images = {}, {}
        for name, image_id, camera_id in rows:
            camera = model.cameras[used[name].camera_id]
            if sizes[camera_id] != (camera.width, camera.height):
                raise AwError(
                    f"{name} is {sizes[camera_id][0]}x{sizes[camera_id][1]}, its camera {camera.width}x"
                    f"{camera.height}: points cannot be triangulated; use the photos that the poses belong to"
                )
            cameras[camera_id] = dataclasses.replace(camera, camera_id=camera_id)
            images[image_id] = dataclasses.replace(used[name], image_id=image_id, camera_id=camera_id)
        for camera in cameras.values():
            params = np.array(camera.params, "<f8").tobytes()
            db.execute(
                "UPDATE cameras SET model = ?, params = ?, prior_focal_length = 1 WHERE camera_id = ?",
                (MODELS[camera.model][0], params, camera.camera_id),
            )
    write_model(known, ColmapModel(cameras, images, points_without_tracks()))
