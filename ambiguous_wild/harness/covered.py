"""Which pixels of a clean test view show what distractors hid from the train views.

A pixel of a test view is *covered* where its static surface was behind a distractor in at least half of
the train views that look at it, and *uncovered* otherwise. It is a fact of the scene, not of a method's
render, so that every method is measured on the same pixels: surfaces come from the sparse points (inverse
depth, linear between them: exact on planes), distractors from the exact masks. A train view looks at a
surface that lies in its frame and not behind another static one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError

from ambiguous_wild.core import Camera, Scene, View

COVERED_FROM = 0.5  # share of the train views that look at it
_PIXELS = 20_000  # of the maps that are computed; the result is brought to the photo's size
_BEHIND = 1.15  # times the depth of the nearest static surface: behind it
_CELLS = 32  # a side; of points in one cell or the next, those behind are seen through something
_LEAST_POINTS = 8
_MOST_POINTS = 4000  # drawn at random; more are slow and tell no more (see docs/metrics.md)

DistractorMask = Callable[[View], np.ndarray | None]  # [H, W] bool, True on distractors


def covered_pixels(scene: Scene, distractor: DistractorMask) -> dict[str, np.ndarray] | str:
    """Name of a test view -> [H, W] bool, True where covered; or why that cannot be told.

    Args:
        scene: its sparse points say where surfaces are.
        distractor: the exact mask of a train view, None where there is none.
    """
    masks = [distractor(view) for view in scene.train]
    known = [(view, mask) for view, mask in zip(scene.train, masks) if mask is not None]
    xyz = scene.points.xyz
    if len(xyz) > _MOST_POINTS:
        xyz = xyz[np.random.default_rng(0).permutation(len(xyz))[:_MOST_POINTS]]
    if not known:
        return "no exact masks of the train photos (truth/distractor)"
    if not any(mask.any() for _, mask in known):
        return "no train photo shows a distractor"
    cameras = [view.camera for view, _ in known]
    depths = [inverse_depth(camera, xyz) for camera in cameras]
    shares = {}
    for view in scene.test:
        share = _share(view.camera, xyz, cameras, depths, [mask for _, mask in known])
        if share is None:
            return f"too few sparse points lie in test view {view.name}"
        size = (view.camera.width, view.camera.height)
        shares[view.name] = cv2.resize(share, size, interpolation=cv2.INTER_LINEAR) >= COVERED_FROM
    return shares


def inverse_depth(camera: Camera, points: np.ndarray) -> np.ndarray | None:
    """1/z of the static surface, [h, w] float32, from sparse points [M, 3]; NaN outside them.

    The map covers the camera's frame with some 20 000 pixels or fewer. None: too few points in the frame.
    """
    h, w = _map_size(camera)
    xyz = points @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    xyz = xyz[xyz[:, 2] > 0]
    x, y = _in_map(camera, xyz, (h, w))
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


def _share(
    camera: Camera,
    points: np.ndarray,
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray | None],
    masks: Sequence[np.ndarray],
) -> np.ndarray | None:
    """Share of the train views that look at a pixel's surface and show a distractor, [h, w] float32.

    0 where no view looks at it, or the surface is not known.
    """
    inverse = inverse_depth(camera, points)
    if inverse is None:
        return None
    world = world_points(camera, inverse)
    looking = np.zeros(inverse.shape, np.float32)
    hidden = np.zeros(inverse.shape, np.float32)
    for other, depth, mask in zip(cameras, depths, masks):
        sees, distracted = _seen(world, other, depth, mask)
        looking += sees
        hidden += sees & distracted
    return hidden / np.maximum(looking, 1.0)


def _seen(
    world: np.ndarray,  # [h, w, 3], NaN where not known
    camera: Camera,
    depth: np.ndarray | None,  # inverse, of the camera's static surface
    mask: np.ndarray,  # [H, W] bool, distractors
) -> tuple[np.ndarray, np.ndarray]:
    """Where the camera looks at a surface, and where it shows a distractor instead, bool [h, w]."""
    local = world @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    z = local[..., 2]
    ahead = z > 1e-9
    sees = ahead.copy()
    if depth is not None:
        x, y = _in_map(camera, local, depth.shape)
        nearest = _look_up(depth, x, y, ahead)
        sees &= ~(nearest * z > _BEHIND)  # NaN: nothing is known to stand before it
    x, y = _in_map(camera, local, mask.shape)
    inside = (x >= -0.5) & (x < mask.shape[1] - 0.5) & (y >= -0.5) & (y < mask.shape[0] - 0.5)
    return sees & inside, _look_up(mask.astype(np.uint8), x, y, ahead & inside) > 0


def world_points(camera: Camera, inverse: np.ndarray) -> np.ndarray:
    """World points [h, w, 3] of an inverse depth map."""
    h, w = inverse.shape
    u = (np.arange(w) + 0.5) * (camera.width / w)
    v = (np.arange(h) + 0.5) * (camera.height / h)
    z = 1.0 / inverse.astype(np.float64)
    x, y = (u[None, :] - camera.cx) / camera.fx * z, (v[:, None] - camera.cy) / camera.fy * z
    world = np.linalg.inv(camera.cam_from_world)
    return np.stack([x, y, z], axis=-1) @ world[:3, :3].T + world[:3, 3]


def _in_map(camera: Camera, local: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows, whole numbers at pixel centres, of camera points in a map of the camera's frame."""
    z = np.where(local[..., 2] > 1e-9, local[..., 2], np.nan)
    x = (local[..., 0] / z * camera.fx + camera.cx) * (shape[1] / camera.width) - 0.5
    y = (local[..., 1] / z * camera.fy + camera.cy) * (shape[0] / camera.height) - 0.5
    return x, y


def _look_up(picture: np.ndarray, x: np.ndarray, y: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The nearest pixel of a map at columns x and rows y, clamped; its first pixel where not `where`."""
    column = np.where(where, np.clip(np.rint(x), 0, picture.shape[1] - 1), 0).astype(np.intp)
    row = np.where(where, np.clip(np.rint(y), 0, picture.shape[0] - 1), 0).astype(np.intp)
    return picture[row, column]


def _in_front(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Which points are not seen through a nearer surface, [M] bool; x and y are shares of the frame."""
    column, row = ((np.floor(v * _CELLS).astype(np.intp) + _CELLS // 2) for v in (x, y))
    nearest = np.full((2 * _CELLS + 2, 2 * _CELLS + 2), np.inf)
    np.minimum.at(nearest, (row, column), z)
    return z <= _BEHIND * nearest[row, column]


def _map_size(camera: Camera) -> tuple[int, int]:
    scale = min(1.0, (_PIXELS / (camera.width * camera.height)) ** 0.5)
    return max(round(camera.height * scale), 1), max(round(camera.width * scale), 1)
