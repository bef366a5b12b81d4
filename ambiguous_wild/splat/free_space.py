"""SfM points in space that photos show to be free: of distractors, and of wrong matches.

A distractor that stands still in some photos has points like the static scene. Photos in which it is gone see
through them: they show the surface behind, as other photos do. Training starts without such points.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from torch import Tensor

from ambiguous_wild.core import Camera, Scene
from ambiguous_wild.splat.effects.near_space import SHARE, nearest_depths
from ambiguous_wild.splat.effects.tracks import tracks_of

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

MIN_TRACK = 3  # train photos that see the points of which surfaces are made
VIOLATED = 2  # photos whose free space a point must violate; one may have missed it
ALIKE_TO_VIOLATED = 4  # and no more than this many times as many photos may show its colour at its place
IN_FRONT = 0.9  # share of the depth of the surface up to which a point is in front of it
EDGE = 0.3  # share of the photo's longer side; triangles with longer edges tell nothing of the surface
SAME = 0.06  # mean difference of colours in [0, 1] up to which two are the same
NEIGHBOURS = 12  # nearest train photos that may show the same surface
CONFIRM, CONFIRM_SHARE = 2, 0.3  # of these, so many must, and this share of those that have it in their frame
APART = 0.015  # share of the longer side by which the point must not hide the surface there
PIXELS = 20_000  # of the reduced photos that colours are read from


def free_space_violations(
    scene: Scene, photos: Iterable[Tensor], keeps: Sequence[Tensor | None]
) -> np.ndarray:
    """Return the SfM points [M] bool that lie in space which other photos show to be free.

    The surface that a photo sees is the Delaunay triangulation of the points of long tracks that it observes.
    A point in front of its triangle, which the photo does not observe, violates the photo's free space if the
    photo shows another colour there, and other photos show that colour on the surface; or if it is close to
    the camera and few photos see it: where masks hide it in these, the loss corrects nothing.

    Args:
        scene: scene with tracks.
        photos: [H, W, 3] in [0, 1] of each train photo; read once.
        keeps: keep map [H, W] of each train photo, or None.
    """
    xyz, seen, cameras = scene.points.xyz, tracks_of(scene), [view.camera for view in scene.train]
    length = np.bincount(np.concatenate([np.zeros(0, np.int64), *seen]), minlength=len(xyz))
    judges = [rows[length[rows] >= MIN_TRACK] for rows in seen]
    if not any(map(len, judges)):
        return np.zeros(len(xyz), bool)
    colours = [_PhotoColours.of(photo, camera) for photo, camera in zip(photos, cameras, strict=True)]
    of_point = _mean_colours(colours, cameras, seen, xyz)
    depths = nearest_depths(cameras, xyz, judges)
    centres = np.stack([camera.center for camera in cameras])
    violated, alike = np.zeros((2, len(xyz)), np.int64)
    for view, camera in enumerate(cameras):
        pixels, z = camera.project(xyz)
        surface = _ObservedSurface.of(pixels[judges[view]], z[judges[view]])
        if surface is None:
            continue
        asked = (z > 0) & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
        asked[seen[view]] = False
        keep = keeps[view]
        if keep is not None:  # the photo's features there were not matched
            rows = np.flatnonzero(asked)
            column, row = pixels[rows].astype(int).T
            asked[rows] = keep.cpu().numpy()[row, column] > 0.5
        rows = np.flatnonzero(asked)
        triangle = surface.triangle(pixels[rows])
        least = surface.least_depth(triangle)
        front = z[rows] < IN_FRONT * least
        rows, triangle, least = rows[front], triangle[front], least[front]
        near = (z[rows] < np.minimum(SHARE * least, depths[view])) & (length[rows] < MIN_TRACK)
        small = surface.longest_edge(triangle) < EDGE * max(camera.width, camera.height)
        shown = colours[view].at(pixels[rows])
        own = _distance(shown, of_point[rows]) <= SAME
        behind = camera.unproject(pixels[rows], surface.depth(triangle, pixels[rows]))
        away = np.linalg.norm(centres - centres[view], axis=1)
        nearest = [other for other in np.argsort(away, kind="stable") if other != view][:NEIGHBOURS]
        others = [(cameras[other], colours[other]) for other in nearest]
        through = small & ~own & _confirmed(behind, shown, xyz[rows], others)
        violated[rows] += near | through
        alike[rows] += small & own
    return (violated >= VIOLATED) & (ALIKE_TO_VIOLATED * violated > alike)


def _confirmed(
    behind: np.ndarray, shown: np.ndarray, points: np.ndarray, others: Sequence[tuple[Camera, _PhotoColours]]
) -> np.ndarray:
    """Return whether enough other photos show the same colour on the surface, [N] bool.

    Args:
        behind: [N, 3] places on the surface.
        shown: [N, 3] colours there.
        points: [N, 3] points in front of them, which hide them in photos that have both at one place.
        others: cameras and colours of the photos.
    """
    votes, frames = np.zeros((2, len(behind)), np.int64)
    for camera, colours in others:
        pixels, z = camera.project(behind)
        size = np.array([camera.width, camera.height])
        within = (z > 0) & ((pixels >= 0) & (pixels < size)).all(axis=1)
        beside = np.linalg.norm(pixels - camera.project(points)[0], axis=1)
        within &= ~(beside <= APART * size.max())  # NaN: behind the camera
        frames += within
        votes[within] += _distance(colours.at(pixels[within]), shown[within]) <= SAME
    return np.asarray(votes >= np.maximum(CONFIRM, CONFIRM_SHARE * frames))


@dataclass(frozen=True)
class _ObservedSurface:
    """The triangulation of the points that a photo observes."""

    mesh: Delaunay
    z: np.ndarray  # [K] depth of its points

    @classmethod
    def of(cls, pixels: np.ndarray, z: np.ndarray) -> _ObservedSurface | None:
        """Triangulate points [K, 2] px with their depths; None if they enclose nothing."""
        from scipy.spatial import Delaunay, QhullError

        front = z > 0
        try:
            return cls(Delaunay(pixels[front]), z[front])
        except (QhullError, ValueError):  # in a line, or none
            return None

    def triangle(self, pixels: np.ndarray) -> np.ndarray:
        """Return the triangle of each pixel [N, 2]; -1 outside of all."""
        return self.mesh.find_simplex(pixels)

    def least_depth(self, triangle: np.ndarray) -> np.ndarray:
        """Return the least depth of the corners, 0 outside of all triangles."""
        return np.where(triangle < 0, 0.0, self.z[self.mesh.simplices[triangle]].min(axis=1))

    def longest_edge(self, triangle: np.ndarray) -> np.ndarray:
        """Return the length of the longest edge, px."""
        corners = self.mesh.points[self.mesh.simplices[triangle]]
        return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)

    def depth(self, triangle: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return the depth of the plane through the corners at pixels [N, 2]; inverse depth is linear."""
        transform = self.mesh.transform[triangle]
        first = np.einsum("nij,nj->ni", transform[:, :2], pixels - transform[:, 2])
        weights = np.column_stack([first, 1.0 - first.sum(axis=1)])
        return 1.0 / (weights / self.z[self.mesh.simplices[triangle]]).sum(axis=1)


