"""Maps of what moves in a photo, from matches of its features, and of its pixels, with other photos.

Structure from motion keeps the matches that fit the motion of the cameras. Matches that fit another rigid
motion lie on distractors, also on those that neither colour nor structure tells apart; the other matches lie
everywhere else. Pixels between features are decided by the features near them and in their segment. In a
sequence optical flow votes on each pixel, too.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from torch import Tensor

from ambiguous_wild.io.motion_points import MotionPoints
from ambiguous_wild.io.palette import KEPT, MASKED, faded, tint
from ambiguous_wild.vision.precompute import cache_key, cached
from ambiguous_wild.vision.protocols import Instances
from ambiguous_wild.vision.sam import SamInstances
from ambiguous_wild.vision.sparse_surface import PIXELS

MOVES = 0.6  # a pixel moves if `moving_map` is above this
CERTAIN = 0.8  # and certainly, if above this and by optical flow
_SPECK = np.ones((3, 3), np.uint8)  # smaller areas are not certain
POINTS = "green stays, red moves"  # caption of `draw_points`
# Reach of a feature: standard deviation in px on a map of `PIXELS`. Static features reach less far, because
# what hides them may move.
MOVING_PX, STATIC_PX = 3.0, 2.0
VOTES = 3  # votes of a feature at most: one for each photo that it is matched in
SEGMENT_VOTES = 1.0  # votes of a segment at most
MIN_PROMPT = 3  # a motion of fewer features is no prompt
UNSURE = 1.0  # votes that are added, half to each side: they pull the map towards 0.5


def moving_map(points: MotionPoints, labels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Map [h, w] float32 in [0, 1] of what moves: 1 = moves, 0 = stays, 0.5 where nothing tells.

    Args:
        points: the photo's features, and votes by optical flow.
        labels: [H, W] int32 segments of the photo, 0 = none.
        shape: (h, w) of the map.
    """
    h, w = shape
    segments = np.maximum(cv2.resize(labels, (w, h), interpolation=cv2.INTER_NEAREST), 0)
    column, row = np.clip(points.xy * [w, h], 0, [w - 1, h - 1]).astype(int).T
    near, of_segment = [], []
    of_kind = (points.moves, points.moving, MOVING_PX), (~points.moves, points.static, STATIC_PX)
    for chosen, votes, reach_px in of_kind:
        reach = reach_px * math.sqrt(h * w / PIXELS)
        weight = np.where(chosen, np.minimum(votes, VOTES), 0).astype(np.float32)
        at_feature = np.zeros(shape, np.float32)
        np.add.at(at_feature, (row, column), weight)
        near.append(cv2.GaussianBlur(at_feature, (0, 0), reach) * np.float32(2.0 * math.pi * reach**2))
        total = np.bincount(segments[row, column], weight, minlength=int(segments.max()) + 1)
        total[0] = 0.0
        of_segment.append(total.astype(np.float32))
    # Only what moves spreads in its segment: a distractor of the background's colour shares the background's.
    # Large segments hold both kinds, so their vote is small and decides only far from features.
    excess = np.maximum(of_segment[0] - of_segment[1], 0.0) / np.maximum(of_segment[0] + of_segment[1], 1.0)
    if points.flow is not None:
        stays, moves = (
            cv2.resize(votes, (w, h), interpolation=cv2.INTER_AREA)
            for votes in points.flow.astype(np.float32)
        )
        near = [near[0] + moves, near[1] + stays]
        # flow tells of every pixel, so those of which it says nothing count, too
        areas = np.maximum(np.bincount(segments.ravel()), 1)
        share = np.bincount(segments.ravel(), np.sign(moves - stays).ravel()) / areas
        share[0] = 0.0
        excess = np.maximum(excess, share.astype(np.float32))
    moving, static = near[0] + np.float32(SEGMENT_VOTES) * excess[segments], near[1]
    return np.asarray((moving + UNSURE / 2) / (moving + static + UNSURE), np.float32)


def certainly_moving(points: MotionPoints, moving: np.ndarray) -> np.ndarray | None:
    """Return the pixels [h, w] bool of a `moving_map` that flow is certain of; None without its votes."""
    if points.flow is None or not points.flow.any():
        return None
    stays, moves = (
        cv2.resize(votes, moving.shape[::-1], interpolation=cv2.INTER_NEAREST) for votes in points.flow
    )
    certain = (moving > CERTAIN) & (moves > stays)
    return cv2.morphologyEx(certain.astype(np.uint8), cv2.MORPH_OPEN, _SPECK) > 0


def moving_labels(
    instances: Instances, photo: Tensor, labels: np.ndarray, points: MotionPoints, folder: Path
) -> np.ndarray:
    """Segments for `moving_map`, [H, W] int32.

    SAM is prompted with features that move together, and with static features
    as negatives; each mask it returns becomes a segment of its own. Other back ends keep their segments.

    Args:
        instances: back end that made the segments.
        photo: [H, W, 3] in [0, 1].
        labels: [H, W] int32, the photo's segments.
        points: the photo's features.
        folder: the cache.
    """
    motions = np.flatnonzero(np.bincount(points.motion)[1:] >= MIN_PROMPT) + 1
    if not isinstance(instances, SamInstances) or not len(motions):
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
    """Draw features, and areas by optical flow, on a photo [H, W, 3] uint8: red moves, green stays."""
    h, w = photo.shape[:2]
    size = max(round(max(h, w) / 320), 1)
    shown = faded(photo)
    if points.flow is not None:
        stays, moves = (cv2.resize(votes, (w, h), interpolation=cv2.INTER_NEAREST) for votes in points.flow)
        shown = tint(tint(shown, stays > moves, KEPT), moves > stays, MASKED)
    for chosen, colour in ((~points.moves, KEPT), (points.moves, MASKED)):
        for x, y in (points.xy[chosen] * [w, h]).astype(int).tolist():
            cv2.circle(shown, (x, y), size, colour, -1)
    return shown
