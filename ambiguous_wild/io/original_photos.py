"""The photos that a scene was built from: where they lie, and by which lens each was undistorted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.names import stays_below
from ambiguous_wild.io.colmap_records import MODELS, ModelCamera
from ambiguous_wild.io.images import MAX_PIXELS

AGAIN = "build it again with 'aw build-scene PHOTOS -o SCENE --overwrite'"


@dataclass(frozen=True)
class OriginalPhoto:
    """A photo of the capture."""

    source: str  # path in the capture's folder
    sha256: str
    name: str = ""  # of its files in the scene; empty: it has no pose
    size: tuple[int, int] = (0, 0)  # width and height in px, upright; (0, 0): it could not be read
    orientation: int = 1  # EXIF orientation that made it upright
    camera: ModelCamera | None = None  # with lens distortion, at `size`
    why: str = ""  # it has no pose


def original_photos(info: Mapping[str, Any]) -> tuple[OriginalPhoto, ...] | None:
    """Return the photos that scene.json tells of, in its order; None where it does not tell of their lenses.

    It does so in scenes of 'aw build-scene' alone, and not in those of earlier versions.

    Args:
        info: scene.json as read; it may be a stranger's.

    Raises:
        AwError: scene.json was changed.
    """
    try:
        if not is_built(info) or "params" not in info["cameras"][0]:
            return None
        return tuple(_originals(info))
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise AwError(
            f"scene.json of {info.get('name')} is damaged ({type(error).__name__}: {error}); {AGAIN}"
        ) from None


def is_built(info: Mapping[str, Any]) -> bool:
    """Whether scene.json is one of 'aw build-scene'."""
    return "chosen" in info


def _originals(info: Mapping[str, Any]) -> list[OriginalPhoto]:
    cameras = {source: _camera(camera) for camera in info["cameras"] for source in camera["photos"]}
    reasons = {lost["source"]: str(lost["reason"]) for lost in info["lost"]}
    unread = {skipped["source"]: str(skipped["skipped"]) for skipped in info["skipped"]}
    photos: dict[str, OriginalPhoto] = {}
    for name, photo in info["photos"].items():
        source = photo["source"]
        camera = cameras.get(source)
        photos[photo["sha256"]] = OriginalPhoto(
            _inside(source),
            photo["sha256"],
            _inside(name) if camera is not None else "",
            _size(photo),
            int(photo["exif"].get("orientation", 1)),
            camera,
            "" if camera is not None else reasons.get(source, "no pose"),
        )
    found = []
    for source, _, _, sha256, *_ in info["inputs"]["photos"]:
        same = photos.get(sha256)  # the photo itself, or the one that it is a copy of
        if same is None:
            found.append(
                OriginalPhoto(_inside(source), sha256, why=unread.get(source, "it could not be read"))
            )
        else:
            found.append(replace(same, source=_inside(source)))
    return found


def _camera(record: Mapping[str, Any]) -> ModelCamera:
    model, params = str(record["model"]), tuple(float(value) for value in record["params"])
    if len(params) != MODELS[model][1] or not all(map(math.isfinite, params)):
        raise ValueError(f"parameters {params} of {model}")
    return ModelCamera(1, model, *_size(record), params)


def _size(record: Mapping[str, Any]) -> tuple[int, int]:
    width, height = int(record["width"]), int(record["height"])
    if min(width, height) < 1 or width * height > MAX_PIXELS:  # maps of lenses are made at this size
        raise ValueError(f"{width}x{height} px is the size of no photo")
    return width, height


def _inside(name: str) -> str:
    if not stays_below(name):
        raise ValueError(f"{name!r} is no path in a folder")
    return name


def capture_folder(scene: Path, info: Mapping[str, Any]) -> Path:
    """Return the folder of the photos that a scene was built from.

    Raises:
        AwError: it is gone, or scene.json does not name it.
    """
    if "capture" not in info:
        raise AwError(f"{scene} does not say where its photos are, as packed scenes do not: {AGAIN}")
    where = Path(str(info["capture"]))
    folder = (scene.resolve() / where).resolve()
    below = Path(*(part for part in where.parts if part != ".."))
    if not folder.is_dir() and below.parts:  # the scene was moved, its photos were not
        moved = (above / below for above in scene.resolve().parents)
        folder = next((place for place in moved if place.is_dir()), folder)
    if not folder.is_dir():
        raise AwError(
            f"the photos that {scene} was built from are not at {folder}: move scene or photos back, or "
            "build the scene again"
        )
    return folder
