"""Compare photos on the surfaces they share: exposure, colour, sharpness, overlap.

A photo's mean brightness depends on what it shows. On surfaces that two photos share (SIFT matches of one
epipolar geometry) the median difference comes from the camera settings. Least squares over all pairs gives
one offset a photo.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ambiguous_wild.builder.fixed_to_camera import FixedArea, find_fixed
from ambiguous_wild.builder.overlap_graph import component_labels
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.core.srgb import srgb_to_linear

SIDE = 800  # px, longer side at which photos are compared
FEATURES = 2000  # with 1000, sparse captures look as if they fell apart: half of every third of monstree
RATIO = 0.8  # Lowe's ratio test
MIN_OVERLAP_INLIERS = 16  # matches of one epipolar geometry for two photos to overlap
# Fewer matches are enough if a third photo confirms some of them, by a feature that matches both. With 16
# alone, a walk of 29 photos that COLMAP places whole seems to fall into 24 and 5.
MIN_MATCHES, CONFIRMED = 12, 2
# Candidates of each photo: the next photos, and those of the most similar coarse colours.
NEXT_PHOTOS, SIMILAR_PHOTOS = 4, 8
EXTRA_CANDIDATES = 60  # further candidates of a photo that overlaps with none or one of these
FOCAL = 0.9  # of the longer side, of most phones and cameras
ALONG = 0.8  # |t_z| / |t| from which on two cameras differ by motion along the line of sight
_PATCH = 4  # px, half a patch around a feature
QUANTITIES = ("exposure", "red", "blue", "sharpness")  # log2 each; red and blue over green


Matches = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]  # two photos -> matching features, [M] each


@dataclass(frozen=True)
class PhotoFeatures:
    """Features and colours of one photo, about 300 kB, from which photos are compared."""

    size: tuple[int, int]  # width and height at which it is compared, px
    xy: np.ndarray  # [F, 2] float32 px
    descriptors: np.ndarray  # [F, 128] uint8
    values: np.ndarray  # [F, 4] float32, `QUANTITIES` around each feature; NaN where clipped or too dark
    coarse_colours: np.ndarray  # [96] float32, unit length: to find photos of the same place


@dataclass(frozen=True)
class PhotoComparison:
    """Result of the comparison, over all pairs."""

    offsets: np.ndarray  # [N, 4] float64, log2, median 0; NaN for photos without a covisible one
    covisible: np.ndarray  # [N] int, photos that overlap with it
    forward: float  # share of overlapping pairs that differ by motion along the line of sight; NaN: no pair
    fixed: list[FixedArea]  # fixed to the camera; its features are not compared
    matches: Matches
    pairs: int = 0  # compared, those without enough matches included

    @property
    def links(self) -> list[tuple[int, int, int]]:
        """Pairs of photos that overlap, with the number of their matches."""
        return [(*pair, len(rows)) for pair, (rows, _) in sorted(self.matches.items())]


def photo_features(
    rgb: np.ndarray,  # [H, W, 3] uint8
) -> PhotoFeatures:
    """Find SIFT features of a photo, and measure brightness, colour and sharpness around each."""
    scale = SIDE / max(rgb.shape[:2])
    small = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else rgb
    gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
    sift = getattr(cv2, "SIFT_create")  # noqa: B009 - absent from OpenCV's own stubs
    points, descriptors = sift(FEATURES).detectAndCompute(gray, None)
    if descriptors is None:
        points, descriptors = [], np.zeros((0, 128))
    xy = np.array([p.pt for p in points], np.float32).reshape(-1, 2)
    size = (small.shape[1], small.shape[0])
    return PhotoFeatures(
        size, xy, descriptors.astype(np.uint8), _values(small, gray, xy), _coarse_colours(small)
    )


def _values(small: np.ndarray, gray: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Measure `QUANTITIES` in a patch around each feature, [F, 4]."""
    codes = small.astype(np.float32) / 255
    linear = srgb_to_linear(codes)
    size = (2 * _PATCH + 1, 2 * _PATCH + 1)
    colour = cv2.blur(linear, size)
    laplacian = cv2.Laplacian(gray, cv2.CV_32F)
    # Fine detail is divided by contrast below, so that exposure does not count as sharpness.
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


def _coarse_colours(small: np.ndarray) -> np.ndarray:
    """Return the mean colours of 8 x 4 cells less their mean, similar for photos of the same thing."""
    cells = cv2.resize(small, (8, 4), interpolation=cv2.INTER_AREA).astype(np.float32).reshape(-1, 3)
    cells -= cells.mean(axis=0)
    return (cells / max(float(np.linalg.norm(cells)), 1e-6)).ravel()


