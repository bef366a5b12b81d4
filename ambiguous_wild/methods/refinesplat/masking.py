"""Local, global and final masks (RefineSplat, Eqs. 3-7) from maps on the feature grid.

Masks here are bool, True = transient; keep = 1 - M_final. Statistics are in float64.
"""

from __future__ import annotations

from typing import get_args

import cv2
import numpy as np

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.refinesplat.config import MaskConfig, Spread

GAPS = 1.25  # times its limit: as large may a mask be whose gaps are filled
_COS_FLOOR = -1.0 + 1e-3  # U stays below 2000


def enlarge(grid: np.ndarray, height: int, width: int) -> np.ndarray:
    """A map [h, w] on the image's pixels [H, W], each taking its cell's value."""
    rows = (np.arange(height) * grid.shape[0]) // height
    columns = (np.arange(width) * grid.shape[1]) // width
    return grid[rows[:, None], columns[None, :]]


def grid_labels(labels: np.ndarray, h: int, w: int) -> np.ndarray:
    """Labels [h, w] at the centre of each cell of labels [H, W]."""
    rows = ((np.arange(h) * 2 + 1) * labels.shape[0]) // (2 * h)
    columns = ((np.arange(w) * 2 + 1) * labels.shape[1]) // (2 * w)
    return labels[rows[:, None], columns[None, :]]


def instance_means(
    grid: np.ndarray,  # [h, w], e.g. the entropy map
    labels: np.ndarray,  # [H, W] int32, instances from 1; 0 and negative labels are none
    count: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Hbar of labels 1..count (Eq. 3), each cell weighted by the instance's area in it.

    Returns:
        means [count] float64 (NaN for a label without pixels), areas [count] px.
    """
    flat = np.clip(labels, 0, None).ravel()
    areas = np.bincount(flat, minlength=count + 1)[1 : count + 1].astype(np.float64)
    values = enlarge(np.asarray(grid, dtype=np.float64), *labels.shape).ravel()
    sums = np.bincount(flat, weights=values, minlength=count + 1)[1 : count + 1]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(areas > 0, sums / areas, np.nan), areas


def local_mask(labels: np.ndarray, flagged: np.ndarray) -> np.ndarray:
    """M_local [H, W] (Eq. 5): the pixels of flagged instances; flagged [count] is of labels 1..count."""
    table = np.r_[False, np.asarray(flagged, dtype=bool)]
    return table[np.clip(labels, 0, len(table) - 1)] & (labels < len(table))


def uncertainty(cosine: np.ndarray) -> np.ndarray:
    """U = 2 / (cos + 1) in [1, 2000] (Eq. 6); a cosine that is not finite counts as 1 (no evidence)."""
    cosine = np.nan_to_num(np.asarray(cosine, dtype=np.float64), nan=1.0, posinf=1.0, neginf=1.0)
    return 2.0 / (np.clip(cosine, _COS_FLOOR, 1.0) + 1.0)


def calibrated_cosine(distance: np.ndarray, normal: float) -> np.ndarray:
    """A cosine that uses its whole range: 1 at distance 0, 0 at `normal` units, -1 at twice that and beyond.

    Cosines of hand-made features stay above 0.99, where U is 1 everywhere; so the distance is taken in units
    of what blur and noise alone make.
    """
    return 1.0 - np.clip(np.asarray(distance, dtype=np.float64) / normal, 0.0, 2.0)


def ratio(
    u: np.ndarray, h: np.ndarray, eps_share: float = 0.1, perturbation: float | None = None
) -> np.ndarray:
    """R = U / max(H, eps) with eps = `eps_share` of H's own mean, so that no H = 0 dominates var(R).

    With a `perturbation` (printed; its value is not) R = U / (H + perturbation).
    """
    u, h = np.asarray(u, dtype=np.float64), np.asarray(h, dtype=np.float64)
    if perturbation is not None:
        return u / (h + perturbation)
    eps = max(eps_share * float(h.mean()), 1e-6)
    return u / np.maximum(h, eps)


def global_mask(
    r: np.ndarray, box: int = 3, spread: Spread = "var", gate: float = 0.0, hard: float = 0.0
) -> np.ndarray:
    """M_global [h, w]: box-filtered R above its threshold (Eq. 6).

    Args:
        r: [h, w] float64.
        box: side of the box filter in cells.
        spread: threshold mean + var (printed), mean + std, robust: median + gate * 1.4826 MAD, or hard: the
            fixed value `hard` (T_hard, with which the paper compares T_glb).
        gate: for every spread, also the least number of robust deviations above the median; 0 = none.
        hard: of spread `hard`.
    """
    smooth = cv2.blur(np.asarray(r, dtype=np.float64), (box, box), borderType=cv2.BORDER_REPLICATE)
    floor = -np.inf
    if gate > 0 or spread == "robust":
        median = float(np.median(smooth))
        mad = 1.4826 * float(np.median(np.abs(smooth - median)))
        floor = median + gate * max(mad, 0.05 * abs(median))
    if spread == "var":
        threshold = float(r.mean() + r.var())
    elif spread == "std":
        threshold = float(r.mean() + r.std())
    elif spread == "robust":
        threshold = floor
    elif spread == "hard":
        threshold = hard
    else:
        raise unknown("spread", spread, get_args(Spread))
    return smooth > max(threshold, floor)


def dilate(mask: np.ndarray, size: int) -> np.ndarray:
    """The mask grown by a size x size square; 1 or less leaves it alone."""
    if size <= 1 or not mask.any():
        return mask
    return cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)).astype(bool)


def hysteresis(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """[H, W] bool: connected regions above `low` that somewhere exceed `high` (Canny's rule)."""
    count, regions = cv2.connectedComponents((values > low).astype(np.uint8), connectivity=8)
    strong = np.zeros(count, dtype=bool)
    strong[np.unique(regions[values > max(low, high)])] = True
    strong[0] = False
    return strong[regions]


def fill_holes(mask: np.ndarray, share: float) -> np.ndarray:
    """The mask [H, W] with every enclosed gap filled that is smaller than `share` of the photo."""
    if share <= 0 or not mask.any():
        return mask
    _, regions, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] < share * mask.size
    small[0] = False  # the mask itself
    return mask | small[regions]


def grown(transient: np.ndarray, config: MaskConfig, evidence: np.ndarray) -> np.ndarray:
    """M_final [H, W] bool of what passed the threshold: no larger than allowed, gaps filled, dilated.

    Of a too large mask the surest pixels are masked. Their gaps are filled too, because a mask with specks
    lets a distractor through; the mask may be a quarter larger then (`GAPS`).

    Args:
        transient: [H, W] bool.
        config: `most`, the largest share of the photo that is masked; `fill`, `dilation`.
        evidence: [H, W], larger = surer.
    """
    if transient.mean() <= config.most:
        return dilate(fill_holes(transient, config.fill), config.dilation)
    inside = np.sort(evidence[transient])
    cut = inside[len(inside) - max(int(config.most * transient.size), 1)]
    surest = transient & (evidence > cut)
    larger = dilate(fill_holes(surest, config.fill), config.dilation)
    return larger if larger.mean() <= GAPS * config.most else surest
