"""Where a photo moves: from the features that fit the place in other photos, and those that do not.

Structure from motion leaves matches out that fit another rigid motion than the place's. They lie on
distractors, also on those that no colour and no structure can tell; matches that fit the place lie
everywhere else. Between features their neighbours decide, and those in the same segment.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from torch import Tensor

from ambiguous_wild.io.motion_points import MotionPoints
from ambiguous_wild.io.palette import KEPT, MASKED, faded
from ambiguous_wild.vision.precompute import cache_key, cached
from ambiguous_wild.vision.protocols import Instances, PromptedInstances
from ambiguous_wild.vision.sparse_surface import PIXELS

MOVES = 0.6  # of `moving_map`: above, a pixel moves
POINTS = "features: green stay, red move"  # caption of `draw_points`
# reach of a feature, standard deviation on a map of `PIXELS`: what stays must not speak for what hides it
MOVING_PX, STATIC_PX = 3.0, 2.0
VOTES = 3  # photos of a feature count at most as much
SEGMENT_VOTES = 1.0  # of a segment, at most
LEAST_PROMPT = 3  # features of a motion that are a prompt
UNSURE = 1.0  # votes on either side that leave the answer half open


def moving_map(points: MotionPoints, labels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """What moves, [h, w] float32 in [0, 1]: 1 = moves, 0 = stays, 0.5 where no feature says anything.

    Args:
        points: of the photo.
        labels: [H, W] int32 segments of the photo, 0 = none.
        shape: of the map.
    """
    h, w = shape
    segments = np.maximum(cv2.resize(labels, (w, h), interpolation=cv2.INTER_NEAREST), 0)
    column, row = np.clip(points.xy * [w, h], 0, [w - 1, h - 1]).astype(int).T
    near, of_segment = [], []
    of_kind = (points.moves, points.moving, MOVING_PX), (~points.moves, points.static, STATIC_PX)
    for mine, votes, reach_px in of_kind:
        reach = reach_px * math.sqrt(h * w / PIXELS)
        weight = np.where(mine, np.minimum(votes, VOTES), 0).astype(np.float32)
        at_feature = np.zeros(shape, np.float32)
        np.add.at(at_feature, (row, column), weight)
        near.append(cv2.GaussianBlur(at_feature, (0, 0), reach) * np.float32(2.0 * math.pi * reach**2))
        total = np.bincount(segments[row, column], weight, minlength=int(segments.max()) + 1)
        total[0] = 0.0
        of_segment.append(total.astype(np.float32))
    # Only what moves spreads in its segment: a distractor of the background's colour shares the background's.
    # Large segments hold both kinds, so their vote is small and decides only far from features.
    excess = np.maximum(of_segment[0] - of_segment[1], 0.0) / np.maximum(of_segment[0] + of_segment[1], 1.0)
    moving, static = near[0] + np.float32(SEGMENT_VOTES) * excess[segments], near[1]
    return np.asarray((moving + UNSURE / 2) / (moving + static + UNSURE), np.float32)


def moving_labels(
    instances: Instances, photo: Tensor, labels: np.ndarray, points: MotionPoints, folder: Path
) -> np.ndarray:
    """Segments for `moving_map`, [H, W] int32.

    Features that move together are the prompt of a back end that takes points (SAM), those that stay its
    negatives: each answer becomes a segment of its own. Other back ends keep their segments.

    Args:
        instances: back end of the segments.
        photo: [H, W, 3] in [0, 1].
        labels: [H, W] int32, its segments.
        points: of the photo.
        folder: of the cache.
    """
    motions = np.flatnonzero(np.bincount(points.motion)[1:] >= LEAST_PROMPT) + 1
    if not isinstance(instances, PromptedInstances) or not len(motions):
        return labels
    xy = points.xy * labels.shape[::-1]
    groups = [xy[points.motion == k] for k in motions]

    def compute() -> dict[str, np.ndarray]:
        return {"masks": instances.at_points(photo, groups, xy[~points.moves])}

    key = cache_key("moving", instances.name, None, xy, points.motion, photo.detach().cpu().numpy())
    labels = labels.copy()
    # the largest motion comes last and wins where masks overlap
    for mask in cached(folder, key, {"masks": np.bool_}, compute)["masks"][::-1]:
        labels[mask] = labels.max() + 1
    return labels


def draw_points(photo: np.ndarray, points: MotionPoints) -> np.ndarray:
    """The photo [H, W, 3] uint8 with dots: red where a feature moves, green where it stays."""
    h, w = photo.shape[:2]
    size = max(round(max(h, w) / 320), 1)
    shown = faded(photo)
    for chosen, colour in ((~points.moves, KEPT), (points.moves, MASKED)):
        for x, y in (points.xy[chosen] * [w, h]).astype(int).tolist():
            cv2.circle(shown, (x, y), size, colour, -1)
    return shown