def compare_photos(
    features: Sequence[PhotoFeatures],  # in the order of capture, where known
    bar: Bar | None = None,
    jobs: int = 1,  # threads; the result does not depend on it
) -> PhotoComparison:
    """Match each photo with the next and the most similar ones; solve for one offset a photo."""
    bar = bar or Bar(False)
    ordered = candidate_pairs(features)
    raw = _all_raw_matches(features, ordered, "comparing photos", bar, jobs)
    sizes = [f.size for f in features]
    fixed = find_fixed([f.xy for f in features], sizes, [0] * len(features), raw)
    if fixed:
        rest = _without(features, fixed)
        fewer = {k for k, (f, g) in enumerate(zip(features, rest)) if len(g.xy) < len(f.xy)}
        again = [pair for pair in ordered if fewer & set(pair)]
        features = rest
        raw |= _all_raw_matches(features, again, "comparing photos without what is fixed", bar, jobs)
    count = len(features)
    graph = np.zeros((count, count), bool)
    matches: Matches = {}
    rows: list[tuple[int, int, np.ndarray, float]] = []
    forward: list[bool] = []

    def enter(i: int, j: int, inliers: tuple[np.ndarray, np.ndarray] | None) -> None:
        if inliers is None:
            return
        matches[i, j] = inliers
        if len(inliers[0]) < MIN_OVERLAP_INLIERS:
            return  # too few for the direction of motion and the settings
        graph[i, j] = graph[j, i] = True
        forward.append(is_forward(features[i].xy[inliers[0]], features[j].xy[inliers[1]], features[i].size))
        difference = features[i].values[inliers[0]] - features[j].values[inliers[1]]
        good = np.isfinite(difference).all(axis=1)
        if good.sum() >= MIN_OVERLAP_INLIERS // 2:
            rows.append((i, j, np.median(difference[good], axis=0), float(np.sqrt(good.sum()))))

    def enter_all(pairs: Sequence[tuple[int, int]], raw: Mapping[tuple[int, int], np.ndarray]) -> None:
        # OpenCV keeps random numbers per thread, and each match seeds them: the result is deterministic.
        with ThreadPoolExecutor(jobs) as pool:
            for pair, inliers in zip(pairs, pool.map(lambda p: _match(features, p, raw[p]), pairs)):
                enter(*pair, inliers)

    enter_all(ordered, raw)
    # A photo that overlaps with few others is tried against more candidates before it counts as isolated.
    labels = component_labels(count, np.argwhere(graph))
    lonely = np.flatnonzero((labels != 0) | (graph.sum(axis=1) < 2)).tolist()
    more = [(min(i, j), max(i, j)) for i in lonely for j in most_similar(features, i, EXTRA_CANDIDATES)]
    more = [pair for pair in dict.fromkeys(more) if pair not in raw]
    raw |= _all_raw_matches(features, more, "comparing photos that overlap with few", bar, jobs)
    enter_all(more, raw)
    share = float(np.mean(forward)) if forward else math.nan
    return PhotoComparison(
        _solve(count, rows), graph.sum(axis=1), share, fixed, confirmed_matches(matches), len(raw)
    )


def confirmed_matches(matches: Matches) -> Matches:
    """Leave out pairs of fewer than `MIN_OVERLAP_INLIERS` matches that no third photo confirms."""
    matched_features: dict[
        int, dict[int, dict[int, int]]
    ] = {}  # photo -> other photo -> feature -> its feature
    for (a, b), (one, two) in matches.items():
        matched_features.setdefault(a, {})[b] = dict(zip(one.tolist(), two.tolist()))
        matched_features.setdefault(b, {})[a] = dict(zip(two.tolist(), one.tolist()))

    def confirms(third: int, a: int, b: int) -> bool:
        first, second = matched_features[a][third], matched_features[b][third]
        both = ((first.get(f), second.get(g)) for f, g in matched_features[a][b].items())
        return sum(f is not None and f == g for f, g in both) >= CONFIRMED

    sure: Matches = {}
    for (a, b), ends in matches.items():
        third = matched_features[a].keys() & matched_features[b].keys()
        if len(ends[0]) >= MIN_OVERLAP_INLIERS or any(confirms(c, a, b) for c in third):
            sure[a, b] = ends
    return sure


def is_forward(
    a: np.ndarray,  # [M, 2] px, matches of one geometry
    b: np.ndarray,  # [M, 2] px
    size: tuple[int, int],  # width and height of both photos, px
) -> bool:
    """Tell whether the camera moved along the line of sight, by the direction of motion of a usual lens."""
    focal = FOCAL * max(size)
    camera = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1]])
    cv2.setRNGSeed(0)
    a, b = a.astype(np.float64), b.astype(np.float64)
    essential, inlier = cv2.findEssentialMat(a, b, camera, cv2.RANSAC, 0.999, 1.0)
    if essential is None or essential.shape != (3, 3):
        return False
    _, _, direction, _ = cv2.recoverPose(essential, a, b, camera, mask=inlier)
    return abs(float(direction[2, 0])) > ALONG


