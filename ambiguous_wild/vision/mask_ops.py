"""Operations on label maps: paint overlapping masks, add new instances, remove static ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Scene


def mask_boxes(
    masks: np.ndarray,  # [n, H, W] bool
) -> np.ndarray:  # [n, 4] float64, xyxy in px, right and bottom exclusive; zeros for an empty mask
    """The bounding box of every mask."""
    boxes = np.zeros((len(masks), 4))
    for index, mask in enumerate(masks):
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        if len(rows):
            boxes[index] = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    return boxes


def box_nms(
    boxes: np.ndarray,  # [n, 4] xyxy
    scores: np.ndarray,  # [n]
    threshold: float,
) -> np.ndarray:  # indices kept, best first
    """Greedy suppression: drop a box whose IoU with a better one exceeds the threshold; ties by index."""
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    order = np.argsort(-scores, kind="stable")
    kept = []
    while len(order):
        best, rest = order[0], order[1:]
        kept.append(int(best))
        low = np.maximum(boxes[best, :2], boxes[rest, :2])
        high = np.minimum(boxes[best, 2:], boxes[rest, 2:])
        shared = np.prod(np.maximum(high - low, 0.0), axis=1)
        union = areas[best] + areas[rest] - shared
        order = rest[shared <= threshold * np.maximum(union, 1e-12)]
    return np.array(kept, dtype=np.int64)


def paint(
    masks: Sequence[np.ndarray] | np.ndarray,  # n of [H, W] bool
    height: int,
    width: int,
) -> tuple[np.ndarray, np.ndarray]:  # [H, W] int32, 0 = none; [K] int64
    """Paint one label map in order of decreasing area: a small mask lies on top of a large one.

    Returns:
        labels 1..K without gaps, by decreasing area, and the index of each label's mask. A mask that others
        cover completely has no label.
    """
    areas = np.array([int(np.count_nonzero(mask)) for mask in masks], dtype=np.int64)
    order = np.argsort(-areas, kind="stable")
    painted = np.zeros((height, width), dtype=np.int32)
    for rank, index in enumerate(order, start=1):
        painted[masks[index]] = rank
    seen = np.unique(painted)
    seen = seen[seen > 0]
    table = np.zeros(len(order) + 1, dtype=np.int32)
    table[seen] = np.arange(1, len(seen) + 1)
    return table[painted], order[seen - 1]


def add_untracked(
    tracked: np.ndarray,  # [H, W] int32, scene-wide ids, 0 = none
    detected: np.ndarray,  # [H, W] int32, this photo's instances
    first_id: int,
    most: int,
    known: float = 0.5,
) -> tuple[np.ndarray, int]:
    """Add to `tracked` the instances that no tracked instance covers, each with a new id.

    Args:
        first_id: id of the first new instance.
        most: limit of the number of ids in the map; the largest new instances are added first.
        known: an instance is not new if tracked ids cover at least this share of its pixels.

    Returns:
        The map and the next free id.
    """
    result = tracked.copy()
    free = tracked == 0
    counts = np.bincount(np.maximum(detected, 0).ravel())
    uncovered = np.bincount(np.maximum(detected, 0)[free], minlength=len(counts))
    fresh = [k for k in range(1, len(counts)) if uncovered[k] and uncovered[k] > (1.0 - known) * counts[k]]
    fresh.sort(key=lambda k: (-uncovered[k], k))
    room = max(most - int(np.count_nonzero(np.unique(tracked) > 0)), 0)
    for number, k in enumerate(fresh[:room]):
        result[(detected == k) & free] = first_id + number
    return result, first_id + min(len(fresh), room)


def drop_static_instances(
    labels: np.ndarray, scene: Scene, name: str, most: float, least_track: int = 3
) -> np.ndarray:
    """Remove the instances that SfM points show to be static from a label map.

    Source: AsymGS (arXiv 2506.03538), the filter of its instance proposals.

    Args:
        labels: label map [H, W] of the photo, 0 = none.
        scene: the scene, whose points are used.
        name: name of the photo.
        most: an instance stays if it has fewer points per pixel than this share of the photo's average.
        least_track: points with fewer observations are not counted.

    Returns:
        [H, W] int64, the labels of the instances that stay, 0 elsewhere.
    """
    labels, points = np.maximum(labels, 0).astype(np.int64), scene.points
    lengths = np.diff(points.track_offsets)
    in_photo = points.track_views == [view.name for view in scene.views].index(name)
    x, y = np.floor(points.track_xy[in_photo & np.repeat(lengths >= least_track, lengths)]).astype(np.int64).T
    hit_labels = labels[y.clip(0, labels.shape[0] - 1), x.clip(0, labels.shape[1] - 1)]
    sizes = np.bincount(labels.ravel())
    density = np.bincount(hit_labels, minlength=len(sizes)) / np.maximum(sizes, 1)
    static = density * labels.size >= most * max(len(hit_labels), 1)
    return np.where(static[labels], 0, labels)


def keep_from_suspects(labels: Tensor, suspect: Tensor) -> Tensor:
    """Make the keep map [H, W] that drops instances more suspect than the photo is on average.

    Args:
        labels: [H, W] int64, 0 = none.
        suspect: [H, W] bool.
    """
    flat = labels.reshape(-1)
    sums = torch.bincount(flat, weights=suspect.reshape(-1).double())
    chosen = sums / torch.bincount(flat).clamp(min=1) > suspect.double().mean()
    return (~(chosen[labels] & (labels > 0))).float()
