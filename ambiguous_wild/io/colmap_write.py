"""Write a COLMAP model in its binary form: pinhole cameras, poses and points, without tracks."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ambiguous_wild.core import View
from ambiguous_wild.core.scene import Points

PINHOLE = 1  # COLMAP's number of the model with fx, fy, cx, cy


def write_model(folder: Path, views: Sequence[View], points: Points) -> None:
    """cameras.bin, images.bin and points3D.bin of these views, one camera each, at the views' size.

    Format: colmap/colmap, scripts/python/read_write_model.py; little endian.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cameras, images = [struct.pack("<Q", len(views))], [struct.pack("<Q", len(views))]
    for number, view in enumerate(views, start=1):
        c = view.camera
        cameras.append(struct.pack("<iiQQ4d", number, PINHOLE, c.width, c.height, c.fx, c.fy, c.cx, c.cy))
        x, y, z, w = Rotation.from_matrix(c.cam_from_world[:3, :3]).as_quat()
        pose = (w, x, y, z, *c.cam_from_world[:3, 3])
        images.append(struct.pack("<I7dI", number, *pose, number) + view.name.encode() + b"\0")
        images.append(struct.pack("<Q", 0))
    (folder / "cameras.bin").write_bytes(b"".join(cameras))
    (folder / "images.bin").write_bytes(b"".join(images))
    rows = np.zeros(
        len(points.xyz),
        dtype=[("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("tracks", "<u8")],
    )
    rows["id"], rows["xyz"], rows["rgb"] = np.arange(1, len(rows) + 1), points.xyz, points.rgb
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(rows)) + rows.tobytes())
