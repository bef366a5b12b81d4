"""A first look before any training: what no other photo shows at the same surface was only passing by.

Masks need a render, and the first renders show whatever stands before most cameras: 45 % of every photo
behind a crowd is learnt before the first mask is made, and some of it stays. The sparse points know better:
they lie on what several photos saw in one place. So the surface behind every pixel is taken from them
(`vision/sparse_surface.py`) and looked up in the other photos, and a pixel counts in the first iterations
only if enough of them show its colour there. Depth is off by a pixel or two, so a colour may lie anywhere
between the least and the greatest around the place. What no sparse points surround counts.

Later masks are made from renders, but the first look keeps a word in them (`FirstLookConfig.weight`): it is
the one witness that no training can talk round.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.refinesplat.agreement import common_offset, quantile_of
from ambiguous_wild.methods.refinesplat.multiview import nearest_views
from ambiguous_wild.vision.sparse_surface import BEHIND, in_map, world_points

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
    weight: float = 1.5  # `structure`: later evidence is so many times more, or less, as it says; 1 = no word

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat.first_look",
            views=(1, math.inf), quantile=(0, 1), threshold=(0, math.inf), normal=(0, math.inf),
            known_by=(1, math.inf), least=(0, 1), weight=(1, math.inf),
        )  # fmt: skip


@dataclass(frozen=True)
class FirstLook:
    """What the other photos say of one photo, on a map [h, w] of its frame."""

    passing: np.ndarray  # float32: 1 = only passing by, 0 = they show it too, 0.5 = nobody could tell
    least: float

    def keep(self, shape: tuple[int, int]) -> np.ndarray | None:
        """What to learn from at first, [H, W] bool; None where everything counts."""
        passing = self.passing > 0.5
        if passing.mean() < self.least:
            return None
        return _resized(passing.astype(np.float32), shape) < 0.5

    def factor(self, weight: float, shape: tuple[int, int]) -> np.ndarray:
        """Of the evidence of later masks, [H, W] float32 in [1 / weight, weight]."""
        return np.power(np.float32(weight), 2.0 * _resized(self.passing, shape) - 1.0)


def first_look(
    cameras: Sequence[Camera],
    photos: Sequence[np.ndarray],
    surfaces: Sequence[np.ndarray | None],
    config: FirstLookConfig,
) -> list[FirstLook | None]:
    """What the photos say of each other; None where nothing is known of a photo.

    Args:
        cameras: of the photos.
        photos: [H, W, 3] in [0, 1].
        surfaces: inverse depths [h, w] of the sparse points (`static_surfaces`).
        config: how to judge.
    """
    small = [
        None if inverse is None else _small(photo, inverse.shape)
        for photo, inverse in zip(photos, surfaces, strict=True)
    ]
    ranges = [None if s is None else (cv2.erode(s, _WINDOW), cv2.dilate(s, _WINDOW)) for s in small]
    looks: list[FirstLook | None] = []
    for view, others in enumerate(nearest_views(cameras, config.views)):
        inverse, ours = surfaces[view], small[view]
        if inverse is None or ours is None:
            looks.append(None)
            continue
        world = world_points(cameras[view], inverse)
        told = [
            _difference(ours, world, cameras[j], surface, limits)
            for j in others
            if (surface := surfaces[j]) is not None and (limits := ranges[j]) is not None
        ]
        looks.append(_judge(told, config))
    return looks


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


def _judge(told: list[np.ndarray], config: FirstLookConfig) -> FirstLook | None:
    """From what the others told of a photo; None where they could tell nothing."""
    if not told:
        return None
    stack = np.stack(told)
    evidence = quantile_of(stack, config.quantile)
    known = np.isfinite(stack).sum(axis=0) >= config.known_by
    if not known.any():
        return None
    # What is normal: less than half of a photo is behind distractors, or nobody could tell.
    normal = float(np.quantile(evidence[known], 0.4))
    passing = evidence > max(config.threshold, config.normal * normal)
    return FirstLook(np.where(known, passing, 0.5).astype(np.float32), config.least)


def _resized(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return cv2.resize(x, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