def candidate_pairs(features: Sequence[PhotoFeatures]) -> list[tuple[int, int]]:
    """Choose pairs to match: all of a small capture, else each photo with the next and most similar ones."""
    count = len(features)
    if count <= NEXT_PHOTOS + SIMILAR_PHOTOS:
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    colours = np.stack([f.coarse_colours for f in features])
    alike = colours @ colours.T
    np.fill_diagonal(alike, -np.inf)
    pairs = {(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + NEXT_PHOTOS, count))}
    for i in range(count):
        pairs |= {
            (min(i, int(j)), max(i, int(j))) for j in np.argsort(-alike[i], kind="stable")[:SIMILAR_PHOTOS]
        }
    return sorted(pairs)


def most_similar(features: Sequence[PhotoFeatures], index: int, most: int) -> list[int]:
    """Return the indices of the photos most similar to one, the most similar first."""
    alike = np.array([f.coarse_colours @ features[index].coarse_colours for f in features])
    return [int(j) for j in np.argsort(-alike, kind="stable") if j != index][:most]


def _without(features: Sequence[PhotoFeatures], fixed: Sequence[FixedArea]) -> list[PhotoFeatures]:
    """Return the photos without the features of what is fixed to the camera."""
    seen = list(features)
    for area in fixed:
        for k in area.photos:
            rest = ~area.covers(seen[k].xy)
            parts = {name: getattr(seen[k], name)[rest] for name in ("xy", "descriptors", "values")}
            seen[k] = replace(seen[k], **parts)
    return seen


def _raw_matches(
    features: Sequence[PhotoFeatures], pair: tuple[int, int]
) -> np.ndarray:  # [K, 2] features of the pair's photos
    """Match two photos, without a check of the geometry; both need `MIN_MATCHES` features."""
    a, b = (features[k] for k in pair)
    if min(len(a.xy), len(b.xy)) < MIN_MATCHES:
        return np.zeros((0, 2), int)
    return np.column_stack(_ratio_matches(a.descriptors, b.descriptors))


def _all_raw_matches(
    features: Sequence[PhotoFeatures], pairs: Sequence[tuple[int, int]], what: str, bar: Bar, jobs: int
) -> dict[tuple[int, int], np.ndarray]:
    """Match many pairs, with a bar: this takes nearly all the time of a comparison."""

    def match(pair: tuple[int, int]) -> np.ndarray:
        rows = _raw_matches(features, pair)
        bar.step()
        return rows

    if not pairs:
        return {}
    bar.start(what, len(pairs))
    with ThreadPoolExecutor(jobs) as pool:
        matches = dict(zip(pairs, pool.map(match, pairs)))
    bar.finish()
    return matches


def _match(
    features: Sequence[PhotoFeatures],
    pair: tuple[int, int],
    matches: np.ndarray,  # of `_raw_matches`
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the indices of matching features in each photo; None where they are too few."""
    (a, b), (one, two) = (features[k] for k in pair), matches.T
    if len(one) < MIN_MATCHES:
        return None
    cv2.setRNGSeed(0)
    _, inlier = cv2.findFundamentalMat(a.xy[one], b.xy[two], cv2.FM_RANSAC, 2.0, 0.99, 500)
    if inlier is None or int(inlier.sum()) < MIN_MATCHES:
        return None
    keep = inlier.ravel() > 0
    return one[keep], two[keep]


def _ratio_matches(
    a: np.ndarray,  # [F, 128] uint8
    b: np.ndarray,  # [G, 128] uint8
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of matches that pass Lowe's ratio test.

    Distances come from a matrix product: sums of squares of bytes are exact in float32, and it takes a third
    of the time of OpenCV's matcher (1000 features).
    """
    x, y = a.astype(np.float32), b.astype(np.float32)
    squared = (x * x).sum(axis=1)[:, None] + (y * y).sum(axis=1)[None] - 2 * (x @ y.T)
    rows, nearest = np.arange(len(x)), np.argmin(squared, axis=1)
    first = np.sqrt(squared[rows, nearest])
    squared[rows, nearest] = np.inf
    good = first < RATIO * np.sqrt(squared.min(axis=1))
    return rows[good], nearest[good]


def _solve(count: int, rows: list[tuple[int, int, np.ndarray, float]]) -> np.ndarray:
    """Solve for offsets [N, 4] whose differences fit the pairs' medians; NaN for photos without a pair."""
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
