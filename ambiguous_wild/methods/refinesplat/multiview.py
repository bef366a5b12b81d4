"""Multi-view evidence: what is static is seen from elsewhere too.

A surface that the model has not learnt yet differs from its photo in every view that shows it; something that
stood there once differs in one. So the evidence of a view is discounted by what the other views say of the
same surface, found through the render's depth. Without it masks feed on themselves: what is masked early is
never learnt and stays masked. Simulated courtyard, seeds 21 (distractors) and 37 (none), 3000 iterations:
30.2 dB and 33.3 dB without, 32.4 and 36.5 with it; plain 3DGS 27.2 and 36.4, exact masks 32.6 and 36.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ambiguous_wild.core import Camera

_SPREAD = 9  # px, box over a view's evidence before others read it: depth is off by a few pixels
_SHRINK = 2  # maps are kept at half the photo's size


@dataclass(frozen=True)
class MultiViewConfig:
    """Whom to ask, and how much their word counts."""

    strength: float = 1.0  # of the discount; 0 = nobody is asked
    views: int = 8  # nearest train views asked
    quantile: float = 0.5  # of what they say: low = a few that can explain the surface are enough
    depth: float = 0.15  # relative difference of depth up to which two views see the same surface
    free: float = 2.0  # units of evidence elsewhere that are normal and discount nothing


class Elsewhere:
    """What every view last said of the surfaces it shows: evidence and depth at half the photo's size."""

    def __init__(self, cameras: Sequence[Camera], config: MultiViewConfig) -> None:
        self.cameras, self.config = list(cameras), config
        self.neighbours = nearest_views(cameras, config.views)
        self.evidence: dict[int, np.ndarray] = {}  # view: [h, w] float32
        self.depth: dict[int, np.ndarray] = {}  # view: [h, w] float32, along the camera's axis

    def remember(self, view: int, evidence: np.ndarray, depth: np.ndarray) -> None:
        """Take what a view says.

        Args:
            view: which.
            evidence: [H, W] of the photo's size.
            depth: [H', W'] expected depth of the render, of any size.
        """
        camera = self.cameras[view]
        size = (max(camera.width // _SHRINK, 1), max(camera.height // _SHRINK, 1))
        wide = cv2.blur(
            np.ascontiguousarray(evidence, dtype=np.float32),
            (_SPREAD, _SPREAD),
            borderType=cv2.BORDER_REPLICATE,
        )
        self.evidence[view] = cv2.resize(wide, size, interpolation=cv2.INTER_AREA)
        self.depth[view] = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)

    def ask(self, view: int) -> np.ndarray | None:
        """Evidence of the other views at the surface each pixel shows, at the quantile of the config.

        Returns:
            [h, w] float32, NaN where no other view sees the surface; None before any other was asked.
        """
        asked = [j for j in self.neighbours[view] if j in self.depth]
        if not asked or view not in self.depth:
            return None
        xyz = _surface(self.cameras[view], self.depth[view])
        seen = np.stack([self._at(j, xyz) for j in asked])
        return _quantile(seen, self.config.quantile)

    def _at(self, view: int, xyz: np.ndarray) -> np.ndarray:
        """A view's evidence at world points [h, w, 3]; NaN where it sees another surface or none."""
        camera, depth = self.cameras[view], self.depth[view]
        pose = camera.cam_from_world.astype(np.float32)
        local = xyz @ pose[:3, :3].T + pose[:3, 3]
        z = local[..., 2]
        ahead = np.maximum(z, 1e-6)
        sx, sy = depth.shape[1] / camera.width, depth.shape[0] / camera.height
        # pixel centres lie at .5 in our cameras and at whole numbers for OpenCV
        x = (local[..., 0] / ahead * camera.fx + camera.cx) * sx - 0.5
        y = (local[..., 1] / ahead * camera.fy + camera.cy) * sy - 0.5
        x, y = np.clip(x, -9, depth.shape[1] + 9), np.clip(y, -9, depth.shape[0] + 9)
        x, y = x.astype(np.float32), y.astype(np.float32)
        there = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=-1.0)
        evidence = cv2.remap(self.evidence[view], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        same = (z > 0) & (there > 0) & (np.abs(z - there) < self.config.depth * there)
        return np.where(same, evidence, np.float32(np.nan))


def discount(
    evidence: np.ndarray, elsewhere: np.ndarray | None, unit: float, config: MultiViewConfig
) -> np.ndarray:
    """Evidence [H, W] over sqrt(1 + strength * excess), excess = what other views say above `free` units.

    Args:
        evidence: [H, W] >= 0.
        elsewhere: from `Elsewhere.ask`, any size; NaN says nothing.
        unit: evidence that is normal in the scene.
        config: strength and what is free of it.
    """
    if elsewhere is None or config.strength <= 0 or unit <= 0:
        return evidence
    excess = np.nan_to_num(np.maximum(elsewhere / unit - config.free, 0.0), nan=0.0).astype(np.float32)
    at_pixels = cv2.resize(excess, evidence.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return evidence / np.sqrt(1.0 + config.strength * at_pixels)


def _quantile(stack: np.ndarray, quantile: float) -> np.ndarray:
    """Quantile over the first axis of [n, h, w] of what is not NaN, linear between ranks; NaN where all is.

    One sort: numpy's nanquantile takes fifty times as long on such a stack.
    """
    ordered = np.sort(stack, axis=0)  # NaN goes last
    last = np.maximum((~np.isnan(stack)).sum(axis=0) - 1, 0)
    rank = quantile * last
    low = np.floor(rank).astype(np.int64)
    high = np.minimum(low + 1, last)
    share = (rank - low).astype(np.float32)
    below = np.take_along_axis(ordered, low[None], axis=0)[0]
    above = np.take_along_axis(ordered, high[None], axis=0)[0]
    return below + share * (above - below)


def nearest_views(cameras: Sequence[Camera], count: int) -> list[list[int]]:
    """For each camera the `count` others that look most alike: near, and in the same direction."""
    centres = np.stack([np.linalg.inv(c.cam_from_world)[:3, 3] for c in cameras])
    axes = np.stack([c.cam_from_world[2, :3] for c in cameras])
    result = []
    for view in range(len(cameras)):
        away = np.linalg.norm(centres - centres[view], axis=1)
        score: np.ndarray = away / max(float(np.median(away)), 1e-12) + 2.0 * (1.0 - axes @ axes[view])
        score[view] = np.inf
        order = np.argsort(score, kind="stable")[: min(count, len(cameras) - 1)]
        result.append([int(j) for j in order])
    return result


def _surface(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World points [h, w, 3] float32 that a depth map [h, w] of the camera shows."""
    h, w = depth.shape
    x = ((np.arange(w, dtype=np.float32) + 0.5) * (camera.width / w) - camera.cx) / camera.fx
    y = ((np.arange(h, dtype=np.float32) + 0.5) * (camera.height / h) - camera.cy) / camera.fy
    local = np.stack([x[None, :] * depth, y[:, None] * depth, depth], axis=2)
    world = np.linalg.inv(camera.cam_from_world).astype(np.float32)
    return local.astype(np.float32) @ world[:3, :3].T + world[:3, 3]
