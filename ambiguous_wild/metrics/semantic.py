"""Semantic ambiguity: similarity of distractors and static objects, as cosines of mean frozen features.

The paper (supplement, "Evaluation of ambiguity") calls a scene semantically ambiguous if the cosine
similarity of distractors and static objects exceeds 0.7. Here a region's feature is the mean over its pixels.
A distractor is compared with every static region of the *other* photos and scores its best match. A photo
scores as its most similar distractor. Two anchors calibrate the cosine of the features in use: the best
match of a static region in another photo, and the mean over unrelated regions.

Features without pretraining compare appearance, not object category, so the paper's limit does not apply to
them. For these the criterion needs no limit on the cosine: does a distractor match static regions of other
photos as well as static regions match each other?
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambiguous_wild.core.errors import AwError

AMBIGUOUS_ABOVE = 0.7  # cosine; stated by the paper for DINOv2 features
LOOKALIKE_ABOVE = 0.25  # share of distractor pixels, for weight-free features; see docs/ambiguity.md
USUAL = 0.05  # quantile of static regions' best matches; a higher match is usual
MIN_SHARE = 0.002  # smaller shares of a photo's pixels are ignored
_ANCHOR_REGIONS = 2000  # most static regions used for the anchors, evenly chosen


@dataclass(frozen=True)
class RegionFeatures:
    """Regions of one photo with their mean features."""

    labels: np.ndarray  # [R] int, as in the label map
    means: np.ndarray  # [R, C] float64
    pixels: np.ndarray  # [R] float64

    def __len__(self) -> int:
        return len(self.labels)

    def whitened(self, mean: np.ndarray, whiten: np.ndarray) -> RegionFeatures:
        """The regions after subtracting the mean [C] and multiplying by the matrix [C, C]."""
        return replace(self, means=(self.means - mean) @ whiten)


@dataclass(frozen=True)
class RegionMatch:
    """One distractor region and its most similar static region."""

    label: int  # label of the distractor region
    pixels: int
    cosine: float  # in [-1, 1]
    photo: int  # index of the photo with the static region
    static_label: int


@dataclass(frozen=True)
class Anchors:
    """Cosines of static regions, the scale for a distractor's cosine."""

    same: float  # mean best match of a static region in another photo: the same surface
    different: float  # mean cosine of static regions of two photos: unrelated surfaces

    def calibrated(self, cosine: float) -> float:
        """0 = like an unrelated surface, 1 = like the same surface in another photo; NaN if undefined."""
        width = self.same - self.different
        return (cosine - self.different) / width if width > 0 else math.nan


class ChannelStatistics:
    """Mean and covariance of the channels over all photos, distractors included, from running sums.

    Features with a large mean have cosines near 1 for any content, and correlated channels are overweighted.
    Subtracting the mean and whitening gives two unrelated regions a similarity of 0. Statistics of static
    cells alone are worse: distractors in unusual colours then all lie in the same direction.
    """

    def __init__(self) -> None:
        self.count = 0
        self.sum: np.ndarray | float = 0.0
        self.products: np.ndarray | float = 0.0

    def add(self, features: np.ndarray) -> None:  # [h, w, C]
        """Add one photo's features."""
        flat = features.reshape(-1, features.shape[2]).astype(np.float64)
        self.count += len(flat)
        self.sum, self.products = self.sum + flat.sum(0), self.products + flat.T @ flat

    def whitening(self) -> tuple[np.ndarray, np.ndarray]:  # ([C], [C, C]) float64
        """The mean and the whitening matrix; a constant channel becomes 0.

        Channels are first scaled to unit variance. The variance of a direction is limited to at least a
        thousandth of the largest, so that noise is not amplified.
        """
        mean = np.asarray(self.sum) / max(self.count, 1)
        covariance = np.asarray(self.products) / max(self.count, 1) - np.outer(mean, mean)
        variance = np.maximum(np.diag(covariance), 0.0)
        # A constant channel's variance is rounding error, relative to the square of its mean.
        constant = variance <= 1e-10 * np.maximum(mean * mean, 1e-12)
        scale = np.where(constant, 0.0, 1.0 / np.sqrt(np.where(constant, 1.0, variance)))
        values, vectors = np.linalg.eigh(covariance * np.outer(scale, scale))
        values = np.maximum(values, 1e-3 * max(float(values.max()), 1e-12))
        return mean, scale[:, None] * vectors / np.sqrt(values)


