"""Read the CSV "Internal/External camera parameters" of RealityScan and RealityCapture.

Camera to world is Rz(-heading) Rx(pitch) Ry(roll) with OpenGL's axes; f is in mm of a longer side of 36 mm,
px and py are in longer sides from the middle; t1 and t2 are OpenCV's p2 and p1. Sources: the templates of
the program's calibration.xml, "RealityCapture XMP Camera Math" of its support, nerfstudio's converter.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ambiguous_wild.core.camera import rigid
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.datasets.foreign import ForeignScene
from ambiguous_wild.datasets.readers import posed_photos
from ambiguous_wild.io.colmap_records import ModelCamera
from ambiguous_wild.io.images import header_size, pillow
from ambiguous_wild.io.untrusted import read_text

NAMES = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}  # other names in RealityScan 2.2
POSE = ("x", "y", "alt", "heading", "pitch", "roll")
LENS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")  # the template may leave them out
ORIENTATION = 274  # tag of EXIF


def find_table(root: Path) -> Path | None:
    """Find the folder's CSV with a pose and a focal length for each photo; None without one."""
    return posed_photos.only_file(root, ".csv", lambda path: bool(_table(path)))


def _table(path: Path) -> list[list[str]]:
    """Read header and rows; empty if it is another table."""
    try:
        text = read_text(path).splitlines()
        head = " ".join(text[:2])
        separator = max(",;\t", key=head.count)  # a spreadsheet saves others, with decimal commas
        lines = [[v.strip() for v in line] for line in csv.reader(text, delimiter=separator)]
    except (AwError, csv.Error):
        return []
    lines = [line for line in lines if any(line)]
    lines = lines[1:] if lines and lines[0][0].startswith("#cameras") else lines
    columns = [v.removeprefix("#").casefold() for v in lines[0]] if lines else []
    columns = [NAMES.get(column, column) for column in columns]
    return [columns, *lines[1:]] if {"name", "f", *POSE} <= set(columns) else []


def read_realityscan(root: Path) -> ForeignScene:
    """Read poses and lenses of the CSV, and the point cloud of a PLY beside it in the same coordinates."""
    tables: dict[Path, list[list[str]]] = {}  # each is read once
    path = posed_photos.only_file(root, ".csv", lambda path: bool(tables.setdefault(path, _table(path))))
    if path is None:
        raise AwError(f"{root} has no CSV of RealityScan's export 'Internal/External camera parameters'")
    columns, *lines = tables[path]
    with posed_photos.tool_errors("RealityScan", path):
        stated = [dict(zip(columns, line, strict=True)) for line in lines]
        numbers = [
            {key: float(row[key].replace(",", ".")) for key in (*POSE, "f", *LENS) if key in row}
            for row in stated
        ]
    photos = root / "images" if (root / "images").is_dir() else root
    rows = []
    for name, row in zip(posed_photos.find_posed(photos, [row["name"] for row in stated], path), numbers):
        angles = [-row["heading"], row["pitch"], row["roll"]]
        rotation = Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
        pose = rigid(rotation, np.array([row["x"], row["y"], row["alt"]]))
        rows.append((name, pose, _camera(row, photos / name, path)))
    notes = [] if "k1" in columns else [f"{path.name} states no lens: the photos are taken as undistorted"]
    return posed_photos.posed_scene("realityscan", root, photos, rows, notes)


def _camera(row: dict[str, float], photo: Path, path: Path) -> ModelCamera:
    """Return the camera at the size of its photo, which the CSV does not state."""
    size = header_size(photo)
    if size is None:
        raise AwError(f"{photo} is no image; copy it again")
    with pillow().open(photo) as image:
        turned = image.getexif().get(ORIENTATION, 1) != 1
    if turned:
        fault = f"{photo} is turned by its EXIF, and {path.name} does not say whether its pose is"
        raise AwError(f"{fault}: export undistorted photos, or COLMAP")
    px, py, k1, k2, k3, k4, t1, t2 = (row.get(key, 0.0) for key in LENS)
    if k1 and not any((k2, k3, k4, t1, t2)):
        fault = f"{path}: {photo.name} has only k1, as of the lens 'division', which the file does not name"
        raise AwError(f"{fault}: export with a Brown lens, or undistorted photos")
    longer = max(size)
    f, cx, cy = row["f"] * longer / 36, px * longer + size[0] / 2, py * longer + size[1] / 2
    return posed_photos.brown_camera(size, (f, f, cx, cy), (k1, k2, k3, k4), (t2, t1), str(path))
