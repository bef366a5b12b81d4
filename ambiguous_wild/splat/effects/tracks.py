"""Colours of SfM points in the photos along their tracks, and exposure gains from them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.core import Scene

DARK, BRIGHT = 0.04, 0.96  # colours outside of this range are noisy or clipped
ROUNDS = 12  # alternations of medians


@dataclass(frozen=True)
class TrackColours:
    """Observations of SfM points in the train photos that are neither black nor clipped."""

    point: np.ndarray  # [L] int64, index into Scene.points
    view: np.ndarray  # [L] int64, index into Scene.train
    rgb: np.ndarray  # [L, 3] float64 in (0, 1), sRGB, mean of 3x3 px

    def usable(self) -> TrackColours:
        """Leave out what is black, clipped or unknown."""
        return self._some(np.all((self.rgb > DARK) & (self.rgb < BRIGHT), axis=1))

    def known(self) -> TrackColours:
        """Leave out what is unknown, NaN."""
        return self._some(np.all(np.isfinite(self.rgb), axis=1))

    def _some(self, rows: np.ndarray) -> TrackColours:
        return TrackColours(self.point[rows], self.view[rows], self.rgb[rows])


def point_indices_by_photo(scene: Scene) -> list[np.ndarray]:
    """Return for each train photo the sorted indices of its sparse points."""
    points, owner = scene.points, scene.points.owners
    order = np.argsort(points.track_views, kind="stable")
    train = np.array([k for k, view in enumerate(scene.views) if view.split == "train"], np.int64)
    begins, ends = np.searchsorted(points.track_views[order], np.stack([train, train + 1]))
    return [np.unique(owner[order[begin:end]]) for begin, end in zip(begins, ends, strict=True)]


def track_colours(scene: Scene, photos: Iterable[np.ndarray]) -> TrackColours:
    """Read the colours of SfM points in every train photo.

    Args:
        scene: scene with tracks.
        photos: photos of the train views, [H, W, 3] in [0, 1], of any size.
    """
    from scipy.ndimage import map_coordinates, uniform_filter

    points, of_point = scene.points, scene.points.owners
    train = {index: k for k, index in enumerate(i for i, v in enumerate(scene.views) if v.split == "train")}
    observed = []
    for (index, k), photo in zip(train.items(), photos, strict=True):
        rows = np.flatnonzero(points.track_views == index)
        if not len(rows):
            continue
        smooth = uniform_filter(np.asarray(photo, np.float64), size=(3, 3, 1), mode="nearest")
        camera = scene.views[index].camera
        scale = np.array([photo.shape[1] / camera.width, photo.shape[0] / camera.height])
        # rows, columns; pixel centres at +0.5
        where = (points.track_xy[rows].astype(np.float64) * scale).T[::-1] - 0.5
        rgb = np.stack(
            [map_coordinates(smooth[..., c], where, order=1, mode="nearest") for c in range(3)], axis=1
        )
        observed.append((of_point[rows], np.full(len(rows), k), rgb))
    if not observed:
        return TrackColours(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    return TrackColours(*(np.concatenate(parts) for parts in zip(*observed))).usable()


def log_gains(colours: TrackColours, views: int) -> np.ndarray:
    """Return the log gain [views, 3] of each photo and channel against the mean photo; 0 where unknown.

    Medians of a point over its photos and of a photo over its points alternate; medians ignore distractors in
    front of points.
    """
    gains = np.zeros((views, 3))
    counts = np.bincount(colours.point) if len(colours.point) else np.zeros(0, int)
    shared = counts[colours.point] >= 2 if len(colours.point) else np.zeros(0, bool)
    if shared.sum() < 10:
        return gains
    point, view, logs = colours.point[shared], colours.view[shared], np.log(colours.rgb[shared])
    for _ in range(ROUNDS):
        level = grouped_median(logs - gains[view], point)
        gains = _by_view(logs - level, view, views)
        gains -= gains.mean(axis=0)
    return gains


def _by_view(values: np.ndarray, view: np.ndarray, views: int) -> np.ndarray:
    out = np.zeros((views, values.shape[1]))
    for k in range(views):
        rows = values[view == k]
        if len(rows) >= 5:
            out[k] = np.median(rows, axis=0)
    return out


def grouped_median(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return for each row the median of its group, [L, C]."""
    out = np.empty_like(values)
    for c in range(values.shape[1]):
        order = np.lexsort((values[:, c], group))
        sorted_group, sorted_values = group[order], values[order, c]
        starts = np.flatnonzero(np.r_[True, sorted_group[1:] != sorted_group[:-1]])
        sizes = np.diff(np.r_[starts, len(order)])
        median = 0.5 * (sorted_values[starts + (sizes - 1) // 2] + sorted_values[starts + sizes // 2])
        out[order, c] = np.repeat(median, sizes)
    return out


def photo_gains(scene: Scene, photos: Iterable[np.ndarray]) -> np.ndarray:
    """Return factors [V, 3] of the train photos' sRGB codes against the mean photo; 1 where unknown."""
    return np.exp(log_gains(track_colours(scene, photos), len(scene.train)))
