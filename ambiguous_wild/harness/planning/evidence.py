"""Evidence that needs no training: what the sparse model and the photos at its points say.

Every function returns a number, NaN where the scene cannot tell; `decide.py` holds the thresholds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambiguous_wild.core import Camera, Scene
from ambiguous_wild.splat.effects.tracks import TrackColours, log_gains, track_colours
from ambiguous_wild.vision.sparse_surface import has_surface

LEAST = 50  # observations below which nothing is said
LEAST_VIEWS = 6  # of a point, to fit four numbers to its colour
OUTLYING = 4.5  # median deviations from a point's median colour: three standard deviations of noise
RELIT = 0.5  # share of a photo's points that are far from their medians: more, and its light is another one
LEAST_APART = 1e-3  # spread of cameras over the depth they look at; below, they stand at one place
LEAST_SPREAD = 0.01  # code values, or of the logarithm: the median deviation counts as at least so much
MOST_PHOTOS = 64  # whose uncovered share is taken
MOST = 20_000  # points whose view dependence is fitted; more do not change a median


@dataclass(frozen=True)
class Evidence:
    """What a scene shows, each in the unit of its threshold; NaN = it cannot be told."""

    exposure: float  # spread of the photos' gains, share of a code value
    appearance: float  # spread at a point that a gain per photo leaves, share of a code value
    sampling: float  # ratio of the coarsest photo's pixel to the finest's, on the scene
    view_dependence: float  # median amplitude of what follows the direction, code values in [0, 1]
    reprojection_px: float  # median of points in the train photos, px of the loaded images
    observations: int  # in train photos, usable for colour
    photos: int = 0  # that train; 0 = not counted
    outward: float = math.nan  # spread of what the train cameras look at, over their own
    uncovered: float = math.nan  # share of the train photos where no SfM points lie


def measure(scene: Scene, photos: Sequence[np.ndarray]) -> Evidence:
    """All of it.

    Args:
        scene: with tracks.
        photos: of the train views, [H, W, 3] in [0, 1].
    """
    colours = track_colours(scene, photos)
    gains = log_gains(colours, len(scene.train))
    enough = len(colours.point) >= LEAST
    grey = colours.rgb.mean(axis=1) / np.exp(gains[colours.view].mean(axis=1))
    in_codes, in_logs = (_fit_points(scene, colours, v) for v in (grey, np.log(grey)))
    return Evidence(
        exposure=exposure_spread(colours, gains) if enough else np.nan,
        appearance=remaining_spread(in_logs),
        sampling=sampling_ratio(scene),
        view_dependence=view_dependence(in_codes),
        reprojection_px=reprojection(scene),
        observations=len(colours.point),
        photos=len(scene.train),
        outward=outward(scene),
        uncovered=uncovered(scene),
    )


def has_tracks(scene: Scene) -> bool:
    """Whether any point was seen at a known place of a photo; without, no photo need be read."""
    return bool((scene.points.track_views >= 0).sum() >= LEAST)


def exposure_spread(colours: TrackColours, gains: np.ndarray) -> float:
    """Standard deviation of log gain between the photos that see a same point, rms over channels.

    Not between all photos: along a strip of photos small errors add up from neighbour to neighbour, and
    two photos that share nothing cannot disagree.
    """
    counts = np.bincount(colours.point)
    rows = counts[colours.point] >= 2
    if not rows.any():
        return float("nan")
    point, values = colours.point[rows], gains[colours.view[rows]]
    n = counts[point][:, None]
    mean = np.stack([np.bincount(point, values[:, c], len(counts))[point] for c in range(3)], axis=1) / n
    return float(np.sqrt(((values - mean) ** 2 * n / (n - 1)).mean()))


def sampling_ratio(scene: Scene) -> float:
    """Ratio of the 95th to the 5th percentile, over train photos, of a pixel's size on the points it sees.

    A pixel covers depth / focal length; each photo counts with the median over its points.
    """
    sizes = [depth / (0.5 * (camera.fx + camera.fy)) for camera, depth in _looking_at(scene)]
    if len(sizes) < 3:
        return float("nan")
    low, high = np.percentile(sizes, [5, 95])
    return float(high / low)


def outward(scene: Scene) -> float:
    """Spread of the places that train cameras look at, over that of the cameras themselves.

    Near 0 where they stand around something, 1 where they look the same way, large where they stand in the
    middle. A camera looks at its axis, as far away as its points are in the median. NaN if all stand at one
    place.
    """
    looking = _looking_at(scene)
    if len(looking) < 3:
        return float("nan")
    cameras = np.array([camera.center for camera, _ in looking])
    places = cameras + [depth * camera.cam_from_world[2, :3] for camera, depth in looking]
    # the root of the summed variances does not depend on the axes of the world
    apart, between = (float(np.sqrt(a.var(axis=0).sum())) for a in (cameras, places))
    depth = float(np.median([depth for _, depth in looking]))
    return between / apart if apart > LEAST_APART * depth else float("nan")


def uncovered(scene: Scene) -> float:
    """Share of the train photos' pixels with no SfM points around them, in the mean of up to 64 photos.

    There the photos show what SfM did not find, in most scenes the background. Tracks are not needed.
    A photo with too few points for a surface counts as bare; NaN if most photos are such.
    """
    cameras = [view.camera for view in scene.train]
    cameras = cameras[:: max(-(-len(cameras) // MOST_PHOTOS), 1)]
    if not cameras or not len(scene.points):
        return float("nan")
    known = [has_surface(camera, scene.points.sure_xyz) for camera in cameras]
    if 2 * sum(k is None for k in known) > len(known):
        return float("nan")
    return float(np.mean([1.0 if k is None else 1.0 - k.mean() for k in known]))


def _looking_at(scene: Scene) -> list[tuple[Camera, float]]:
    """Train cameras that see five points or more, each with the median depth of its points."""
    owner, found = _owner(scene), []
    for index, view in enumerate(scene.views):
        if view.split == "train":
            pose = view.camera.cam_from_world
            xyz = scene.points.xyz[owner[scene.points.track_views == index]]
            depth = (xyz @ pose[:3, :3].T + pose[:3, 3])[:, 2]
            depth = depth[depth > 0]
            if len(depth) >= 5:
                found.append((view.camera, float(np.median(depth))))
    return found


def reprojection(scene: Scene) -> float:
    """Median distance between where a point was found and where it projects, px of the loaded photos."""
    owner, found = _owner(scene), []
    for index, view in enumerate(scene.views):
        if view.split != "train":
            continue
        rows = np.flatnonzero(scene.points.track_views == index)
        camera = view.camera
        xyz = scene.points.xyz[owner[rows]]
        local = xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        front = local[:, 2] > 1e-6
        local = local[front]
        uv = local[:, :2] / local[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        found.append(np.linalg.norm(uv - scene.points.track_xy[rows][front], axis=1))
    errors = np.concatenate(found) if found else np.zeros(0)
    return float(np.median(errors)) if len(errors) >= LEAST else float("nan")


@dataclass(frozen=True)
class _Fits:
    """Of every point seen often enough, the variance of its colour that its viewing direction explains."""

    explained: np.ndarray  # [P] beyond chance; scatters about zero where there is nothing
    left: np.ndarray  # [P] unbiased variance of what it does not


def _fit_points(scene: Scene, colours: TrackColours, values: np.ndarray) -> _Fits:
    """A constant and three numbers linear in the direction, by least squares, for points of six photos on.

    A fit explains noise too: what it explains by chance is subtracted (the adjusted coefficient of
    determination).
    """
    order = np.argsort(colours.point, kind="stable")
    point, view, values = colours.point[order], colours.view[order], values[order]
    starts = np.flatnonzero(np.r_[True, point[1:] != point[:-1]])
    sizes = np.diff(np.r_[starts, len(point)])
    chosen = np.flatnonzero(sizes >= LEAST_VIEWS)
    if len(chosen) > MOST:
        chosen = np.random.default_rng(0).choice(chosen, MOST, replace=False)
    centres = np.array([v.camera.center for v in scene.train])
    groups = [starts[k] + np.arange(sizes[k]) for k in chosen]
    fits = []
    for rows in _usual(groups, values, view):
        if len(rows) < LEAST_VIEWS:
            continue
        direction = centres[view[rows]] - scene.points.xyz[point[rows[0]]]
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        fits.append(_fit(direction, values[rows]))
    return _Fits(*np.array(fits).reshape(-1, 2).T)


def _usual(groups: Sequence[np.ndarray], values: np.ndarray, view: np.ndarray) -> list[np.ndarray]:
    """Of each point, the rows whose colour is near the point's median colour.

    A colour far from the median shows something that stands before the point. But where most colours of a
    photo are far, its light is another one, and its rows stay.
    """
    if not groups:
        return []
    far = []
    for rows in groups:
        apart = np.abs(values[rows] - np.median(values[rows]))
        far.append(apart > OUTLYING * max(float(np.median(apart)), LEAST_SPREAD))
    of_photo = view[np.concatenate(groups)]
    count = np.maximum(np.bincount(of_photo), 1)
    relit = np.bincount(of_photo, np.concatenate(far)) > RELIT * count
    return [rows[~outlying | relit[view[rows]]] for rows, outlying in zip(groups, far)]


def _fit(direction: np.ndarray, values: np.ndarray) -> tuple[float, float]:
    n = len(values)
    # directions of a narrow arc are nearly one: what they cannot tell apart is left out of the fit
    axes, spread, _ = np.linalg.svd(direction - direction.mean(axis=0), full_matrices=False)
    rank = int((spread > 0.05 * np.sqrt(n)).sum())
    centred = values - values.mean()
    explained = axes[:, :rank] @ (axes[:, :rank].T @ centred)
    variance = float(((centred - explained) ** 2).sum()) / (n - 1 - rank)
    return float(centred @ centred) / (n - 1) - variance, variance


def view_dependence(fits: _Fits) -> float:
    """Median over points of the amplitude of colour that is linear in the viewing direction."""
    if len(fits.explained) < 10:
        return float("nan")
    return float(np.sqrt(max(np.median(fits.explained), 0.0)))


def remaining_spread(fits: _Fits) -> float:
    """Median over points of what is left between photos once each has its gain and each point its shine."""
    if len(fits.left) < 10:
        return float("nan")
    return float(np.sqrt(np.median(fits.left)))


def _owner(scene: Scene) -> np.ndarray:
    return np.repeat(np.arange(len(scene.points)), np.diff(scene.points.track_offsets))
