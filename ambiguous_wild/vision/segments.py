"""Segments without weights: OpenCV's graph segmentation in Lab (Felzenszwalb and Huttenlocher 2004)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits, config_hash

_REFERENCE_PIXELS = 240 * 135  # k and min_size are for this size and scale with the pixel count


@dataclass(frozen=True)
class SegmentConfig:
    """Many small segments, because one that mixes a distractor and background of the same colour is useless.

    Best IoU with the true mask that whole segments can reach, on 30 simulated photos of 240x135: 0.57 for 30
    to 70 segments, 0.76 for 70 to 140, 0.77 for 120 to 240.
    """

    sigma: float = 0.5  # px, smoothing before the graph is built
    k: float = 100.0  # initial scale, at 240x135
    min_size: int = 30  # px at 240x135; smaller segments are merged away
    fewest: int = 70  # least wanted number of segments
    most: int = 140  # most
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
        return segment(lab, self.config)


def segment(lab: np.ndarray, config: SegmentConfig) -> np.ndarray:
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
            cv2.ximgproc.segmentation.createGraphSegmentation(config.sigma, math.exp(log_k), smallest)
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
    """Labels 1..K without gaps."""
    _, inverse = np.unique(labels, return_inverse=True)
    return (inverse.reshape(labels.shape) + 1).astype(np.int32)
