"""Accuracy of predicted keep maps against the truth, and PSNR on kept pixels.

Keep maps are 1 on static pixels and 0 on transient ones. The scored class is *transient*: a map that keeps
everything has recall 0. Counts are summed over a scene's photos before the ratio, because a photo without
distractors has no ratio.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import astuple, dataclass

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.image import checked_pair, psnr_from_mse


@dataclass(frozen=True)
class Confusion:
    """Pixel counts; positive = transient."""

    true_positive: int = 0  # transient and masked
    false_positive: int = 0  # static but masked
    false_negative: int = 0  # transient but kept
    true_negative: int = 0  # static and kept

    @property
    def iou(self) -> float:
        """Intersection over union of the transient class; NaN if no pixel is transient or masked."""
        return _ratio(self.true_positive, self.true_positive + self.false_positive + self.false_negative)

    @property
    def precision(self) -> float:
        """Share of the masked pixels that are transient; NaN if none is masked."""
        return _ratio(self.true_positive, self.true_positive + self.false_positive)

    @property
    def recall(self) -> float:
        """Share of the transient pixels that are masked; NaN if none is transient."""
        return _ratio(self.true_positive, self.true_positive + self.false_negative)


def confusion(
    keep: np.ndarray,  # [H, W] bool, uint8 {0, 255} or float in [0, 1]; predicted, 1 = static
    truth: np.ndarray,  # [H, W] the same types; ground truth
) -> Confusion:
    """Pixel counts of one predicted keep map against the true one; soft maps are thresholded at 0.5.

    Raises:
        AwError: maps of different size, or not two-dimensional.
    """
    masked, transient = ~as_keep(keep, "predicted"), ~as_keep(truth, "true")
    _same_size(masked, transient)
    return Confusion(
        true_positive=int((masked & transient).sum()),
        false_positive=int((masked & ~transient).sum()),
        false_negative=int((~masked & transient).sum()),
        true_negative=int((~masked & ~transient).sum()),
    )


def pooled(counts: Iterable[Confusion]) -> Confusion:
    """Sum the counts of several photos."""
    return Confusion(*map(sum, zip(*map(astuple, counts))))


def psnr_valid(
    a: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
    b: np.ndarray,  # [H, W, 3] the same size
    keep: np.ndarray,  # [H, W] bool, uint8 {0, 255} or float in [0, 1]; 1 = measured
) -> float:
    """PSNR in dB over the kept pixels only: the squared error is divided by their number.

    NerfBaselines multiplies both images by the map and averages over all pixels, which adds
    -10 log10(kept share). No kept pixel: NaN (missing). Identical on kept pixels: ``inf``.

    Raises:
        AwError: sizes differ; see `checked_pair`.
    """
    left, right = checked_pair(a, b)
    kept = as_keep(keep, "keep")
    _same_size(kept, left[..., 0])
    if not kept.any():
        return math.nan
    return psnr_from_mse(float(((left - right)[kept] ** 2).mean()))


def as_keep(keep: np.ndarray, which: str) -> np.ndarray:
    """Return a keep map as [H, W] bool: float >= 0.5, uint8 >= 128.

    Raises:
        AwError: not two-dimensional, or another number type.
    """
    keep = np.asarray(keep)
    if keep.ndim != 2:
        raise AwError(f"the {which} keep map must be [H, W], got {list(keep.shape)}")
    if keep.dtype == bool:
        return keep
    if keep.dtype == np.uint8:
        # A map of 0 and 1 is a common mistake: 1 would silently mean transient.
        if keep.max(initial=0) == 1:
            raise AwError(f"the {which} keep map is uint8 with values 0 and 1: give bool, or 0 and 255")
        return keep >= 128
    if np.issubdtype(keep.dtype, np.floating):
        if not bool(((keep >= 0.0) & (keep <= 1.0)).all()):
            raise AwError(f"the {which} keep map has values outside [0, 1] or not finite")
        return keep >= 0.5
    raise AwError(f"the {which} keep map must be bool, uint8 or floating point, got {keep.dtype}")


def _same_size(a: np.ndarray, b: np.ndarray) -> None:
    if a.shape != b.shape:
        raise AwError(
            f"maps of different size: {a.shape[1]}x{a.shape[0]} and {b.shape[1]}x{b.shape[0]}; "
            "resize the prediction (nearest) first"
        )


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else math.nan
