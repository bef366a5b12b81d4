"""Segments of photos: graph segments in Lab, their groups by a network's features, Ward's clusters of a grid.

Groups are a cheap stand-in for SAM that needs no hub: OpenCV's graph segmentation (Felzenszwalb and
Huttenlocher 2004) draws the outlines, and the network's features decide which segments belong together.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits, config_hash
from ambiguous_wild.io.images import ximgproc
from ambiguous_wild.vision.protocols import Features

_REFERENCE_PIXELS = 240 * 135  # k and min_size are for this size and scale with the pixel count
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # half of the 8; the other half is their mirror


@dataclass(frozen=True)
class SegmentConfig:
    """Many small segments, because one that mixes a distractor and background of the same colour is useless.

    Best IoU with the true mask that whole segments can reach, on 30 simulated photos of 240x135: 0.57 for 30
    to 70 segments, 0.76 for 70 to 140, 0.77 for 120 to 240.
    """

    sigma: float = 0.5  # px, smoothing before the graph is built
    k: float = 100.0  # initial scale, at 240x135
    min_size: int = 30  # px at 240x135; smaller segments are merged away
    fewest: int = 70  # wanted number of segments at least
    most: int = 140  # wanted number at most
    tries: int = 3  # steps of the bisection on k; the closest result is kept

    def __post_init__(self) -> None:
        check_limits(
            self,
            "segments",
            sigma=(0, math.inf),
            k=(1e-6, math.inf),
            min_size=(1, math.inf),
            tries=(1, math.inf),
        )
        if not 1 <= self.fewest <= self.most:
            raise AwError(f"segments: need 1 <= fewest <= most, got {self.fewest} and {self.most}")


class GraphSegments:
    """Many small segments a photo, none a whole object; residuals and features merge them later."""

    def __init__(self, config: SegmentConfig | None = None) -> None:
        self.config = config or SegmentConfig()
        own = self.config != SegmentConfig()
        self.name = "graph-lab-1" + (f"-{config_hash(self.config)[:8]}" if own else "")

    def labels(self, photo: Tensor) -> np.ndarray:
        """Segments [H, W] int32 from 1 of a photo [H, W, 3] in [0, 1]; deterministic."""
        rgb = (photo.detach().cpu().numpy().clip(0.0, 1.0) * 255.0).round().astype(np.uint8)
        lab = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2LAB)
        return graph_segment(lab, self.config)


def graph_segment(lab: np.ndarray, config: SegmentConfig) -> np.ndarray:
    """Labels [H, W] int32 from 1 of an 8-bit image [H, W, 3]; bisects k for the wanted count.

    The count decreases with k. Three tries reach the range on most photos; a photo without structure stays
    below it.
    """
    growth = lab.shape[0] * lab.shape[1] / _REFERENCE_PIXELS
    smallest = max(round(config.min_size * growth), 1)
    log_k, step = math.log(config.k * max(growth, 1e-3)), math.log(4.0)
    best: np.ndarray | None = None
    best_miss = math.inf
    for _ in range(config.tries):
        labels = (
            ximgproc()
            .segmentation.createGraphSegmentation(config.sigma, math.exp(log_k), smallest)
            .processImage(lab)
            .astype(np.int32)
        )
        count = int(labels.max()) + 1
        miss = max(config.fewest - count, count - config.most, 0)
        if miss < best_miss:
            best, best_miss = labels, miss
        if miss == 0:
            break
        log_k += step if count > config.most else -step
        step /= 2.0
    assert best is not None  # tries >= 1
    return _compact(best)


def _compact(labels: np.ndarray) -> np.ndarray:
    """Renumber labels to 1..K without gaps."""
    _, inverse = np.unique(labels, return_inverse=True)
    return (inverse.reshape(labels.shape) + 1).astype(np.int32)


def ward_clusters(grid: np.ndarray, count: int) -> np.ndarray:
    """Labels [h, w] int32, 0 to count - 1, of a grid of features [h, w, C].

    At each step the two touching clusters join whose union adds least to the sum of squared distances to
    their means: |a| |b| / (|a| + |b|) times the squared distance of the means (Ward, 1963). Cells touch in 8
    directions. Of equal costs the pair that was found first joins, so equal grids give equal labels.
    """
    h, w, channels = grid.shape
    means = list(grid.reshape(-1, channels).astype(np.float64))
    sizes = [1] * (h * w)
    near: list[set[int]] = [set() for _ in means]
    for r in range(h):
        for c in range(w):
            for dr, dc in _NEIGHBOURS:
                if r + dr < h and 0 <= c + dc < w:
                    near[r * w + c].add((r + dr) * w + c + dc)
                    near[(r + dr) * w + c + dc].add(r * w + c)
    parent = list(range(h * w))

    def cost(a: int, b: int) -> float:
        apart = means[a] - means[b]
        return sizes[a] * sizes[b] / (sizes[a] + sizes[b]) * float(apart @ apart)

    heap = [(cost(a, b), a, b) for a in range(h * w) for b in near[a] if a < b]
    heapq.heapify(heap)
    alive, left = [True] * (h * w), h * w
    while left > count and heap:
        _, a, b = heapq.heappop(heap)
        if not (alive[a] and alive[b]):
            continue
        union = len(means)
        total = sizes[a] + sizes[b]
        means.append((means[a] * sizes[a] + means[b] * sizes[b]) / total)
        sizes.append(total)
        alive[a] = alive[b] = False
        alive.append(True)
        parent.append(union)
        parent[a] = parent[b] = union
        near.append({n for n in near[a] | near[b] if alive[n]})
        for n in sorted(near[union]):
            near[n].add(union)
            heapq.heappush(heap, (cost(n, union), n, union))
        left -= 1
    roots = np.arange(len(parent))
    for i in range(len(parent) - 1, -1, -1):  # a parent's number is larger than its child's
        roots[i] = i if parent[i] == i else roots[parent[i]]
    return np.unique(roots[: h * w], return_inverse=True)[1].reshape(h, w).astype(np.int32)


@dataclass(frozen=True)
class GroupConfig:
    """When the grouping of segments stops."""

    alike: float = 0.5  # neighbours merge up to this quantile of the photo's distances between neighbours
    fewest: int = 20  # at least this many groups stay
    segments: SegmentConfig = field(default_factory=SegmentConfig)  # the segments that are grouped

    def __post_init__(self) -> None:
        check_limits(self, "grouped segments", alike=(0, 1), fewest=(1, np.inf))


class GroupedSegments:
    """Groups of graph segments with similar features; implements the `Instances` protocol."""

    def __init__(self, features: Features, config: GroupConfig | None = None) -> None:
        self.features, self.config = features, config or GroupConfig()
        self.name = f"grouped-1-{features.name}-{config_hash(self.config)[:8]}"
        self._segments = GraphSegments(self.config.segments)

    @torch.no_grad()
    def labels(self, photo: Tensor) -> np.ndarray:
        """Labels [H, W] int32 from 1 of a photo [H, W, 3] in [0, 1]; deterministic."""
        segments = self._segments.labels(photo)
        phi = self.features(photo).double().cpu().numpy()
        return merge_segments(segments, segment_features(segments, phi), self.config)


def segment_features(
    labels: np.ndarray,  # [H, W] int, 1..K
    phi: np.ndarray,  # [h, w, C]
) -> np.ndarray:  # [K, C] float64
    """Mean features of each segment, over the cells its pixels lie in, minus the photo's mean."""
    height, width = labels.shape
    rows = (np.arange(height) * phi.shape[0]) // height
    columns = (np.arange(width) * phi.shape[1]) // width
    cells = rows[:, None] * phi.shape[1] + columns[None, :]
    count, size = int(labels.max()), phi.shape[0] * phi.shape[1]
    shares = np.bincount((labels.astype(np.int64) - 1).ravel() * size + cells.ravel(), minlength=count * size)
    shares = shares.reshape(count, size).astype(np.float64)
    centred = phi.reshape(size, -1) - phi.reshape(size, -1).mean(0)
    return shares @ centred / shares.sum(1, keepdims=True)


