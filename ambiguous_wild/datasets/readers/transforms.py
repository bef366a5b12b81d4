"""Read transforms.json of nerfstudio and instant-ngp, and Blender's transforms_train.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Literal

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.scene import Split
from ambiguous_wild.datasets.foreign import ForeignScene, inside, split_by_lists
from ambiguous_wild.datasets.photo_names import find_photo
from ambiguous_wild.datasets.readers.colmap import sides
from ambiguous_wild.datasets.readers.posed_photos import brown_camera, model_of_poses, only_file
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, points_without_tracks
from ambiguous_wild.io.images import header_size
from ambiguous_wild.io.ply import read_point_ply
from ambiguous_wild.io.scene_folder import SIDES
from ambiguous_wild.io.untrusted import read_json

_MODELS = ["OPENCV", "OPENCV_FISHEYE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"]
_LENS = ("k1", "k2", "p1", "p2")
WHITE = (255, 255, 255)


def read_object(path: Path) -> dict[str, object]:
    """Read a JSON file that holds a mapping.

    Raises:
        AwError: unreadable, too large, or no mapping.
    """
    data = read_json(path)
    if not isinstance(data, dict):
        raise AwError(f"{path} holds no mapping; copy it again")
    return data


def frames_of(data: Mapping[str, object], path: Path) -> list[dict[str, object]]:
    """Return the frames after checking that each has a file and a matrix.

    Raises:
        AwError: there are no frames, or one lacks its file or matrix.
    """
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise AwError(f"{path} has no frames")
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise AwError(f"{path}: frame {number} has no file_path")
        if "transform_matrix" not in frame:
            raise AwError(f"{path}: frame {number} ({frame['file_path'][:60]}) has no transform_matrix")
    return frames


def frame_name(frame: Mapping[str, object], root: Path) -> str:
    """Return the frame's path relative to the scene, without a leading "./"."""
    return below(str(frame["file_path"]), root)


def below(name: str, root: Path) -> str:
    """Return a file's path relative to the scene; of a path on another computer the end that exists here.

    Raises:
        AwError: such a path has no end that is a file of the scene.
    """
    pure = PurePosixPath(name.replace("\\", "/"))
    if not (pure.is_absolute() or ".." in pure.parts or name[1:2] == ":"):
        return inside(str(pure), root)
    parts = pure.parts[1 + max((k for k, part in enumerate(pure.parts) if part == ".."), default=0) :]
    for end in ("/".join(parts[k:]) for k in range(len(parts))):
        if find_photo(root, inside(end, root)) is not None:
            return end
    raise AwError(f"{name[:200]!r} leads out of {root}, which has no copy of it; put it there")


def _number(values: Mapping[str, object], key: str, path: Path) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise AwError(f"{path}: {key} is {str(value)[:40]!r}, not a number")
    return float(value)


def frame_camera(
    frame: Mapping[str, object], data: Mapping[str, object], photo: Path, path: Path
) -> ModelCamera:
    """Return the camera of a frame: its values first, then the file's common ones, then field of view.

    Raises:
        AwError: no focal length, no size, or a camera model that is not supported.
    """
    both = {**data, **frame}

    def value(key: str) -> float | None:
        return _number(both, key, path)

    width, height = value("w"), value("h")
    if width is None or height is None:
        size = header_size(photo)
        if size is None:
            raise AwError(f"{path} states no w and h, and {photo} is absent or no image")
        width, height = map(float, size)
    fx, fy = value("fl_x"), value("fl_y")
    angle_x, angle_y = value("camera_angle_x"), value("camera_angle_y")
    if fx is None and angle_x is not None and 0 < angle_x < math.pi:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    if fy is None and angle_y is not None and 0 < angle_y < math.pi:
        fy = 0.5 * height / math.tan(0.5 * angle_y)
    fx, fy = (fy if fx is None else fx), (fx if fy is None else fy)
    if fx is None or fy is None:
        raise AwError(f"{path} states neither fl_x nor camera_angle_x: the focal length is unknown")
    cx, cy = value("cx"), value("cy")
    cx, cy = (width / 2 if cx is None else cx), (height / 2 if cy is None else cy)
    lens = [value(k) or 0.0 for k in _LENS]
    third = [value(k) or 0.0 for k in ("k3", "k4")]
    model = str(both.get("camera_model", "OPENCV")).upper()
    fisheye = model == "OPENCV_FISHEYE" or bool(both.get("is_fisheye"))
    if model not in _MODELS:
        problem = f"{path}: camera_model {model[:40]!r} is not supported"
        raise AwError(f"{problem}; undistort the photos to PINHOLE")
    size_px = (round(width), round(height))
    if fisheye:
        return ModelCamera(1, "OPENCV_FISHEYE", *size_px, (fx, fy, cx, cy, *lens[:2], *third))
    return brown_camera(size_px, (fx, fy, cx, cy), (*lens[:2], *third), lens[2:], str(path))


