"""Static surfaces from the sparse points alone: what lies behind a pixel before anything was trained.

Inverse depth is linear between the points, which is exact on planes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.ndimage import distance_transform_edt
from scipy.spatial import QhullError

from ambiguous_wild.core import Camera

BEHIND = 1.15  # times the depth of the nearest static surface: behind it
_PIXELS = 20_000  # of a map at most; what is computed on it is brought to the photo's size
_CELLS = 32  # a side; of points in one cell or the next, those behind are seen through something
_LEAST_POINTS = 8
_FRAME_PIXELS = 1000  # of a map that counts who else has a place in the frame
_MOST_POINTS = 4000  # drawn at random; more are slow and tell no more (see docs/metrics.md)


def some_points(xyz: np.ndarray) -> np.ndarray:
    """As many of the points [M, 3] as surfaces need, the same every time."""
    if len(xyz) <= _MOST_POINTS:
        return xyz
    return xyz[np.random.default_rng(0).permutation(len(xyz))[:_MOST_POINTS]]


def inverse_depth(camera: Camera, points: np.ndarray) -> np.ndarray | None:
    """1/z of the static surface, [h, w] float32, from sparse points [M, 3]; NaN outside them.

    The map covers the camera's frame with some 20 000 pixels or fewer. None: too few points in the frame.
    """
    h, w = _map_size(camera)
    xyz = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    xyz = xyz[xyz[:, 2] > 0]
    x, y = in_map(camera, xyz, (h, w))
    # What lies a little outside the frame says how the surface goes on at its border.
    near = (x > -0.25 * w) & (x < 1.25 * w) & (y > -0.25 * h) & (y < 1.25 * h)
    x, y, z = x[near], y[near], xyz[near, 2]
    front = _in_front(x / w, y / h, z)
    if front.sum() < _LEAST_POINTS:
        return None
    try:
        surface = LinearNDInterpolator(np.column_stack([x, y])[front], 1.0 / z[front])
    except QhullError:  # all on one line
        return None
    columns, rows = np.meshgrid(np.arange(w), np.arange(h))
    return surface(columns, rows).astype(np.float32)


def static_surfaces(cameras: Sequence[Camera], xyz: np.ndarray) -> list[np.ndarray | None]:
    """`inverse_depth` of every camera, from all sparse points [M, 3] of a scene."""
    some = some_points(xyz)
    return [inverse_depth(camera, some) for camera in cameras]


def in_frames(cameras: Sequence[Camera], surfaces: Sequence[np.ndarray | None]) -> list[np.ndarray | None]:
    """How many of the other cameras have a place in their frame, whatever stands before it.

    Outside the sparse points the nearest known depth holds: it is good enough to say who looks that way.

    Args:
        cameras: of one scene.
        surfaces: their inverse depths [h, w], from `static_surfaces`.

    Returns:
        int32 maps of some 1000 pixels of each frame; None where a surface is.
    """
    poses = np.stack([c.cam_from_world for c in cameras])
    focal, centre = (np.array(v) for v in zip(*(((c.fx, c.fy), (c.cx, c.cy)) for c in cameras), strict=True))
    size = np.array([(c.width, c.height) for c in cameras])
    counts: list[np.ndarray | None] = []
    for view, surface in enumerate(surfaces):
        if surface is None or not np.isfinite(surface).any():
            counts.append(None)
            continue
        unknown = ~np.isfinite(surface)
        rows, columns = distance_transform_edt(unknown, return_distances=False, return_indices=True)
        step = max(1, math.ceil(math.sqrt(surface.size / _FRAME_PIXELS)))
        world = world_points(cameras[view], surface[rows, columns])[step // 2 :: step, step // 2 :: step]
        found = np.zeros(world.shape[:2], np.int32)
        for other, pose in enumerate(poses):
            if other == view:
                continue
            local = world @ pose[:3, :3].T + pose[:3, 3]
            z = local[..., 2]
            uv = local[..., :2] / np.where(z > 0, z, np.nan)[..., None] * focal[other] + centre[other]
            found += ((uv >= 0) & (uv < size[other])).all(axis=2)
        counts.append(found)
    return counts


def world_points(camera: Camera, inverse: np.ndarray) -> np.ndarray:
    """World points [h, w, 3] of an inverse depth map."""
    h, w = inverse.shape
    u = (np.arange(w) + 0.5) * (camera.width / w)
    v = (np.arange(h) + 0.5) * (camera.height / h)
    z = 1.0 / inverse.astype(np.float64)
    x, y = (u[None, :] - camera.cx) / camera.fx * z, (v[:, None] - camera.cy) / camera.fy * z
    world = np.linalg.inv(camera.cam_from_world)
    return np.stack([x, y, z], axis=-1) @ world[:3, :3].T + world[:3, 3]


def in_map(camera: Camera, local: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows, whole numbers at pixel centres, of camera points in a map of the camera's frame."""
    z = np.where(local[..., 2] > 1e-9, local[..., 2], np.nan)
    x = (local[..., 0] / z * camera.fx + camera.cx) * (shape[1] / camera.width) - 0.5
    y = (local[..., 1] / z * camera.fy + camera.cy) * (shape[0] / camera.height) - 0.5
    return x, y


def _in_front(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Which points are not seen through a nearer surface, [M] bool; x and y are shares of the frame."""
    column, row = ((np.floor(v * _CELLS).astype(np.intp) + _CELLS // 2) for v in (x, y))
    nearest = np.full((2 * _CELLS + 2, 2 * _CELLS + 2), np.inf)
    np.minimum.at(nearest, (row, column), z)
    return z <= BEHIND * nearest[row, column]


def _map_size(camera: Camera) -> tuple[int, int]:
    scale = min(1.0, (_PIXELS / (camera.width * camera.height)) ** 0.5)
    return max(round(camera.height * scale), 1), max(round(camera.width * scale), 1)