def merge_segments(
    labels: np.ndarray,  # [H, W] int, 1..K
    features: np.ndarray,  # [K, C]
    config: GroupConfig,
) -> np.ndarray:  # [H, W] int32 from 1, without gaps
    """Merge neighbouring segments, the most similar first; a group has the mean features of its pixels."""
    pairs = neighbours(labels) - 1
    sums = features * np.bincount(labels.ravel(), minlength=len(features) + 1)[1:, None]
    apart = np.full((len(features), len(features)), np.inf)  # between neighbours
    apart[pairs[:, 0], pairs[:, 1]] = apart[pairs[:, 1], pairs[:, 0]] = _distance(*sums[pairs.T])
    if not len(pairs):
        return labels.astype(np.int32)
    limit = np.quantile(apart[pairs[:, 0], pairs[:, 1]], config.alike)
    owner = np.arange(len(features))
    for _ in range(len(features) - config.fewest):
        stays, goes = np.unravel_index(int(np.argmin(apart)), apart.shape)
        if apart[stays, goes] > limit:
            break
        owner[owner == goes] = stays
        sums[stays] += sums[goes]
        near = np.isfinite(apart[stays]) | np.isfinite(apart[goes])
        near[[stays, goes]] = False
        apart[goes] = apart[:, goes] = apart[stays, goes] = apart[goes, stays] = np.inf
        apart[stays, near] = apart[near, stays] = _distance(sums[stays], sums[near])
    return (np.unique(owner, return_inverse=True)[1] + 1)[labels - 1].astype(np.int32)


def neighbours(labels: np.ndarray) -> np.ndarray:  # [n, 2], the smaller label first, sorted
    """Return the pairs of labels that share an edge of a pixel."""
    across = np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()], axis=1)
    down = np.stack([labels[:-1].ravel(), labels[1:].ravel()], axis=1)
    pairs = np.concatenate([across, down])
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """1 - cosine along the last axis."""
    norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray(1.0 - (a * b).sum(-1) / np.maximum(norms, 1e-12))