@dataclass(frozen=True)
class _PhotoColours:
    """The colours of a photo, reduced: depth is off by a few pixels, and many photos must fit."""

    pixels: np.ndarray  # [h, w, 3] uint8
    scale: np.ndarray  # [2] columns and rows for a px of the camera

    @classmethod
    def of(cls, photo: Tensor, camera: Camera) -> _PhotoColours:
        whole = (photo.cpu().numpy() * 255.0 + 0.5).astype(np.uint8)
        share = min(math.sqrt(PIXELS / (whole.shape[0] * whole.shape[1])), 1.0)
        w, h = (max(round(side * share), 1) for side in (whole.shape[1], whole.shape[0]))
        small = cv2.resize(whole, (w, h), interpolation=cv2.INTER_AREA)
        return cls(small, np.array([w / camera.width, h / camera.height]))

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Return the colours [N, 3] float64 in [0, 1] at pixels [N, 2] of the camera."""
        h, w = self.pixels.shape[:2]
        column, row = (pixels * self.scale).astype(int).clip(0, (w - 1, h - 1)).T
        return self.pixels[row, column] / 255.0


def _mean_colours(
    colours: Sequence[_PhotoColours], cameras: Sequence[Camera], seen: Sequence[np.ndarray], xyz: np.ndarray
) -> np.ndarray:
    """Return the mean colour of each point [M, 3] in the photos that observe it; NaN where none does."""
    total, count = np.zeros((len(xyz), 3)), np.zeros((len(xyz), 1))
    for photo, camera, rows in zip(colours, cameras, seen, strict=True):
        pixels, z = camera.project(xyz[rows])
        rows, pixels = rows[z > 0], pixels[z > 0]
        total[rows] += photo.at(pixels)
        count[rows] += 1
    return total / np.where(count > 0, count, np.nan)


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mean difference of colours [N, 3] over channels."""
    return np.abs(a - b).mean(axis=1)
