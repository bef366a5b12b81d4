"""A dense start: further first Gaussians at points of plane sweeps.

Where photos overlap little, 3DGS's growth puts Gaussians where they explain one photo, often close to its
camera. Points on which several photos agree leave less room for that. The idea is that of EDGS (Kotovenko et
al., 2025); we use plane sweeps instead of a matching network.

A plane sweep (Collins, CVPR 1996) tries planes parallel to a photo's image plane. For each plane the
neighbouring photos are warped into the photo and compared by the correlation of small windows (ZNCC), which
does not depend on exposure. A depth is kept where the correlation is high at this depth only and where depths
of other photos agree. A distractor that moves has no depth on which two other photos agree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import Facts
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.tracks import point_indices_by_photo
from ambiguous_wild.splat.step import TrainData


class DenseStart(Effect):
    """Adds first Gaussians at points that several photos agree on."""

    name = "dense"

    def __init__(self) -> None:
        self.count = 0

    def first_points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        def photo(view: int) -> np.ndarray:  # one photo at a time, because photos may lie on a GPU
            return data.photos[view].cpu().numpy()

        keep = [None if k is None else k.cpu().numpy() for k in data.user_keep]
        xyz, rgb = dense_points(
            data.cameras, photo, data.scene.points.xyz, point_indices_by_photo(data.scene), keep, most
        )
        self.count = len(xyz)
        return xyz, rgb

    def facts(self) -> Facts:
        return {"points": self.count}


_MIN_POINTS = 10  # sparse points in a photo that give the range of its depths
_MAX_POINTS = 5000  # points that choose neighbours if the model has no tracks
SIDE = 160  # px, the longer side at which photos are compared
PHOTOS = 64  # largest number of photos used, evenly chosen
PLANES = 64  # evenly spaced in inverse depth
VIEWS = 4  # neighbours that a photo is compared with; the best two count
WINDOW = 7  # px
CORRELATION = 0.75  # least mean correlation with the best two neighbours
ALONE = 0.02  # least lead of the best correlation over those of all other depths
TOLERANCE = 0.02  # relative difference of depths that agree
AGREEING = 2  # photos whose depth must agree, out of 2 `VIEWS`
# degrees between two photos' rays: the best angle, spreads below and above it, and the least median angle
_ANGLE, _BELOW, _ABOVE, _MIN_ANGLE = 8.0, 4.0, 12.0, 1.0
_NOISE = 1e-5  # variance of grey in [0, 1] that noise has
_PEAK = 3  # planes around the best one that belong to its peak


@dataclass(frozen=True)
class _ReducedPhoto:
    """One photo, reduced."""

    camera: Camera  # for the size of the reduced photo
    rgb: np.ndarray  # [h, w, 3] float32
    grey: np.ndarray  # [h, w] float32
    shown: np.ndarray  # `grey`, with -1 where the photo is masked
    static: np.ndarray  # [h, w] bool, kept by the capture's own masks
    seen: np.ndarray  # indices of the sparse points it sees


def dense_points(
    cameras: Sequence[Camera],
    photo: Callable[[int], np.ndarray],
    sparse: np.ndarray,
    tracks: Sequence[np.ndarray],
    keep: Sequence[np.ndarray | None],
    most: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Find points on surfaces that at least three photos see at the same depth.

    Args:
        cameras: cameras of the photos.
        photo: returns the photo of a camera's index, [H, W, 3] in [0, 1], sRGB.
        sparse: [N, 3] points of the sparse model, which give the range of depths.
        tracks: for each photo the indices of its sparse points; may be empty.
        keep: for each photo [H, W], 1 = used; None = all is used.
        most: largest number of points to return.

    Returns:
        xyz [M, 3] float64 and rgb [M, 3] uint8. M is 0 where nothing agrees.
    """
    count = len(cameras)
    if most < 1 or not count:
        return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
    chosen = sorted({k * count // min(count, PHOTOS) for k in range(min(count, PHOTOS))})
    small = [_small(cameras[k], photo(k), keep[k], sparse, tracks[k], SIDE) for k in chosen]
    near = [_neighbours(small, k, sparse, 2 * VIEWS) for k in range(len(small))]
    depths = [_depth(own, [small[j] for j in near[k][:VIEWS]], sparse) for k, own in enumerate(small)]
    agreed = [
        _agreeing(small[k], depths[k], [(small[j], depths[j]) for j in near[k]]) for k in range(len(small))
    ]
    xyz, rgb = _thinned(small, agreed, most, TOLERANCE)
    return xyz, np.clip(np.rint(rgb * 255.0), 0, 255).astype(np.uint8)


def _small(
    camera: Camera, photo: np.ndarray, keep: np.ndarray | None, xyz: np.ndarray, track: np.ndarray, side: int
) -> _ReducedPhoto:
    share = min(1.0, side / max(photo.shape[:2]))
    size = tuple(max(round(n * share), 8) for n in photo.shape[1::-1])
    rgb = cv2.resize(np.ascontiguousarray(photo, np.float32), size, interpolation=cv2.INTER_AREA)
    static = np.ones(rgb.shape[:2], bool)
    if keep is not None:
        static = cv2.resize(np.ascontiguousarray(keep, np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    shrunk = camera.resized(*size)
    seen = np.asarray(track, np.int64)
    if len(seen) < _MIN_POINTS:  # a model without tracks: all points in the frame
        some = np.arange(0, len(xyz), max(-(-len(xyz) // _MAX_POINTS), 1))
        pixels, z = _projected(shrunk, xyz[some])
        seen = some[_inside(pixels, z, rgb.shape[:2])]
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    return _ReducedPhoto(shrunk, rgb, grey, np.where(static, grey, np.float32(-1.0)), static, seen)


def _neighbours(small: Sequence[_ReducedPhoto], at: int, xyz: np.ndarray, most: int) -> list[int]:
    """Return the photos with most common sparse points under good angles, best first (as MVSNet)."""
    own, scores = small[at], []
    for k, other in enumerate(small):
        both = np.intersect1d(own.seen, other.seen, assume_unique=True) if k != at else own.seen[:0]
        if len(both):
            a, b = xyz[both] - own.camera.center, xyz[both] - other.camera.center
            cosine = (a * b).sum(axis=1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
            angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
            if not np.median(angle) >= _MIN_ANGLE:  # from one place every depth looks the same
                continue
            spread = np.where(angle < _ANGLE, _BELOW, _ABOVE)
            scores.append((-float(np.exp(-0.5 * ((angle - _ANGLE) / spread) ** 2).sum()), k))
    return [k for _, k in sorted(scores)[:most]]


def _depth(photo: _ReducedPhoto, others: Sequence[_ReducedPhoto], xyz: np.ndarray) -> np.ndarray:
    """Return the depth [h, w] float32 of a photo; 0 where it is unknown."""
    shape = photo.grey.shape
    z = _projected(photo.camera, xyz[photo.seen])[1]
    z = z[z > 0]
    if len(z) < _MIN_POINTS or len(others) < 2:
        return np.zeros(shape, np.float32)
    # a few wrong points must not spread the planes
    near, middle, far = np.quantile(z, [0.02, 0.5, 0.98])
    near, far = max(near, middle / 4.0), min(far, 20.0 * middle)
    inverse = np.linspace(1.0 / (1.5 * far), 1.0 / (0.8 * near), PLANES)
    mean, variance = _moments(photo.grey, WINDOW)
    scores = np.empty((PLANES, *shape), np.float32)
    parts = [_plane_warp(photo.camera, other.camera) for other in others]
    for k, nearness in enumerate(inverse):
        first = np.full(shape, -1.0, np.float32)
        second = first.copy()
        for other, (homography, shift) in zip(others, parts):
            warp = homography + nearness * shift
            score = _correlation(photo.grey, mean, variance, other.shown, warp, WINDOW)
            second = np.maximum(second, np.minimum(first, score))
            first = np.maximum(first, score)
        scores[k] = 0.5 * (first + second)
    best = scores.argmax(axis=0)
    inner = np.clip(best, 1, PLANES - 2)
    below, top, above = (np.take_along_axis(scores, (inner + d)[None], axis=0)[0] for d in (-1, 0, 1))
    away = np.abs(np.arange(PLANES)[:, None, None] - best[None]) > _PEAK
    rival = np.where(away, scores, -1.0).max(axis=0)
    curve = below - 2.0 * top + above  # that of a parabola through the three scores around the best
    offset = np.where(curve < 0, 0.5 * (below - above) / np.where(curve < 0, curve, -1.0), 0.0).clip(
        -0.5, 0.5
    )
    depth = 1.0 / (inverse[0] + (inner + offset) * (inverse[1] - inverse[0]))
    sure = (inner == best) & (top > CORRELATION) & (rival < top - ALONE)
    return np.where(sure & photo.static & (variance > 10 * _NOISE), depth, 0.0).astype(np.float32)


def _plane_warp(camera: Camera, other: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return A, B [3, 3]: A + B / z maps pixels of a camera, on the plane of depth z, to the other camera."""
    to_other = other.cam_from_world @ np.linalg.inv(camera.cam_from_world)
    inner = _intrinsics(other)
    homography = inner @ to_other[:3, :3] @ np.linalg.inv(_intrinsics(camera))
    return homography, np.outer(inner @ to_other[:3, 3], [0.0, 0.0, 1.0])


def _correlation(
    grey: np.ndarray, mean: np.ndarray, variance: np.ndarray, other: np.ndarray, warp: np.ndarray, window: int
) -> np.ndarray:
    """Return ZNCC [h, w] of windows around pixels and around their images by `warp`; -1 outside `other`."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    drawn = cv2.warpPerspective(other, warp, grey.shape[::-1], flags=flags, borderValue=-1.0)
    height, width = grey.shape
    ends = np.array([[0, 0, 1], [width, 0, 1], [0, height, 1], [width, height, 1]]) @ warp[2]
    if ends.min() <= 0:  # part of the plane lies behind the other camera
        return np.full(grey.shape, -1.0, np.float32)
    outside = drawn < 0
    drawn[outside] = 0.0
    their_mean, their_variance = _moments(drawn, window)
    both = _box(grey * drawn, window) - mean * their_mean
    score = both / np.sqrt((variance + _NOISE) * (their_variance + _NOISE))
    score[outside] = -1.0
    return score


def _moments(grey: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    mean = _box(grey, window)
    return mean, np.maximum(_box(grey * grey, window) - mean * mean, 0.0)


def _box(x: np.ndarray, window: int) -> np.ndarray:
    return cv2.blur(x, (window, window), borderType=cv2.BORDER_REFLECT)


def _agreeing(
    photo: _ReducedPhoto, depth: np.ndarray, others: Sequence[tuple[_ReducedPhoto, np.ndarray]]
) -> np.ndarray:
    """Keep the depths [h, w] that enough other photos agree with; 0 elsewhere."""
    rows, columns = np.nonzero(depth > 0)
    world = _world(photo.camera, columns, rows, depth[rows, columns])
    votes = np.zeros(len(world), np.int64)
    for other, theirs in others:
        votes += _same_surface(other.camera, theirs, world, TOLERANCE)
    agreed = np.zeros_like(depth)
    sure = votes >= AGREEING
    agreed[rows[sure], columns[sure]] = depth[rows[sure], columns[sure]]
    return agreed


def _same_surface(camera: Camera, depth: np.ndarray, world: np.ndarray, tolerance: float) -> np.ndarray:
    """Return which world points [N, 3] lie at the depth that a camera's map [h, w] has there, [N] bool."""
    pixels, z = _projected(camera, world)
    same = _inside(pixels, z, depth.shape)
    at = np.clip(np.rint(np.nan_to_num(pixels[same])).astype(np.int64), 0, np.array(depth.shape[::-1]) - 1)
    map_depth = depth[at[:, 1], at[:, 0]]
    same[same] = (map_depth > 0) & (np.abs(map_depth - z[same]) < tolerance * z[same])
    return same


def _thinned(
    small: Sequence[_ReducedPhoto], depths: Sequence[np.ndarray], most: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    """Choose points evenly over the photos, each surface once: xyz [M, 3], rgb [M, 3] in [0, 1], M <= most.

    One point is taken per cell of a photo, so a close surface gets denser points than a far one.
    """
    cell, longest = 2, max(max(photo.grey.shape) for photo in small)
    while True:
        xyz, rgb = _one_a_cell(small, depths, cell, tolerance)
        if len(xyz) <= most or cell > longest:
            # there are more photos than points: choose evenly
            some = np.arange(min(len(xyz), most)) * len(xyz) // max(min(len(xyz), most), 1)
            return xyz[some], rgb[some]
        # the number of points falls with the square of the cell
        cell = max(cell + 1, math.floor(cell * math.sqrt(len(xyz) / most)))


def _one_a_cell(
    small: Sequence[_ReducedPhoto], depths: Sequence[np.ndarray], cell: int, tolerance: float
) -> tuple[np.ndarray, np.ndarray]:
    xyz, rgb = np.zeros((0, 3)), np.zeros((0, 3))
    for photo, depth in zip(small, depths):
        shape = depth.shape
        taken = np.zeros((shape[0] // cell + 1, shape[1] // cell + 1), bool)
        pixels, z = _projected(photo.camera, xyz)
        at = np.flatnonzero(_inside(pixels, z, shape))
        x, y = np.clip(np.rint(pixels[at]).astype(np.int64), 0, np.array(shape[::-1]) - 1).T
        # a point that is hidden in this photo takes no cell
        shown = (depth[y, x] == 0) | (z[at] < (1.0 + 2 * tolerance) * depth[y, x])
        taken[y[shown] // cell, x[shown] // cell] = True
        rows, columns = np.nonzero(depth > 0)
        free = ~taken[rows // cell, columns // cell]
        rows, columns = rows[free], columns[free]
        # take the pixel nearest to the centre of each free cell
        away = np.hypot(rows % cell - (cell - 1) / 2, columns % cell - (cell - 1) / 2)
        order = np.lexsort((columns, rows, away))
        cells = rows // cell * taken.shape[1] + columns // cell
        _, first = np.unique(cells[order], return_index=True)
        rows, columns = rows[order][first], columns[order][first]
        xyz = np.concatenate([xyz, _world(photo.camera, columns, rows, depth[rows, columns])])
        rgb = np.concatenate([rgb, photo.rgb[rows, columns]])
    return xyz, rgb


def _intrinsics(camera: Camera) -> np.ndarray:
    """Return K [3, 3] for OpenCV, whose pixel centres are whole numbers."""
    k = camera.intrinsics
    k[:2, 2] -= 0.5
    return k


def _projected(camera: Camera, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points to pixels (x, y) [N, 2], with whole numbers at centres, and depths [N]."""
    local = xyz @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
    z = local[:, 2]
    safe = np.where(z > 0, z, 1.0)
    pixels = local[:, :2] / safe[:, None] * [camera.fx, camera.fy] + [camera.cx - 0.5, camera.cy - 0.5]
    return pixels, z


def _inside(pixels: np.ndarray, z: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    return (z > 0) & (pixels > -0.5).all(axis=1) & (pixels < np.array(shape[1::-1]) - 0.5).all(axis=1)


def _world(camera: Camera, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return the world points [N, 3] of pixels at depths z."""
    local = np.stack(
        [(x + 0.5 - camera.cx) / camera.fx * z, (y + 0.5 - camera.cy) / camera.fy * z, z], axis=1
    ).astype(np.float64)
    return (local - camera.cam_from_world[:3, 3]) @ camera.cam_from_world[:3, :3]
