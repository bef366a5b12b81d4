"""What photos of the same surfaces say about the camera: exposure, colour, sharpness, overlap.

A photo's brightness says little, since it depends on what is in the picture. The same surface in two photos
does: SIFT matches that obey one epipolar geometry are such surfaces, and the median difference over them is
that of the camera's settings. Least squares over all pairs gives one number a photo.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

SIDE = 800  # px, longer side at which photos are compared
FEATURES = 1000
RATIO = 0.8  # Lowe's ratio test
MIN_INLIERS = 16  # matches of one geometry from which two photos overlap
AFTER, ALIKE = 4, 8  # partners of a photo: the next ones, and those whose coarse colours are most alike
LAST_RESORT = 60  # partners tried for a photo that seems to stand alone
_PATCH = 4  # px, half a patch around a feature
QUANTITIES = ("exposure", "red", "blue", "sharpness")  # log2 each; red and blue over green


@dataclass(frozen=True)
class Signature:
    """What is kept of a photo: about 150 kB."""

    xy: np.ndarray  # [F, 2] float32 px
    descriptors: np.ndarray  # [F, 128] uint8
    values: np.ndarray  # [F, 4] float32, `QUANTITIES` around each feature; NaN where clipped or too dark
    look: np.ndarray  # [96] float32, unit: coarse colours, for finding partners


@dataclass(frozen=True)
class Compared:
    """All pairs together."""

    offsets: np.ndarray  # [N, 4] float64, log2, median 0; NaN for photos without a partner
    partners: np.ndarray  # [N] int, photos that overlap with it
    group: np.ndarray  # [N] int, connected groups of overlapping photos; 0 is the largest
    forward: float  # share of the overlapping pairs that differ by motion along the line of sight; NaN: none


def signature(
    rgb: np.ndarray,  # [H, W, 3] uint8
) -> Signature:
    """Features of a photo and what the camera made of the surfaces around them."""
    scale = SIDE / max(rgb.shape[:2])
    small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    sift = getattr(cv2, "SIFT_create")  # noqa: B009 - absent from OpenCV's own stubs
    points, descriptors = sift(FEATURES).detectAndCompute(gray, None)
    if descriptors is None:
        points, descriptors = [], np.zeros((0, 128))
    xy = np.array([p.pt for p in points], np.float32).reshape(-1, 2)
    return Signature(xy, descriptors.astype(np.uint8), _values(small, gray, xy), _look(small))


def _values(small: np.ndarray, gray: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """`QUANTITIES` in a patch around each feature, [F, 4]."""
    codes = small.astype(np.float32) / 255
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    size = (2 * _PATCH + 1, 2 * _PATCH + 1)
    colour = cv2.blur(linear, size)
    laplacian = cv2.Laplacian(gray, cv2.CV_32F)
    # Contrast is taken out, so that exposure does not count as sharpness.
    fine = np.sqrt(cv2.blur(laplacian * laplacian, size))
    mean = cv2.blur(gray.astype(np.float32), size)
    contrast = np.sqrt(np.maximum(cv2.blur(gray.astype(np.float32) ** 2, size) - mean * mean, 0.0))
    col = np.clip(np.round(xy[:, 0]).astype(int), 0, gray.shape[1] - 1)
    row = np.clip(np.round(xy[:, 1]).astype(int), 0, gray.shape[0] - 1)
    c = colour[row, col]
    clipped = cv2.dilate((small.max(axis=2) >= 250).astype(np.uint8), np.ones(size, np.uint8))[row, col] > 0
    usable = ~clipped & (c.min(axis=1) > 0.004) & (contrast[row, col] > 2.0)
    c = np.maximum(c, 1e-4)
    luma = c @ np.array([0.2126, 0.7152, 0.0722], np.float32)
    sharp = np.maximum(fine[row, col], 1e-3) / np.maximum(contrast[row, col], 1e-3)
    values = np.log2(np.stack([luma, c[:, 0] / c[:, 1], c[:, 2] / c[:, 1], sharp], axis=1))
    return np.where(usable[:, None], values, np.nan).astype(np.float32)


def _look(small: np.ndarray) -> np.ndarray:
    """8 x 4 cells of mean colour without the mean: which photos show the same thing, roughly."""
    cells = cv2.resize(small, (8, 4), interpolation=cv2.INTER_AREA).astype(np.float32).reshape(-1, 3)
    cells -= cells.mean(axis=0)
    return (cells / max(float(np.linalg.norm(cells)), 1e-6)).ravel()


def compare(
    signatures: Sequence[Signature],  # in the order they were taken, where that is known
    step: Callable[[], None] = lambda: None,
) -> Compared:
    """Match photos with those that follow and those that look alike; solve for one number a photo."""
    count = len(signatures)
    graph = np.zeros((count, count), bool)
    rows: list[tuple[int, int, np.ndarray, float]] = []
    forward: list[bool] = []

    def try_pair(i: int, j: int) -> None:
        found = _match(signatures[i], signatures[j])
        if found is None:
            return
        graph[i, j] = graph[j, i] = True
        forward.append(is_forward(signatures[i].xy[found[0]], signatures[j].xy[found[1]]))
        difference = signatures[i].values[found[0]] - signatures[j].values[found[1]]
        good = np.isfinite(difference).all(axis=1)
        if good.sum() >= MIN_INLIERS // 2:
            rows.append((i, j, np.median(difference[good], axis=0), float(np.sqrt(good.sum()))))

    tried = set(partners_of(signatures))
    for i, j in sorted(tried):
        try_pair(i, j)
        step()
    # Before a photo is said to stand alone it is tried with all that look at all like it.
    groups = _groups(graph)
    for i in np.flatnonzero((groups != 0) | (graph.sum(axis=1) < 2)).tolist():
        for j in nearest_looks(signatures, i, LAST_RESORT):
            if (pair := (min(i, j), max(i, j))) not in tried:
                tried.add(pair)
                try_pair(*pair)
    share = float(np.mean(forward)) if forward else math.nan
    return Compared(_solve(count, rows), graph.sum(axis=1), _groups(graph), share)


def is_forward(
    a: np.ndarray,  # [M, 2] px, matches of one geometry
    b: np.ndarray,  # [M, 2] px
) -> bool:
    """Whether the picture grows or shrinks about a point inside it: motion along the line of sight.

    A similarity fits the matches; it must scale by over 3 %, turn by less than it scales, and have its fixed
    point among the matches. Points near it hardly move, so their depth cannot be triangulated.
    """
    cv2.setRNGSeed(0)
    fit, _ = cv2.estimateAffinePartial2D(a, b, ransacReprojThreshold=0.02 * SIDE)
    if fit is None:
        return False
    cos, sin = float(fit[0, 0]), float(fit[1, 0])
    growth = abs(math.log(max(math.hypot(cos, sin), 1e-6)))
    if growth < math.log(1.03) or abs(math.atan2(sin, cos)) > growth:
        return False
    fixed = np.linalg.solve(np.eye(2) - fit[:, :2], fit[:, 2])
    low, high = np.percentile(a, [5, 95], axis=0)
    return bool(((fixed > low) & (fixed < high)).all())


def partners_of(signatures: Sequence[Signature]) -> list[tuple[int, int]]:
    """Pairs worth matching: all of a small capture, else the next photos and those that look alike."""
    count = len(signatures)
    if count <= AFTER + ALIKE:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    looks = np.stack([s.look for s in signatures])
    alike = looks @ looks.T
    np.fill_diagonal(alike, -np.inf)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + AFTER, count))}
    for i in range(count):
        pairs |= {(min(i, int(j)), max(i, int(j))) for j in np.argsort(-alike[i], kind="stable")[:ALIKE]}
    return sorted(pairs)


def nearest_looks(signatures: Sequence[Signature], index: int, most: int) -> list[int]:
    """The photos most like one, nearest first."""
    alike = np.array([s.look @ signatures[index].look for s in signatures])
    return [int(j) for j in np.argsort(-alike, kind="stable") if j != index][:most]


def _match(a: Signature, b: Signature) -> tuple[np.ndarray, np.ndarray] | None:
    """Indices of matching features in both photos; None where the photos do not overlap."""
    if min(len(a.xy), len(b.xy)) < MIN_INLIERS:
        return None
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(
        a.descriptors.astype(np.float32), b.descriptors.astype(np.float32), k=2
    )
    good = [m[0] for m in nearest if len(m) == 2 and m[0].distance < RATIO * m[1].distance]
    if len(good) < MIN_INLIERS:
        return None
    one = np.array([m.queryIdx for m in good])
    two = np.array([m.trainIdx for m in good])
    cv2.setRNGSeed(0)
    _, inlier = cv2.findFundamentalMat(a.xy[one], b.xy[two], cv2.FM_RANSAC, 2.0, 0.99, 500)
    if inlier is None or int(inlier.sum()) < MIN_INLIERS:
        return None
    keep = inlier.ravel() > 0
    return one[keep], two[keep]


def _solve(count: int, rows: list[tuple[int, int, np.ndarray, float]]) -> np.ndarray:
    """Offsets [N, 4] whose differences fit the pairs' medians best; NaN where no pair says anything."""
    offsets = np.full((count, len(QUANTITIES)), np.nan)
    if not rows:
        return offsets
    from scipy.sparse import csr_matrix
    from scipy.sparse.linalg import lsqr

    weight = np.array([w for *_, w in rows])
    index = np.arange(len(rows))
    i, j = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    data = np.concatenate([weight, -weight])
    matrix = csr_matrix((data, (np.r_[index, index], np.r_[i, j])), shape=(len(rows), count))
    seen = np.unique(np.r_[i, j])
    for q in range(len(QUANTITIES)):
        solved = lsqr(matrix, weight * np.array([r[2][q] for r in rows]))[0]
        offsets[seen, q] = solved[seen] - np.median(solved[seen])
    return offsets


def _groups(graph: np.ndarray) -> np.ndarray:
    """Connected groups of photos, numbered by size, 0 the largest."""
    from scipy.sparse.csgraph import connected_components

    _, label = connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(label), kind="stable")
    return np.argsort(order)[label]
