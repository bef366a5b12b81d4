"""Free-space violations: SfM points of distractors and of wrong matches.

A distractor that stands still in some photos has points like the static scene. Photos in which it is gone see
through them: they show the surface behind, as other photos do. Training starts without such points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.effects.near_space import SHARE, nearest_depths
from ambiguous_wild.splat.effects.tracks import TrackColours, log_gains, point_indices_by_photo
from ambiguous_wild.splat.step import TrainData

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

MIN_TRACK = 3  # train photos that observe the points of which surfaces are made
VIOLATED = 2  # photos whose free space a point must violate; one may have missed it
AGREEING = 4  # a point stays if this many times as many photos show it, or its colour at its place
IN_FRONT = 0.9  # share of the surface's depth below which a point is in front of it
EDGE = 0.3  # share of the photo's longer side; triangles with longer edges say nothing of colours
SAME = 0.06  # mean difference of colours in [0, 1] up to which two are the same
NEIGHBOURS = 12  # nearest other train photos compared at a place: farther ones confirm too much
CONFIRM, CONFIRM_SHARE = 2, 0.3  # of these, so many must show the colour, and this share
MIN_SEPARATION = (
    0.015  # share of the longer side; a photo that has point and place closer together is skipped
)
PIXELS = 20_000  # of the reduced photos that colours are read from


def free_space_violations(data: TrainData) -> np.ndarray:
    """Return which SfM points violate the free space of photos, [M] bool.

    The surface that a photo sees is the Delaunay triangulation of the points of long tracks that it observes.
    A point in front of it, which the photo does not observe, violates the photo's free space if

    - the photo shows another colour there, and enough other photos confirm that colour on the surface;
    - or the point has a short track and is nearer than `SHARE` of the nearest points, and of its triangle.

    Colours are divided by the exposure gains of their photos. Masked pixels say nothing.
    """
    xyz, cameras = data.scene.points.xyz, data.cameras
    photos = [
        _PhotoColours.of(photo, camera, keep)
        for photo, camera, keep in zip(data.photos, cameras, data.user_keep, strict=True)
    ]
    observed = [
        rows[camera.has(*camera.project(xyz[rows]))]
        for camera, rows in zip(cameras, point_indices_by_photo(data.scene), strict=True)
    ]
    length = np.bincount(np.concatenate([np.zeros(0, np.int64), *observed]), minlength=len(xyz))
    of_surface = [rows[length[rows] >= MIN_TRACK] for rows in observed]
    if not any(map(len, of_surface)):
        return np.zeros(len(xyz), bool)
    of_point = _divide_by_gains(photos, cameras, observed, xyz)
    depths = nearest_depths(cameras, xyz, of_surface)
    centres = np.stack([camera.center for camera in cameras])
    violated, agreeing = np.zeros(len(xyz), np.int64), length.copy()  # who observes it shows it
    for view, camera in enumerate(cameras):
        pixels, z = camera.project(xyz)
        surface = _ObservedSurface.of(pixels[of_surface[view]], z[of_surface[view]])
        if surface is None:
            continue
        candidate = camera.has(pixels, z)
        candidate[observed[view]] = False
        rows = np.flatnonzero(candidate)
        triangle = surface.triangle(pixels[rows])
        least = surface.least_depth(triangle)
        shown = photos[view].at(pixels[rows])
        in_front = (z[rows] < IN_FRONT * least) & np.isfinite(shown).all(axis=1)
        rows, triangle, least, shown = rows[in_front], triangle[in_front], least[in_front], shown[in_front]
        near = (z[rows] < np.minimum(SHARE * least, depths[view])) & (length[rows] < MIN_TRACK)
        small = surface.longest_edge(triangle) < EDGE * max(camera.width, camera.height)
        agrees = _distance(shown, of_point[rows]) <= SAME
        behind = camera.unproject(pixels[rows], surface.depth(triangle, pixels[rows]))
        away = np.linalg.norm(centres - centres[view], axis=1)
        nearest = [other for other in np.argsort(away, kind="stable") if other != view][:NEIGHBOURS]
        others = [(cameras[other], photos[other]) for other in nearest]
        violated[rows] += near | (small & ~agrees & _confirmed(behind, shown, xyz[rows], others))
        agreeing[rows] += small & agrees
    return (violated >= VIOLATED) & (AGREEING * violated > agreeing)


def _confirmed(
    behind: np.ndarray, shown: np.ndarray, points: np.ndarray, others: Sequence[tuple[Camera, _PhotoColours]]
) -> np.ndarray:
    """Return whether enough of the photos that can tell show the same colour, [N] bool.

    Args:
        behind: [N, 3] places on the surface.
        shown: [N, 3] colours there.
        points: [N, 3] points in front of them.
        others: cameras and colours of the compared photos.
    """
    votes, answers = np.zeros((2, len(behind)), np.int64)
    for camera, photo in others:
        pixels, z = camera.project(behind)
        beside = np.linalg.norm(pixels - camera.project(points)[0], axis=1)
        # NaN: the point is behind the camera
        tells = camera.has(pixels, z) & ~(beside <= MIN_SEPARATION * max(camera.width, camera.height))
        colours = photo.at(pixels[tells])
        answers[tells] += np.isfinite(colours).all(axis=1)
        votes[tells] += _distance(colours, shown[tells]) <= SAME
    return np.asarray(votes >= np.maximum(CONFIRM, CONFIRM_SHARE * answers))


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


@dataclass
class _PhotoColours:
    """The colours of a photo, reduced: depth is off by a few pixels, and many photos must fit."""

    pixels: np.ndarray  # [h, w, 3] uint8
    masked: np.ndarray  # [h, w] bool
    scale: np.ndarray  # [2] columns and rows for a px of the camera
    gain: np.ndarray  # [3] of the photo's exposure

    @classmethod
    def of(cls, photo: Tensor, camera: Camera, keep: Tensor | None) -> _PhotoColours:
        height, width = photo.shape[:2]
        share = min(math.sqrt(PIXELS / (height * width)), 1.0)
        size = w, h = max(round(share * width), 1), max(round(share * height), 1)
        whole = (photo.clamp(0.0, 1.0).cpu().numpy() * 255.0 + 0.5).astype(np.uint8)
        small = cv2.resize(whole, size, interpolation=cv2.INTER_AREA)
        masked = np.zeros((h, w), bool)
        if keep is not None:
            masked = cv2.resize(keep.float().cpu().numpy(), size, interpolation=cv2.INTER_AREA) < 1.0
        return cls(small, masked, np.array([w / camera.width, h / camera.height]), np.ones(3))

    def at(self, pixels: np.ndarray) -> np.ndarray:
        """Return the colours [N, 3] float64 at pixels [N, 2] inside the camera's frame; NaN where masked."""
        h, w = self.masked.shape
        column, row = (pixels * self.scale).astype(int).clip(0, (w - 1, h - 1)).T
        colours = self.pixels[row, column] / 255.0 / self.gain
        colours[self.masked[row, column]] = np.nan
        return colours


def _divide_by_gains(
    photos: Sequence[_PhotoColours],
    cameras: Sequence[Camera],
    observed: Sequence[np.ndarray],
    xyz: np.ndarray,
) -> np.ndarray:
    """Set the gains of the photos; return the mean colour of each point [M, 3], NaN where none shows it."""
    rgb = [
        photo.at(camera.project(xyz[rows])[0])
        for photo, camera, rows in zip(photos, cameras, observed, strict=True)
    ]
    view = np.repeat(np.arange(len(photos)), [len(rows) for rows in observed])
    colours = TrackColours(np.concatenate(observed), view, np.concatenate(rgb)).known()
    gains = np.exp(log_gains(colours.usable(), len(photos)))
    for photo, gain in zip(photos, gains, strict=True):
        photo.gain = gain
    total, count = np.zeros((len(xyz), 3)), np.zeros((len(xyz), 1))
    np.add.at(total, colours.point, colours.rgb / gains[colours.view])
    np.add.at(count, colours.point, 1)
    return total / np.where(count > 0, count, np.nan)


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the mean difference of colours [N, 3] over channels."""
    return np.abs(a - b).mean(axis=1)
