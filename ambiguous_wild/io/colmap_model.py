"""COLMAP sparse models in numpy, binary and text, without pycolmap.

Layouts: COLMAP documentation, "Output Format". Sizes in a binary file are checked against its length before
memory is allocated.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io import colmap_binary, colmap_text
from ambiguous_wild.io.colmap_records import (
    _TWO_FOCALS,
    FOCAL_RANGE,
    LARGEST_COORDINATE,
    LARGEST_SIDE,
    Model,
    ModelCamera,
)


def read_model(folder: Path | str) -> Model:
    """Read cameras, images and points3D of a model folder: .bin if there, else .txt.

    Raises:
        AwError: files are missing, damaged or contradictory.
    """
    root = Path(folder)
    for suffix in (".bin", ".txt"):
        paths = [root / (stem + suffix) for stem in ("cameras", "images", "points3D")]
        if all(p.is_file() for p in paths):
            break
    else:
        raise AwError(f"{root} holds no COLMAP model: cameras, images and points3D (.bin or .txt) are needed")
    if suffix == ".bin":
        model = Model(
            cameras=colmap_binary.read_cameras(paths[0]),
            images=colmap_binary.read_images(paths[1]),
            points=colmap_binary.read_points(paths[2]),
        )
    else:
        model = Model(
            cameras=colmap_text.read_cameras(paths[0]),
            images=colmap_text.read_images(paths[1]),
            points=colmap_text.read_points(paths[2]),
        )
    for camera in model.cameras.values():
        check_camera(root, camera)
    names: set[str] = set()
    for image in model.images.values():
        if not PurePosixPath(image.name).name or "\0" in image.name:
            raise AwError(f"{root}: image {image.image_id} has no name: the model is damaged; build it again")
        if image.camera_id not in model.cameras:
            raise AwError(
                f"{root}: image {image.name!r} has camera {image.camera_id}, which the model lacks: "
                "it is damaged; build it again"
            )
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
            f"{root}: {len(odd)} points have no valid position, the first is {model.points.ids[odd[0]]} at "
            f"{model.points.xyz[odd[0]].tolist()}: the model is damaged; build it again or remove them"
        )
    return model


def check_camera(root: Path, camera: ModelCamera) -> None:
    """Raise AwError for an impossible size or focal length, before it is divided by or allocated.

    Args:
        root: where the camera is stated, for the message.
        camera: of a model.
    """
    size = (camera.width, camera.height)
    whole = all(0 < side <= LARGEST_SIDE for side in size) and bool(np.isfinite(camera.params).all())
    focal = camera.params[:2] if camera.model in _TWO_FOCALS else camera.params[:1]
    if not whole or not all(FOCAL_RANGE[0] <= f / max(size) <= FOCAL_RANGE[1] for f in focal):
        raise AwError(
            f"{root}: camera {camera.camera_id} is {size[0]}x{size[1]} px with the parameters "
            f"{list(camera.params)}: the model is damaged; copy or build it again"
        )
