"""Read ARKit poses that phone apps export: Polycam's keyframes and Record3D's metadata.

Both state camera to world with OpenGL's axes. Sources: PolyCam/polyform, and Record3D's author in
marek-simonik/record3d, issues 27, 33 and 83. NeRFCapture writes a transforms.json instead.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.datasets.foreign import ForeignScene
from ambiguous_wild.datasets.readers.posed_photos import find_posed, numbers, posed_scene, tool_errors
from ambiguous_wild.datasets.readers.transforms import frame_camera, read_object

LENS = ("fl_x", "fl_y", "cx", "cy", "w", "h")


def read_polycam(root: Path) -> ForeignScene:
    """Read keyframes/ of Polycam's raw data: corrected cameras and images if present, else ARKit's."""
    base, notes = root / "keyframes", []
    cameras, photos = base / "corrected_cameras", base / "corrected_images"
    if not (any(cameras.glob("*.json")) and photos.is_dir()):
        cameras, photos = base / "cameras", base / "images"
        notes.append("no corrected_cameras: the poses are those of ARKit while recording")
    files = sorted(cameras.glob("*.json"))
    if not files:
        raise AwError(f"{cameras} holds no cameras: export raw data from Polycam, in its developer mode")
    rows = []
    for path, name in zip(files, find_posed(photos, [f.stem for f in files], cameras)):
        data = read_object(path)
        with tool_errors("Polycam", path):
            pose = [[data[f"t_{i}{j}"] for j in range(4)] for i in range(3)]
            lens = {k: data[v] for k, v in zip(LENS, ("fx", "fy", "cx", "cy", "width", "height"))}
        rows.append((name, pose, frame_camera(lens, {}, photos / name, path)))
    return posed_scene("polycam", root, photos, rows, notes, points=False)


def find_metadata(root: Path) -> Path | None:
    """Find Record3D's metadata in an exported folder or an unpacked .r3d; None without it."""
    for path in (root / "metadata.json", root / "metadata"):
        with suppress(AwError):
            if {"poses", "K"} <= set(read_object(path)):
                return path
    return None


def read_record3d(root: Path) -> ForeignScene:
    """Read metadata.json or metadata, and the numbered photos of rgb/ or rgbd/."""
    path = find_metadata(root)
    if path is None:
        raise AwError(f"{root} has no metadata.json of Record3D, with poses and K")
    data = read_object(path)
    with tool_errors("Record3D", path):
        poses = numbers(data["poses"]).reshape(-1, 7)  # quaternion (x, y, z, w), position
        turns = Rotation.from_quat(poses[:, :4]).as_matrix()
        k = numbers(data["K"]).reshape(9)[[0, 4, 6, 7]]  # column by column
        lenses = numbers(data.get("perFrameIntrinsicCoeffs") or [k] * len(poses))
        lenses = lenses.reshape(len(poses), 4)  # fx, fy, cx, cy
        sized = [dict(zip(LENS, (*map(float, lens), data["w"], data["h"]))) for lens in lenses]
    photos = next((root / n for n in ("rgb", "rgbd") if (root / n).is_dir()), root)
    rows = []
    for i, name in enumerate(find_posed(photos, [str(i) for i in range(len(poses))], path)):
        pose = np.column_stack([turns[i], poses[i, 4:]])
        rows.append((name, pose, frame_camera(sized[i], {}, photos / name, path)))
    return posed_scene("record3d", root, photos, rows, points=False)
