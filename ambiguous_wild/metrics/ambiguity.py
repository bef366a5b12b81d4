"""Colour ambiguity of distractors with their background, and the share of the photo they cover.

The paper (supplement, "Evaluation of ambiguity") calls a scene colour-ambiguous if more than 30 % of the
distractor pixels differ from the background by less than 0.3. It does not define the norm, the background or
the pixels. Here: the L2 norm over RGB in [0, 1], the true background behind the distractor, and the
distractor pixels of all training photos. Pixels with unknown background are counted and left out. The
semantic criterion is in `metrics.semantic`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass

import numpy as np

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.metrics.stats import Interval

COLOUR_THRESHOLD = 0.3  # L2 distance in RGB, of [0, sqrt(3)]
RESAMPLES = 2000  # of the bootstrap over photos
COLOUR_AMBIGUOUS_ABOVE = 0.3  # share of distractor pixels
COLOUR_METRIC = "colour_share_rgb_l2_below_0.3"


@dataclass(frozen=True)
class ColourCounts:
    """Pixel counts of one photo, or sums over several."""

    pixels: int  # number of pixels of the photo
    distractor: int  # pixels that distractors cover
    known: int  # distractor pixels with a known background
    close: int  # known ones that differ from the background by less than the threshold
    residual_sum: float  # sum of colour differences over the known pixels

    @property
    def unknown(self) -> int:
        """Distractor pixels with unknown background."""
        return self.distractor - self.known

    @property
    def occlusion(self) -> float:
        """Share of the photo that distractors cover, in [0, 1]; NaN without pixels."""
        return self.distractor / self.pixels if self.pixels else math.nan

    @property
    def close_share(self) -> float:
        """Share of the known distractor pixels closer than the threshold; NaN without such pixels."""
        return self.close / self.known if self.known else math.nan

    @property
    def mean_residual(self) -> float:
        """Mean colour difference over the known distractor pixels; NaN without such pixels."""
        return self.residual_sum / self.known if self.known else math.nan


def colour_residual(
    photo: np.ndarray,  # [H, W, 3] float in [0, 1], sRGB
    background: np.ndarray,  # [H, W, 3] the same
) -> np.ndarray:  # [H, W] float64 in [0, sqrt(3)]
    """L2 distance in RGB between the photo and the background.

    Raises:
        AwError: sizes differ, or values are not floating point in [0, 1].
    """
    if photo.shape != background.shape or photo.ndim != 3 or photo.shape[2] != 3:
        raise AwError(
            f"photo and background must both be [H, W, 3], got {list(photo.shape)} and "
            f"{list(background.shape)}"
        )
    for which, image in (("photo", photo), ("background", background)):
        if not np.issubdtype(image.dtype, np.floating) or not bool(((image >= 0) & (image <= 1)).all()):
            raise AwError(f"the {which} must be floating point in [0, 1]")
    return np.linalg.norm(photo.astype(np.float64) - background.astype(np.float64), axis=2)


def colour_counts(
    photo: np.ndarray,  # [H, W, 3] float in [0, 1], sRGB
    background: np.ndarray | None,  # [H, W, 3] float in [0, 1], sRGB; None = unknown
    distractor: np.ndarray,  # [H, W] bool, True = distractor
    *,
    known: np.ndarray | None = None,  # [H, W] bool: where the background is known; default: everywhere
) -> ColourCounts:
    """Count the distractor pixels of one photo that are closer than `COLOUR_THRESHOLD` to their background.

    Raises:
        AwError: sizes differ, or a mask is not boolean.
    """
    masks = [("distractor", distractor)] + ([("known", known)] if known is not None else [])
    for which, mask in masks:
        if mask.dtype != bool or mask.shape != photo.shape[:2]:
            raise AwError(
                f"the {which} mask must be bool {list(photo.shape[:2])}, got {mask.dtype} {list(mask.shape)}"
            )
    if background is None:
        return ColourCounts(distractor.size, int(distractor.sum()), 0, 0, 0.0)
    measured = distractor if known is None else distractor & known
    residual = colour_residual(photo, background)[measured]
    return ColourCounts(
        pixels=distractor.size,
        distractor=int(distractor.sum()),
        known=residual.size,
        close=int((residual < COLOUR_THRESHOLD).sum()),
        residual_sum=float(residual.sum()),
    )


def pooled(counts: Sequence[ColourCounts]) -> ColourCounts:
    """Sum the counts of several photos, so that each weighs by its distractor pixels."""
    nothing = ColourCounts(0, 0, 0, 0, 0.0)
    return ColourCounts(*map(sum, zip(*map(astuple, (nothing, *counts)))))


def ratio_interval(
    part: Sequence[float] | np.ndarray,  # [n], one per photo
    whole: Sequence[float] | np.ndarray,  # [n]
    *,
    seed: int = 0,
) -> Interval:
    """Return sum(part) / sum(whole) with its percentile bootstrap interval over photos.

    Photos are resampled, because pixels of one photo are not independent. A resample in which `whole` sums to
    0 is left out. One photo has a ratio but no interval.

    Raises:
        AwError: different lengths.
    """
    a, b = np.asarray(part, np.float64), np.asarray(whole, np.float64)
    if a.shape != b.shape or a.ndim != 1:
        raise AwError(f"part and whole must be one per photo, got {list(a.shape)} and {list(b.shape)}")
    count = int((b > 0).sum())
    if not count:
        return Interval(math.nan, math.nan, math.nan, 0)
    centre = float(a.sum() / b.sum())
    if len(a) < 2:
        return Interval(centre, math.nan, math.nan, count)
    rows = np.random.default_rng(seed).integers(0, len(a), size=(RESAMPLES, len(a)))
    wholes = b[rows].sum(axis=1)
    ratios = a[rows].sum(axis=1)[wholes > 0] / wholes[wholes > 0]
    low, high = np.quantile(ratios, [0.025, 0.975])
    return Interval(centre, float(low), float(high), count)


def verdict(value: float, above: float) -> bool | None:
    """Whether the score exceeds the limit; None for NaN."""
    return None if math.isnan(value) else value > above
