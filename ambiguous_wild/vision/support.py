"""Which instances may be transient: few points of structure from motion, many suspect pixels."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Scene


def unsupported(labels: np.ndarray, scene: Scene, name: str, most: float, least_track: int = 3) -> np.ndarray:
    """The label map without the instances that points say are static.

    Source: AsymGS (arXiv 2506.03538), the filter of its instance proposals.

    Args:
        labels: [H, W] of the photo, 0 = none.
        scene: whose points are asked.
        name: of the photo.
        most: an instance stays whose points a pixel are fewer than this share of the photo's.
        least_track: points with fewer observations are not counted.

    Returns:
        [H, W] int64, the labels of those that stay, 0 elsewhere.
    """
    labels, points = np.maximum(labels, 0).astype(np.int64), scene.points
    lengths = np.diff(points.track_offsets)
    here = points.track_views == [view.name for view in scene.views].index(name)
    x, y = np.floor(points.track_xy[here & np.repeat(lengths >= least_track, lengths)]).astype(np.int64).T
    hit = labels[y.clip(0, labels.shape[0] - 1), x.clip(0, labels.shape[1] - 1)]
    sizes = np.bincount(labels.ravel())
    density = np.bincount(hit, minlength=len(sizes)) / np.maximum(sizes, 1)
    static = density * labels.size >= most * max(len(hit), 1)
    return np.where(static[labels], 0, labels)


def standing(labels: Tensor, suspect: Tensor) -> Tensor:
    """Keep map [H, W]: without the instances that are more suspect than the photo is on average.

    Args:
        labels: [H, W] int64, 0 = none.
        suspect: [H, W] bool.
    """
    flat = labels.reshape(-1)
    sums = torch.bincount(flat, weights=suspect.reshape(-1).double())
    chosen = sums / torch.bincount(flat).clamp(min=1) > suspect.double().mean()
    return (~(chosen[labels] & (labels > 0))).float()
