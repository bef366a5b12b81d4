"""Instances from pretrained features: small segments of a photo, grouped while neighbours look alike.

A cheap stand-in for SAM that needs no hub: the outlines come from `segments.GraphSegments`, what belongs
together from the features of a network.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.config import check_limits, config_hash
from ambiguous_wild.vision.protocols import Features
from ambiguous_wild.vision.segments import GraphSegments, SegmentConfig


@dataclass(frozen=True)
class GroupConfig:
    """How far segments are grouped."""

    alike: float = 0.5  # neighbours merge up to this quantile of the photo's distances between neighbours
    fewest: int = 20  # groups that stay at least
    segments: SegmentConfig = field(default_factory=SegmentConfig)  # that are grouped

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
        return group(segments, segment_features(segments, phi), self.config)


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


def group(
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
    """Pairs of labels that share an edge of a pixel."""
    across = np.stack([labels[:, :-1].ravel(), labels[:, 1:].ravel()], axis=1)
    down = np.stack([labels[:-1].ravel(), labels[1:].ravel()], axis=1)
    pairs = np.concatenate([across, down])
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return np.unique(np.sort(pairs, axis=1), axis=0)


def _distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """1 - cosine along the last axis."""
    norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    return np.asarray(1.0 - (a * b).sum(-1) / np.maximum(norms, 1e-12))