def read_frames(
    root: Path, path: Path, data: Mapping[str, object]
) -> tuple[ColmapModel, Path, dict[str, Mapping[str, object]]]:
    """Read the model of a transforms file, the folder of its photos, and the frames by the model's names.

    Raises:
        AwError: damaged, or two frames of one photo.
    """
    frame_of: dict[str, Mapping[str, object]] = {}
    for frame in frames_of(data, path):
        name = frame_name(frame, root)
        photo = find_photo(root, name)
        name = photo.relative_to(root).as_posix() if photo is not None else name
        if name in frame_of:
            raise AwError(f"{path} lists {name!r} twice; keep one frame of it")
        frame_of[name] = frame
    tops = {PurePosixPath(n).parts[0] if len(PurePosixPath(n).parts) > 1 else "" for n in frame_of}
    # The names of photos become relative to the folder that holds all of them.
    top = tops.pop() if len(tops) == 1 else ""
    folder = root / top if top else root
    named = {name[len(top) + 1 :] if top else name: frame for name, frame in frame_of.items()}
    rows = [(n, f["transform_matrix"], frame_camera(f, data, folder / n, path)) for n, f in named.items()]
    return model_of_poses(rows), folder, named


def read_transforms(root: Path) -> ForeignScene:
    """Read transforms.json of nerfstudio or instant-ngp."""
    path = root / "transforms.json"
    data = read_object(path)
    model, folder, named = read_frames(root, path, data)
    names = sorted(named)
    notes: list[str] = []
    if any(isinstance(data.get(f"{side}_filenames"), list) for side in ("train", "val", "test")):
        listed = _listed(data, path, root, folder)
        split, missing = split_by_lists(names, listed, path)
    else:
        split, missing, notes = sides(names, root)
    masks = _masks(named, split, root)
    points = data.get("ply_file_path")
    studio = isinstance(points, str) or "camera_model" in data or "applied_transform" in data
    kind = "nerfstudio" if studio else "instant-ngp"
    if studio and notes:
        notes.append("nerfstudio itself tests a tenth of the photos, evenly: results are not comparable")
    if isinstance(points, str):
        xyz, rgb = read_point_ply(root / below(points, root))
        model = ColmapModel(model.cameras, model.images, points_without_tracks(xyz, rgb))
        notes.append(f"points from {points}, without the photos that see them")
    where: Literal["model", "triangulate"] = "model" if len(model.points.ids) else "triangulate"
    return ForeignScene(
        kind,
        root,
        model,
        folder,
        split,
        missing=missing,
        masks=masks,
        notes=tuple(notes),
        points=where,
    )


def _listed(data: Mapping[str, object], path: Path, root: Path, folder: Path) -> dict[Split, list[str]]:
    """Read nerfstudio's lists; without test photos, the validation photos are the test set."""
    lists: dict[str, list[str]] = {}
    prefix = "" if folder == root else folder.relative_to(root).as_posix() + "/"
    for side in ("train", "val", "test"):
        names = data.get(f"{side}_filenames", [])
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise AwError(f"{path}: {side}_filenames is no list of names")
        lists[side] = [below(n, root).removeprefix(prefix) for n in names]
    return {"train": lists["train"], "test": lists["test"] or lists["val"]}


def _masks(
    named: Mapping[str, Mapping[str, object]], split: Mapping[str, Split], root: Path
) -> dict[str, Path]:
    """Find nerfstudio's masks of the split's photos: black is ignored, so they are keep masks."""
    mask_files = {}
    for name, frame in named.items():
        mask = frame.get("mask_path")
        if isinstance(mask, str) and name in split:
            mask_files[name] = root / below(mask, root)
    absent = [str(p) for p in mask_files.values() if not p.is_file()]
    if absent:
        raise AwError(f"{len(absent)} masks of {root / 'transforms.json'} are absent: {shortlist(absent, 3)}")
    return mask_files


def read_blender(root: Path) -> ForeignScene:
    """Read NeRF's Blender scenes: transforms_train.json, transforms_test.json, RGBA photos over white."""
    rows, split = [], dict[str, Split]()
    for side in SIDES:
        path = root / f"transforms_{side}.json"
        if side == "test" and not path.is_file() and (root / "transforms_val.json").is_file():
            path = root / "transforms_val.json"
        data = read_object(path)
        for frame in frames_of(data, path):
            name = frame_name(frame, root)
            photo = find_photo(root, name)
            if photo is None:
                raise AwError(f"{path} names {name}, which is absent; copy all of the scene")
            name = photo.relative_to(root).as_posix()
            if name in split:
                raise AwError(f"{path} lists {name!r} twice, or it is in both files")
            rows.append((name, frame["transform_matrix"], frame_camera(frame, data, photo, path)))
            split[name] = side
    notes = ["photos with alpha are composited over white, which is drawn behind the model"]
    model, points = model_of_poses(rows), only_file(root, ".ply")
    scene = ForeignScene("blender", root, model, root, split, background=WHITE, points="random")
    if points is None:
        notes.append("initial points are random, as there is no model")
        return replace(scene, notes=tuple(notes))
    model = ColmapModel(model.cameras, model.images, points_without_tracks(*read_point_ply(points)))
    notes.append(f"points from {points.name}")
    return replace(scene, model=model, points="model", notes=tuple(notes))
