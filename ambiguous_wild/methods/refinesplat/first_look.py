"""A first look before any training: what no other photo shows at the same surface was only passing by.

Masks need a render, and the first renders show whatever stands before most cameras: 45 % of every photo
behind a crowd is learnt before the first mask is made, and some of it stays. The sparse points know better:
they lie on what several photos saw in one place. So the surface behind every pixel is taken from them
(`vision/sparse_surface.py`) and looked up in the other photos, and a pixel counts in the first iterations
only if enough of them show its colour there. Depth is off by a pixel or two, so a colour may lie anywhere
between the least and the greatest around the place. What no sparse points surround counts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.refinesplat.multiview import common_offset, nearest_views, quantile_of
from ambiguous_wild.vision.sparse_surface import BEHIND, in_map, inverse_depth, some_points, world_points

_WINDOW = np.ones((3, 3), np.uint8)  # px of the map around the place where a colour may lie


@dataclass(frozen=True)
class FirstLookConfig:
    """Whom to ask, and what difference of colour is too much."""

    on: bool = True
    views: int = 16  # nearest train views asked
    quantile: float = 0.3  # of their differences: this share must show the colour
    threshold: float = 0.02  # difference of colour in [0, 1] above which a pixel waits
    normal: float = 3.0  # and above this many times what is normal in the photo
    known_by: int = 3  # seen by fewer others, a surface is not judged
    least: float = 0.1  # of a photo: where less would wait, nothing does; a start can bear that much

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat.first_look",
            views=(1, math.inf), quantile=(0, 1), threshold=(0, math.inf), normal=(0, math.inf),
            known_by=(1, math.inf), least=(0, 1),
        )  # fmt: skip


def first_keep(
    cameras: Sequence[Camera], photos: Sequence[np.ndarray], points: np.ndarray, config: FirstLookConfig
) -> list[np.ndarray | None]:
    """What to learn from at first, per photo [H, W] bool; None where everything counts.

    Args:
        cameras: of the photos.
        photos: [H, W, 3] in [0, 1].
        points: sparse points [M, 3], world units.
        config: how to judge.
    """
    some = some_points(points)
    surfaces = [inverse_depth(camera, some) for camera in cameras]
    small = [
        None if inverse is None else _small(photo, inverse.shape)
        for photo, inverse in zip(photos, surfaces, strict=True)
    ]
    ranges = [None if s is None else (cv2.erode(s, _WINDOW), cv2.dilate(s, _WINDOW)) for s in small]
    keeps: list[np.ndarray | None] = []
    for view, others in enumerate(nearest_views(cameras, config.views)):
        inverse, ours = surfaces[view], small[view]
        if inverse is None or ours is None:
            keeps.append(None)
            continue
        world = world_points(cameras[view], inverse)
        told = [
            _difference(ours, world, cameras[j], surface, limits)
            for j in others
            if (surface := surfaces[j]) is not None and (limits := ranges[j]) is not None
        ]
        keeps.append(_judge(told, photos[view].shape[:2], config))
    return keeps


def _small(photo: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    blurred = cv2.blur(np.ascontiguousarray(photo, dtype=np.float32), (3, 3))
    return cv2.resize(blurred, (shape[1], shape[0]), interpolation=cv2.INTER_AREA)


def _difference(
    ours: np.ndarray,  # [h, w, 3] float32
    world: np.ndarray,  # [h, w, 3], NaN where not known
    camera: Camera,
    surface: np.ndarray,  # inverse depth of the other view
    limits: tuple[np.ndarray, np.ndarray],  # least and greatest colours around each of its pixels
) -> np.ndarray:
    """How far our colours lie outside of what the other view shows there, [h, w]; NaN where it cannot see."""
    local = world @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    x, y = in_map(camera, local, surface.shape)
    z = local[..., 2]
    inside = (z > 0) & (x >= 0) & (x <= surface.shape[1] - 1) & (y >= 0) & (y <= surface.shape[0] - 1)
    x, y = (np.where(inside, v, -9.0).astype(np.float32) for v in (x, y))
    nearest = cv2.remap(surface, x, y, cv2.INTER_NEAREST, borderValue=float("nan"))
    sees = inside & ~(nearest * z > BEHIND)
    low, high = (cv2.remap(c, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) for c in limits)
    offset = common_offset(ours - 0.5 * (low + high), sees)
    outside = np.maximum(np.maximum(low + offset - ours, ours - high - offset), 0.0)
    return np.where(sees, outside.mean(axis=2), np.float32(np.nan))


def _judge(told: list[np.ndarray], shape: tuple[int, ...], config: FirstLookConfig) -> np.ndarray | None:
    """The keep map [H, W] bool of a photo from what the others told; None where everything counts."""
    if not told:
        return None
    stack = np.stack(told)
    evidence = quantile_of(stack, config.quantile)
    known = np.isfinite(stack).sum(axis=0) >= config.known_by
    if not known.any():
        return None
    # What is normal: less than half of a photo is behind distractors, or nobody could tell.
    normal = float(np.quantile(evidence[known], 0.4))
    passing = known & (evidence > max(config.threshold, config.normal * normal))
    if passing.mean() < config.least:
        return None
    full = cv2.resize(passing.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return full < 0.5
