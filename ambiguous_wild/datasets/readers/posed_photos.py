"""Shared by readers of poses without a COLMAP model: photos by name, lenses, sides, points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.datasets.foreign import ForeignScene, inside, pose_from_opengl
from ambiguous_wild.datasets.photo_names import find_photo
from ambiguous_wild.datasets.readers.colmap import sides
from ambiguous_wild.io.colmap_model import check_camera
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera, ModelImage, points_without_tracks
from ambiguous_wild.io.photos import PHOTO_SUFFIXES
from ambiguous_wild.io.ply import read_point_ply

FIT_PX = 0.05  # largest error of the rational lens that replaces another lens
Row = tuple[str, Any, ModelCamera]  # photo; [3 or 4, 4] camera to world with OpenGL's axes; camera


@contextmanager
def tool_errors(tool: str, path: Path) -> Iterator[None]:
    """Turn errors on a file that lacks what the tool writes into an AwError."""
    try:
        yield
    except (LookupError, ValueError, TypeError, AttributeError, SyntaxError) as error:
        reason = f"{type(error).__name__}: {str(error)[:80]}"
        raise AwError(f"{path} is not as {tool} writes it ({reason}); export it again") from error


def only_file(root: Path, suffix: str, fits: Callable[[Path], bool] = lambda _: True) -> Path | None:
    """Return the folder's only file with this extension, in upper or lower case; None without one.

    Raises:
        AwError: there are several files.
    """
    files = (
        path
        for path in sorted(root.iterdir())
        if path.suffix.lower() == suffix and path.name[0] != "." and path.is_file()
    )
    fitting = [path for path in files if fits(path)]
    if len(fitting) > 1:
        names = shortlist([path.name for path in fitting])
        raise AwError(f"{root} has several files of poses or points: {names}; keep one")
    return fitting[0] if fitting else None


def find_posed(folder: Path, names: Sequence[str], where: Path) -> list[str]:
    """Find photos below `folder` by names without extension, or with folders of another computer.

    Raises:
        AwError: a photo is absent or named twice, or a name fits several photos.
    """
    below: dict[str, list[str]] = {}
    for path in sorted(
        p for p in folder.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES and p.name[:2] != "._"
    ):
        for key in {path.name, path.stem}:
            below.setdefault(key, []).append(path.relative_to(folder).as_posix())
    photos, lost = [], []
    for name in names:
        pure = PurePosixPath(name.replace("\\", "/") or "?")
        local = not (pure.is_absolute() or ":" in pure.parts[0] or ".." in pure.parts)
        exact = find_photo(folder, inside(str(pure), folder)) if local else None
        stem = pure.name if pure.suffix[1:].isdigit() else pure.stem  # frame.0001 has no extension
        fits = below.get(pure.name) or below.get(stem, [])
        fits = fits if exact is None else [exact.relative_to(folder).as_posix()]
        if len(fits) > 1:
            raise AwError(f"{where}: {name!r} fits {shortlist(fits, 3)}; give the photos unique names")
        photos += fits
        lost += [] if fits else [name]
    if lost:
        problem = f"{len(lost)} of {len(names)} photos of {where} are not in {folder}: {shortlist(lost, 3)}"
        raise AwError(f"{problem}; copy all of them there")
    if twice := [name for name, times in Counter(photos).items() if times > 1]:
        raise AwError(f"{where} states a photo twice: {shortlist(twice, 3)}; keep one pose of it")
    return photos


def numbers(values: object) -> np.ndarray:
    """Return nested lists of numbers as float64; TypeError for texts, which NumPy would convert."""
    return np.array(values).astype(np.float64, casting="same_kind")


def brown_camera(
    size: tuple[int, int],
    pinhole: Sequence[float],  # fx, fy, cx, cy in px
    radial: Sequence[float],  # of r^2, r^4, r^6, r^8
    tangential: Sequence[float],  # p1, p2 in OpenCV's order
    where: str,
    shear: float = 0.0,
) -> ModelCamera:
    """Return a camera of COLMAP with Brown's lens; a lens with r^8 becomes a rational one within `FIT_PX`.

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
            problem = f"{where}: the lens {list(radial)} folds inside the photo"
            raise AwError(f"{problem}; export undistorted photos")
        k /= corner ** np.array([2, 4, 6] * 2)
        more = [*map(float, k[:2]), *tangential, *map(float, k[2:])]
    return ModelCamera(1, model, *size, (*pinhole, *more), shear)


def model_of_poses(rows: Iterable[Row]) -> ColmapModel:
    """Make a model without points; equal cameras become one.

    Raises:
        AwError: an impossible camera, or a pose that is no rigid motion.
    """
    cameras: dict[tuple[Any, ...], ModelCamera] = {}
    images: dict[int, ModelImage] = {}
    for number, (name, matrix, camera) in enumerate(sorted(rows, key=lambda row: row[0]), start=1):
        key = (camera.model, camera.width, camera.height, camera.params, camera.shear)
        check_camera(Path(name), camera)
        camera_of_photo = cameras.setdefault(key, ModelCamera(len(cameras) + 1, *key))
        try:
            pose = pose_from_opengl(numbers(matrix))
        except (ValueError, TypeError) as error:
            raise AwError(f"{name}: its transform_matrix is not [4, 4] numbers") from error
        except AwError as error:
            raise AwError(f"{name}: {error}") from None
        q = Rotation.from_matrix(pose[:3, :3]).as_quat(canonical=True)[[3, 0, 1, 2]]  # w, x, y, z
        none = np.zeros((0, 2)), np.zeros(0, np.int64)
        images[number] = ModelImage(number, q, pose[:3, 3], camera_of_photo.camera_id, name, *none)
    return ColmapModel({c.camera_id: c for c in cameras.values()}, images, points_without_tracks())


def posed_scene(
    kind: str, root: Path, photos: Path, rows: Sequence[Row], notes: Sequence[str] = (), points: bool = True
) -> ForeignScene:
    """Make a scene of photos below a folder; `points`: a PLY in `root` has the coordinates of the poses."""
    model = model_of_poses(rows)
    split, missing, more = sides(sorted(name for name, _, _ in rows), root)
    cloud = only_file(root, ".ply") if points else None
    if cloud is None:
        return ForeignScene(
            kind, root, model, photos, split, missing=missing, notes=(*notes, *more), points="triangulate"
        )
    model = ColmapModel(model.cameras, model.images, points_without_tracks(*read_point_ply(cloud)))
    more.append(f"points from {cloud.name}, without the photos that see them")
    return ForeignScene(kind, root, model, photos, split, missing=missing, notes=(*notes, *more))
