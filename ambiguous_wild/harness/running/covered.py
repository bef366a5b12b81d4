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

from ambiguous_wild.core import Camera, Scene, View
from ambiguous_wild.vision.sparse_surface import (
    BEHIND,
    in_map,
    inside,
    inverse_depth,
    some_points,
    world_points,
)

COVERED_FROM = 0.5  # share of the train views that look at it

DistractorMask = Callable[[View], np.ndarray | None]  # [H, W] bool, True on distractors


def covered_pixels(scene: Scene, distractor: DistractorMask) -> dict[str, np.ndarray] | str:
    """Name of a test view -> [H, W] bool, True where covered; or why that cannot be told.

    Args:
        scene: its sparse points say where surfaces are.
        distractor: the exact mask of a train view, None where there is none.
    """
    masks = [distractor(view) for view in scene.train]
    known = [(view, mask) for view, mask in zip(scene.train, masks) if mask is not None]
    xyz = some_points(scene.points.xyz)
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
        x, y = in_map(camera, local, depth.shape)
        nearest = _look_up(depth, x, y, ahead)
        sees &= ~(nearest * z > BEHIND)  # NaN: nothing is known to stand before it
    x, y = in_map(camera, local, mask.shape)
    held = inside(x, y, mask.shape)
    return sees & held, _look_up(mask.astype(np.uint8), x, y, ahead & held) > 0


def _look_up(picture: np.ndarray, x: np.ndarray, y: np.ndarray, where: np.ndarray) -> np.ndarray:
    """The nearest pixel of a map at columns x and rows y, clamped; its first pixel where not `where`."""
    column = np.where(where, np.clip(np.rint(x), 0, picture.shape[1] - 1), 0).astype(np.intp)
    row = np.where(where, np.clip(np.rint(y), 0, picture.shape[0] - 1), 0).astype(np.intp)
    return picture[row, column]