def region_means(
    features: np.ndarray,  # [h, w, C], a coarser grid over the same photo
    labels: np.ndarray,  # [H, W] int, 0 = no region
    min_share: float = 0.0,  # share of the photo; smaller regions are left out
) -> RegionFeatures:
    """Mean feature of each region; a cell is weighted by the number of its pixels in the region."""
    h, w, channels = features.shape
    cell = _cells(labels.shape, h, w)[labels > 0]
    names, index = np.unique(labels[labels > 0], return_inverse=True)
    weight = np.bincount(index * (h * w) + cell, minlength=len(names) * h * w).reshape(len(names), h * w)
    pixels = weight.sum(axis=1)
    means = weight @ features.reshape(h * w, channels).astype(np.float64) / np.maximum(pixels, 1)[:, None]
    large = pixels >= max(min_share * labels.size, 1)
    return RegionFeatures(names[large], means[large], pixels[large])


def matches(
    distractors: Sequence[RegionFeatures],  # one per photo
    statics: Sequence[RegionFeatures],  # one per photo
) -> list[list[RegionMatch]]:
    """Find the most similar static region of another photo for each distractor region.

    Only other photos are used, because a distractor's features leak into its surroundings. A scene of one
    photo is compared with itself. Regions with a zero feature are left out.

    Raises:
        AwError: the two sequences differ in length.
    """
    if len(distractors) != len(statics):
        raise AwError(f"{len(distractors)} photos of distractors, {len(statics)} of static regions")
    units, photo, label = _stacked(statics)
    by_photo = []
    for k, regions in enumerate(distractors):
        rows = np.flatnonzero(photo != k) if len(statics) > 1 else np.arange(len(photo))
        norms = np.linalg.norm(regions.means, axis=1)
        in_photo = []
        for r in np.flatnonzero(norms > 0) if len(rows) else []:
            cosines = units[rows] @ (regions.means[r] / norms[r])
            best = int(rows[np.argmax(cosines)])
            cosine = float(np.clip(cosines.max(), -1.0, 1.0))
            which, px = int(regions.labels[r]), int(regions.pixels[r])
            in_photo.append(RegionMatch(which, px, cosine, int(photo[best]), int(label[best])))
        by_photo.append(in_photo)
    return by_photo


def anchors(
    statics: Sequence[RegionFeatures],  # the regions that distractors are compared with, one per photo
    every: Sequence[RegionFeatures] | None = None,  # all static regions, if these are more
) -> Anchors:
    """Similarity of static regions of different photos; NaN if fewer than two photos have regions."""
    units, photo, _ = _stacked(statics)
    others, other_photo, _ = _stacked(statics if every is None else every)
    if len(np.unique(photo)) < 2 or len(np.unique(other_photo)) < 2:
        return Anchors(math.nan, math.nan)
    different = [(others @ units[k])[other_photo != photo[k]].mean() for k in _sampled(units)]
    same = _best_in_other_photos(units, photo)
    return Anchors(float(np.mean(same)), float(np.mean(different)))


def usual_match(statics: Sequence[RegionFeatures]) -> float:
    """The cosine that 95 % of static regions reach with their best match in another photo, else NaN."""
    units, photo, _ = _stacked(statics)
    if len(np.unique(photo)) < 2:
        return math.nan
    return float(np.quantile(_best_in_other_photos(units, photo), USUAL))


def _sampled(units: np.ndarray) -> range:
    """Rows used for the anchors, evenly chosen."""
    return range(0, len(units), max(len(units) // _ANCHOR_REGIONS, 1))


def _best_in_other_photos(units: np.ndarray, photo: np.ndarray) -> list[float]:
    """Return the cosine of each sampled region with its best match in another photo."""
    return [float((units @ units[k])[photo != photo[k]].max()) for k in _sampled(units)]


def photo_cosine(matched: Sequence[RegionMatch]) -> float:
    """Cosine of a photo's most similar distractor; NaN without distractors."""
    return max((m.cosine for m in matched), default=math.nan)


def mean_cosine(matched: Sequence[RegionMatch]) -> float:
    """Mean cosine over distractor regions, weighted by pixels; NaN without regions."""
    pixels = sum(m.pixels for m in matched)
    return sum(m.pixels * m.cosine for m in matched) / pixels if pixels else math.nan


def _cells(shape: tuple[int, ...], h: int, w: int) -> np.ndarray:  # [H, W] int
    """The cell of an h x w grid that contains each pixel."""
    rows = np.arange(shape[0]) * h // shape[0]
    cols = np.arange(shape[1]) * w // shape[1]
    return np.asarray(rows[:, None] * w + cols[None, :])


def _stacked(statics: Sequence[RegionFeatures]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit features [S, C] of all regions with a non-zero feature, their photos [S] and labels [S]."""
    if not any(len(s) for s in statics):
        return np.zeros((0, 1)), np.zeros(0, int), np.zeros(0, int)
    full = [(k, s) for k, s in enumerate(statics) if len(s)]
    means = np.concatenate([s.means for _, s in full])
    photo = np.concatenate([np.full(len(s), k) for k, s in full])
    label = np.concatenate([s.labels for _, s in full])
    norms = np.linalg.norm(means, axis=1)
    good = norms > 0
    return means[good] / norms[good, None], photo[good], label[good]
