"""One label space for the scene: instances of different photos that are the same object.

The paper takes ids from a video tracker. Unordered photos have none, so instances are associated by the
SfM tracks that run through them, then by their mean features. Two instances of one photo never merge.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

MOST_IDENTITIES = 255


@dataclass(frozen=True)
class Identities:
    """Identity of every instance of every photo, 1..count; 0 = none."""

    of_instance: list[np.ndarray]  # per photo [K + 1] int32, index = label; entry 0 is 0
    count: int  # P
    photos_of: np.ndarray  # [P] int32, in how many photos each identity was found


def associate(
    labels: Sequence[np.ndarray],  # per photo [H, W] int32, 0 = none
    means: Sequence[np.ndarray],  # per photo [K, C] float, mean feature of each instance, unit length
    tracks: tuple[np.ndarray, np.ndarray, np.ndarray],  # point, photo, xy of each observation
    *,
    min_shared: int = 3,
    min_share: float = 0.25,
    min_similarity: float = 0.8,
    most: int = MOST_IDENTITIES,
) -> Identities:
    """Merge instances of different photos into identities.

    Args:
        labels: instance labels; gaps are allowed, negative labels count as none.
        means: mean feature of labels 1..K.
        tracks: (point [L] int64, photo [L] int32, xy [L, 2] px), observations of SfM points.
        min_shared: tracks that must run through both instances.
        min_share: and their share of the tracks of the instance that has fewer.
        min_similarity: cosine of mean features for those that tracks do not join.
        most: identities at most; those in the most photos are kept, then the largest.
    """
    counts = [max(int(label.max(initial=0)), 0) for label in labels]
    offsets = np.r_[0, np.cumsum(counts)]
    total = int(offsets[-1])
    if total == 0:
        return Identities([np.zeros(1, np.int32) for _ in labels], 0, np.zeros(0, np.int32))
    photo_of = np.repeat(np.arange(len(labels)), counts)
    groups = _Groups(photo_of)
    for i, j in _track_pairs(labels, offsets, tracks, min_shared, min_share):
        groups.join(int(i), int(j))
    features = np.concatenate([np.asarray(m, dtype=np.float64) for m in means])
    _join_by_features(groups, features, min_similarity)

    areas = np.concatenate(
        [np.bincount(np.maximum(x, 0).ravel(), minlength=k + 1)[1:] for x, k in zip(labels, counts)]
    )
    roots = np.array([groups.root(i) for i in range(total)])
    found, inverse = np.unique(roots, return_inverse=True)
    photos = np.bincount(inverse, weights=areas > 0).astype(np.int64)  # one instance a photo at most
    size = np.bincount(inverse, weights=areas)
    order = np.lexsort((np.arange(len(found)), -size, -photos))[:most]
    order = order[photos[order] > 0]
    rank = np.zeros(len(found), dtype=np.int32)
    rank[order] = np.arange(1, len(order) + 1)
    flat = np.where(areas > 0, rank[inverse], 0).astype(np.int32)
    per_photo = [np.r_[np.int32(0), flat[a:b]].astype(np.int32) for a, b in itertools.pairwise(offsets)]
    return Identities(per_photo, len(order), photos[order].astype(np.int32))


def _track_pairs(
    labels: Sequence[np.ndarray],
    offsets: np.ndarray,
    tracks: tuple[np.ndarray, np.ndarray, np.ndarray],
    min_shared: int,
    min_share: float,
) -> np.ndarray:
    """Pairs of instances [n, 2] joined by tracks, the surest first."""
    point, photo, xy = tracks
    instance = np.full(len(point), -1, dtype=np.int64)
    for index, label in enumerate(labels):
        here = np.flatnonzero(photo == index)
        column = np.floor(xy[here, 0]).astype(np.int64)
        row = np.floor(xy[here, 1]).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < label.shape[1]) & (row < label.shape[0])
        found = label[row[inside], column[inside]]
        instance[here[inside]] = np.where(found > 0, offsets[index] + found - 1, -1)
    used = instance >= 0
    if not used.any():
        return np.zeros((0, 2), dtype=np.int64)
    _, rows = np.unique(point[used], return_inverse=True)
    shape = (int(rows.max()) + 1, int(offsets[-1]))
    incidence = sparse.coo_matrix((np.ones(len(rows)), (rows, instance[used])), shape=shape).tocsr()
    incidence.data[:] = 1.0  # a track that crosses an instance twice counts once
    shared = sparse.triu(incidence.T @ incidence, k=1).tocoo()
    runs = np.asarray(incidence.sum(0)).ravel()
    share = shared.data / np.minimum(runs[shared.row], runs[shared.col])
    keep = (shared.data >= min_shared) & (share >= min_share)
    pairs = np.stack([shared.row[keep], shared.col[keep]], axis=1).astype(np.int64)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -shared.data[keep], -share[keep]))
    return pairs[order]


def _join_by_features(groups: _Groups, features: np.ndarray, min_similarity: float) -> None:
    """Join instances without shared tracks to the most similar group that has no instance of their photo."""
    alone = [i for i in range(len(features)) if groups.size(i) == 1]
    norms = np.linalg.norm(features, axis=1, keepdims=True)
    unit = features / np.maximum(norms, 1e-12)
    for i in alone:
        similarity = unit @ unit[i]
        for j in np.argsort(-similarity, kind="stable")[:12]:
            if similarity[j] < min_similarity:
                break
            if j != i and groups.join(i, int(j)):
                break


class _Groups:
    """Union-find that refuses to join groups which share a photo."""

    def __init__(self, photo_of: np.ndarray) -> None:
        self.parent = list(range(len(photo_of)))
        self.photos = [1 << int(p) for p in photo_of]  # a bit per photo

    def root(self, i: int) -> int:
        while self.parent[i] != i:
            self.parent[i] = self.parent[self.parent[i]]
            i = self.parent[i]
        return i

    def size(self, i: int) -> int:
        return self.photos[self.root(i)].bit_count()

    def join(self, i: int, j: int) -> bool:
        a, b = self.root(i), self.root(j)
        if a == b:
            return True
        if self.photos[a] & self.photos[b]:
            return False
        low, high = min(a, b), max(a, b)
        self.parent[high] = low
        self.photos[low] |= self.photos[high]
        return True
