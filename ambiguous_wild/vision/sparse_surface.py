"""Depth of static surfaces from the sparse SfM points alone, before training.

Inverse depth is interpolated linearly between the points, which is exact on planes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from ambiguous_wild.core import Camera

BEHIND = 1.15  # a point deeper than this times the nearest static depth is behind the surface
PIXELS = 20_000  # most pixels of a map; results are enlarged to the photo's size
_CELLS = 32  # cells along a side; within a cell, points far behind the nearest one are occluded
_MIN_POINTS = 8
_FRAME_PIXELS = 1000  # pixels of a map that says how many cameras have a place in their frame
_MAX_POINTS = 4000  # a random subset; more points are slower and not better (see docs/metrics.md)


def subsample_points(xyz: np.ndarray) -> np.ndarray:
    """Return a fixed random subset of the points [M, 3], large enough for surfaces."""
    if len(xyz) <= _MAX_POINTS:
        return xyz
    return xyz[np.random.default_rng(0).permutation(len(xyz))[:_MAX_POINTS]]


def inverse_depth(camera: Camera, points: np.ndarray) -> np.ndarray | None:
    """Inverse depth 1/z of the static surface, [h, w] float32, from sparse points [M, 3]; NaN outside them.

    The map covers the camera's frame with at most about 20 000 pixels. None if the frame has too few points.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import QhullError

    h, w = map_size(camera)
    xyz = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    x, y = in_map(camera, xyz, (h, w))
    near = _around(x, y, (h, w))
    x, y, z = x[near], y[near], xyz[near, 2]
    front = _in_front(x / w, y / h, z)
    if front.sum() < _MIN_POINTS:
        return None
    try:
        surface = LinearNDInterpolator(np.column_stack([x, y])[front], 1.0 / z[front])
    except QhullError:  # all points on one line
        return None
    columns, rows = np.meshgrid(np.arange(w), np.arange(h))
    return surface(columns, rows).astype(np.float32)


def static_surfaces(cameras: Sequence[Camera], xyz: np.ndarray) -> list[np.ndarray | None]:
    """`inverse_depth` of every camera, from all sparse points [M, 3] of a scene."""
    some = subsample_points(xyz)
    return [inverse_depth(camera, some) for camera in cameras]


def rarely_covered(
    cameras: Sequence[Camera], surfaces: Sequence[np.ndarray | None], least: int
) -> list[np.ndarray | None]:
    """Find places that lie in the frame of fewer than `least` other cameras; occlusion is ignored.

    Outside the sparse points the nearest known depth is used, which is accurate enough for this.

    Args:
        cameras: the cameras of one scene.
        surfaces: the cameras' inverse depths [h, w], from `static_surfaces`.
        least: number of cameras, limited to the number of other cameras.

    Returns:
        bool maps of about 1000 pixels, spread evenly over each frame; None where a surface is None.
    """
    from scipy.ndimage import distance_transform_edt

    least = min(least, len(cameras) - 1)
    centres = np.stack([c.center for c in cameras])
    maps: list[np.ndarray | None] = []
    for view, surface in enumerate(surfaces):
        if surface is None or not np.isfinite(surface).any():
            maps.append(None)
            continue
        scale = min(1.0, math.sqrt(_FRAME_PIXELS / surface.size))
        size = (max(round(surface.shape[1] * scale), 1), max(round(surface.shape[0] * scale), 1))
        rows, columns = distance_transform_edt(
            ~np.isfinite(surface), return_distances=False, return_indices=True
        )
        inverse = cv2.resize(surface[rows, columns], size, interpolation=cv2.INTER_NEAREST)
        world = world_points(cameras[view], inverse).reshape(-1, 3)
        missing = np.full(len(world), least)  # cameras still to find
        # nearest cameras first: most places are decided after a few
        for other in np.argsort(np.linalg.norm(centres - centres[view], axis=1), kind="stable"):
            undecided = np.flatnonzero(missing > 0)
            if not len(undecided):
                break
            if other != view:
                missing[undecided[_in_frame(cameras[other], world[undecided])]] -= 1
        maps.append((missing > 0).reshape(size[::-1]))
    return maps


def _in_frame(camera: Camera, world: np.ndarray) -> np.ndarray:
    """Return which world points [N, 3] lie in the camera's frame, [N] bool."""
    local = world @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    x, y = in_map(camera, local, (camera.height, camera.width))
    return inside(x, y, (camera.height, camera.width))


def world_points(camera: Camera, inverse: np.ndarray) -> np.ndarray:
    """Compute the world points [h, w, 3] of an inverse depth map."""
    h, w = inverse.shape
    u = (np.arange(w) + 0.5) * (camera.width / w)
    v = (np.arange(h) + 0.5) * (camera.height / h)
    z = 1.0 / inverse.astype(np.float64)
    x, y = (u[None, :] - camera.cx) / camera.fx * z, (v[:, None] - camera.cy) / camera.fy * z
    world = np.linalg.inv(camera.cam_from_world)
    return np.stack([x, y, z], axis=-1) @ world[:3, :3].T + world[:3, 3]


def in_map(camera: Camera, local: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Project camera points to columns and rows of a map of the frame; pixel centres are whole numbers."""
    z = np.where(local[..., 2] > 1e-9, local[..., 2], np.nan)
    x = (local[..., 0] / z * camera.fx + camera.cx) * (shape[1] / camera.width) - 0.5
    y = (local[..., 1] / z * camera.fy + camera.cy) * (shape[0] / camera.height) - 0.5
    return x, y


def inside(x: np.ndarray, y: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return which positions from `in_map` lie inside the map, bool; NaN is outside."""
    return (x >= -0.5) & (x < shape[1] - 0.5) & (y >= -0.5) & (y < shape[0] - 0.5)


def _around(x: np.ndarray, y: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return which positions lie in the map or a little outside: these shape the surface at its border."""
    h, w = shape
    return (x > -0.25 * w) & (x < 1.25 * w) & (y > -0.25 * h) & (y < 1.25 * h)


def _in_front(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return which points no nearer surface occludes, [M] bool; x and y are shares of the frame."""
    column, row = ((np.floor(v * _CELLS).astype(np.intp) + _CELLS // 2) for v in (x, y))
    nearest = np.full((2 * _CELLS + 2, 2 * _CELLS + 2), np.inf)
    np.minimum.at(nearest, (row, column), z)
    return z <= BEHIND * nearest[row, column]


def map_size(camera: Camera) -> tuple[int, int]:
    """(h, w) of a map of the camera's frame."""
    scale = min(1.0, (PIXELS / (camera.width * camera.height)) ** 0.5)
    return max(round(camera.height * scale), 1), max(round(camera.width * scale), 1)
