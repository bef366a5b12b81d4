"""Directions and places of a scene that people look at: up, the middle, how far it reaches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambiguous_wild.core import Scene


@dataclass(frozen=True)
class Space:
    """A scene's frame, world units."""

    up: np.ndarray  # [3] unit vector
    middle: np.ndarray  # [3] where the cameras look
    distance: float  # mean of the cameras from the middle
    extent: float  # radius of the camera positions, see `Scene.extent`


def space_of(scene: Scene) -> Space:
    """Up is the mean of the photos' own up; the middle lies at the median depth of what each photo shows."""
    views = scene.train or scene.views
    poses = np.array([v.camera.cam_from_world for v in views])
    up = -poses[:, 1, :3].mean(axis=0)
    size = np.linalg.norm(up)
    up = up / size if size > 1e-6 else -poses[0, 1, :3]
    centers = np.array([v.camera.center for v in views])
    depths = np.array([_median_depth(pose, scene.points.xyz) for pose in poses])
    known = np.isfinite(depths)
    depths = np.where(known, depths, np.median(depths[known]) if known.any() else scene.extent)
    middle = (centers + poses[:, 2, :3] * depths[:, None]).mean(axis=0)
    distance = float(np.linalg.norm(centers - middle, axis=1).mean())
    return Space(up=up, middle=middle, distance=max(distance, 1e-6), extent=scene.extent)


def _median_depth(pose: np.ndarray, points: np.ndarray) -> float:
    """Of the points in a cone of 45 degrees around the view's axis; NaN where there is none."""
    if not len(points):
        return np.nan
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    ahead = (seen[:, 2] > 0) & (np.linalg.norm(seen[:, :2], axis=1) < seen[:, 2])
    return float(np.median(seen[ahead, 2])) if ahead.any() else np.nan
