"""What readers of poses without a COLMAP model share: photos by name, lenses, sides, points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.datasets.foreign import (
    SUFFIXES,
    ForeignScene,
    find_photo,
    inside,
    pose_from_opengl,
    quaternion_from_rotation,
)
from ambiguous_wild.datasets.readers.colmap import sides
from ambiguous_wild.io.colmap_model import check_camera
from ambiguous_wild.io.colmap_records import Model, ModelCamera, ModelImage, points_without_tracks
from ambiguous_wild.io.ply import read_point_ply

FIT_PX = 0.05  # between a lens and the rational one that stands for it
Row = tuple[str, Any, ModelCamera]  # photo; [3 or 4, 4] camera to world with OpenGL's axes; camera


@contextmanager
def written_by(tool: str, path: Path) -> Iterator[None]:
    """A file that lacks what the tool writes is the user's error, in one line."""
    try:
        yield
    except (LookupError, ValueError, TypeError, AttributeError, SyntaxError) as error:
        told = f"{type(error).__name__}: {str(error)[:80]}"
        raise AwError(f"{path} is not as {tool} writes it ({told}); export it again") from error


def the_one(root: Path, suffix: str, fits: Callable[[Path], bool] = lambda _: True) -> Path | None:
    """The folder's file with this extension, in any case.

    Raises:
        AwError: there are several.
    """
    files = (path for path in sorted(root.iterdir()) if path.suffix.lower() == suffix and path.is_file())
    found = [path for path in files if fits(path)]
    if len(found) > 1:
        told = shortlist([path.name for path in found])
        raise AwError(f"{root} has several files of poses or points: {told}; keep one")
    return found[0] if found else None


def find_posed(folder: Path, names: Sequence[str], where: Path) -> list[str]:
    """Photos below `folder` that another tool names without extension, or with folders of another computer.

    Raises:
        AwError: a photo is absent, or there twice, or a name fits several.
    """
    below: dict[str, list[str]] = {}
    for path in sorted(p for p in folder.rglob("*") if p.suffix in SUFFIXES and p.name[:2] != "._"):
        for key in {path.name, path.stem}:
            below.setdefault(key, []).append(path.relative_to(folder).as_posix())
    found, lost = [], []
    for name in names:
        pure = PurePosixPath(name.replace("\\", "/") or "?")
        local = not (pure.is_absolute() or ":" in pure.parts[0] or ".." in pure.parts)
        exact = find_photo(folder, inside(str(pure), folder)) if local else None
        stem = pure.name if pure.suffix[1:].isdigit() else pure.stem  # frame.0001 has no extension
        fits = below.get(pure.name) or below.get(stem, [])
        fits = fits if exact is None else [exact.relative_to(folder).as_posix()]
        if len(fits) > 1:
            raise AwError(f"{where}: {name!r} fits {shortlist(fits, 3)}; give the photos unique names")
        found += fits
        lost += [] if fits else [name]
    if lost:
        told = f"{len(lost)} of {len(names)} photos of {where} are not in {folder}: {shortlist(lost, 3)}"
        raise AwError(f"{told}; copy all of them there")
    if twice := [name for name, times in Counter(found).items() if times > 1]:
        raise AwError(f"{where} states a photo twice: {shortlist(twice, 3)}; keep one pose of it")
    return found


def brown_camera(
    size: tuple[int, int],
    pinhole: Sequence[float],  # fx, fy, cx, cy in px
    radial: Sequence[float],  # of r^2, r^4, r^6, r^8
    tangential: Sequence[float],  # p1, p2 in OpenCV's order
    where: str,
    shear: float = 0.0,
) -> ModelCamera:
    """The camera with Brown's lens, as COLMAP states it; with r^8 a rational one that is equal to `FIT_PX`.

    Raises:
        AwError: an impossible camera, or a lens that folds inside the photo.
    """
    check_camera(Path(where), ModelCamera(1, "OPENCV", *size, (*pinhole, *radial, *tangential, shear)))
    lens = [*radial[:2], *tangential]
    model, more = ("OPENCV", lens) if any((*lens, shear)) else ("PINHOLE", [])
    if radial[2] or radial[3]:
        model, more = "FULL_OPENCV", [*lens, radial[2], 0.0, 0.0, 0.0]
    if radial[3]:
        fx, fy, cx, cy = pinhole
        corner = np.hypot(max(cx, size[0] - cx) / fx, max(cy, size[1] - cy) / fy)
        r = np.linspace(0, 4 * corner, 4001)
        gain = np.polyval([*radial[::-1], 1], r**2)
        end = int(np.argmax(r * gain >= corner)) + 1  # where the lens reaches the photo's corner
        r, gain = r[:end], gain[:end]
        powers = (r[:, None] / corner) ** [2, 4, 6]
        k = np.linalg.lstsq(np.hstack([powers, -gain[:, None] * powers]), gain - 1, rcond=None)[0]
        error = np.abs((1 + powers @ k[:3]) / (1 + powers @ k[3:]) - gain) * r * max(fx, fy)
        if end == 1 or not error.max() < FIT_PX:
            told = f"{where}: the lens {list(radial)} folds inside the photo"
            raise AwError(f"{told}; export undistorted photos")
        k /= corner ** np.array([2, 4, 6] * 2)
        more = [*map(float, k[:2]), *tangential, *map(float, k[2:])]
    return ModelCamera(1, model, *size, (*pinhole, *more), shear)


def model_of_poses(rows: Iterable[Row]) -> Model:
    """A model without points; equal cameras are one.

    Raises:
        AwError: an impossible camera, or a pose that is no rigid motion.
    """
    cameras: dict[tuple[Any, ...], ModelCamera] = {}
    images: dict[int, ModelImage] = {}
    for number, (name, matrix, camera) in enumerate(sorted(rows, key=lambda row: row[0]), start=1):
        key = (camera.model, camera.width, camera.height, camera.params, camera.shear)
        check_camera(Path(name), camera)
        known = cameras.setdefault(key, ModelCamera(len(cameras) + 1, *key))
        try:
            pose = pose_from_opengl(np.array(matrix, dtype=np.float64))
        except (ValueError, TypeError) as error:
            raise AwError(f"{name}: its transform_matrix is not [4, 4] numbers") from error
        except AwError as error:
            raise AwError(f"{name}: {error}") from None
        q = quaternion_from_rotation(pose[:3, :3])
        none = np.zeros((0, 2)), np.zeros(0, np.int64)
        images[number] = ModelImage(number, q, pose[:3, 3], known.camera_id, name, *none)
    return Model({c.camera_id: c for c in cameras.values()}, images, points_without_tracks())


def posed_scene(
    kind: str, root: Path, photos: Path, rows: Sequence[Row], notes: Sequence[str] = (), points: bool = True
) -> ForeignScene:
    """The scene of photos below a folder; `points`: a PLY of `root` has the poses' coordinates."""
    model = model_of_poses(rows)
    split, missing, said = sides(sorted(name for name, _, _ in rows), root)
    cloud = the_one(root, ".ply") if points else None
    if cloud is None:
        return ForeignScene(
            kind, root, model, photos, split, missing=missing, notes=(*notes, *said), points="triangulate"
        )
    model = Model(model.cameras, model.images, points_without_tracks(*read_point_ply(cloud)))
    said.append(f"points from {cloud.name}, without the photos that see them")
    return ForeignScene(kind, root, model, photos, split, missing=missing, notes=(*notes, *said))
