"""Comparison of a photo with a render on features: the maps, and M_global of the paper (Eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.masking_common import resized
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig, Spread
from ambiguous_wild.methods.refinesplat.identity import Psi
from ambiguous_wild.methods.refinesplat.maps import spread_of
from ambiguous_wild.methods.refinesplat.structure import box_filter
from ambiguous_wild.methods.refinesplat.threshold import Statistic, cross_entropy, entropy, kl_divergence

_EPS_SHARE = 0.1
_COS_FLOOR = -1.0 + 1e-3  # U stays below 2000


@dataclass(frozen=True)
class ComparisonMaps:
    """Maps of one photo compared with one render: on the feature grid [h, w], or on pixels [H, W]."""

    statistic: Tensor  # the judged statistic, in its unit
    distance: Tensor  # distance of photo and render, in units of the normal distance
    entropy: Tensor | None = None  # H of the render, in [0, 1]
    cosine: Tensor | None = None  # cos(phi(I), phi(render))


@torch.no_grad()
def compare(
    phi_photo: Tensor, phi_render: Tensor, psi: Psi | None, unit: float, config: MaskConfig
) -> ComparisonMaps:
    """Compute entropy, statistic and distance maps in float64 of features [h, w, C] of photo and render.

    Without psi (no instance has an identity) the entropy is 0 and the distance alone is judged.
    """
    norms = torch.linalg.vector_norm(phi_photo, dim=2) * torch.linalg.vector_norm(phi_render, dim=2)
    # a feature of length 0 (black in both) counts as agreement
    cosine = torch.where(norms > 0, (phi_photo * phi_render).sum(2) / norms.clamp(min=1e-12), 1.0)
    distance = (1.0 - cosine).clamp(min=0.0) / unit
    if psi is None:
        return ComparisonMaps(
            distance.double(), distance.double(), torch.zeros_like(distance).double(), cosine.double()
        )
    render = psi(phi_render)
    h = entropy(render, config.variant)
    if config.statistic == "entropy":
        statistic = h
    elif config.statistic == "surprise":
        statistic = cross_entropy(render, psi(phi_photo), config.variant)
    elif config.statistic == "contrast":
        statistic = kl_divergence(render, psi(phi_photo), config.variant)
    elif config.statistic in ("evidence", "structure"):
        statistic = torch.sqrt(kl_divergence(render, psi(phi_photo), config.variant) * distance)
    else:
        raise unknown("statistic", config.statistic, get_args(Statistic))
    return ComparisonMaps(statistic.double(), distance.double(), h.double(), cosine.double())


def mask_unlearnt(maps: ComparisonMaps, unseen: Tensor) -> ComparisonMaps:
    """Remove the evidence where the model is not learnt yet (bool [h, w]).

    A sky without points differs from every photo until it is learnt, and if masked it never would be.
    """
    cosine = None if maps.cosine is None else maps.cosine.masked_fill(unseen, 1.0)
    return ComparisonMaps(
        maps.statistic.masked_fill(unseen, 0.0), maps.distance.masked_fill(unseen, 0.0), maps.entropy, cosine
    )


def scale_by_identities(structure: Tensor, evidence: Tensor, weight: float) -> Tensor:
    """Raise pixel evidence [H, W] where identities disagree, and lower it where they agree.

    The factor 1 + weight (2 g - 1), g = evidence / (evidence + 4), lies in [1 - weight, 1 + weight], so that
    the unit of the scene stays the same.

    Args:
        structure: evidence of `PixelEvidence`.
        evidence: [h, w] on the feature grid, in units; instances are suspect from 4 on.
        weight: 0 = identities are ignored.
    """
    share = evidence.clamp(min=0.0)
    factor = 1.0 + weight * (2.0 * share / (share + 4.0) - 1.0)
    return structure * resized(factor.float(), *structure.shape)


def uncertainty(cosine: Tensor) -> Tensor:
    """Return U = 2 / (cos + 1) in [1, 2000] (Eq. 6); a cosine that is not finite counts as 1."""
    cosine = cosine.nan_to_num(nan=1.0, posinf=1.0, neginf=1.0)
    return 2.0 / (cosine.clamp(_COS_FLOOR, 1.0) + 1.0)


def calibrated_cosine(distance: Tensor, normal: float) -> Tensor:
    """Return a cosine over the whole range: 1 at distance 0, 0 at `normal` units, -1 from twice that on.

    Cosines of hand-made features stay above 0.99, where U is 1 everywhere. So the distance is in units of
    what blur and noise alone cause.
    """
    return 1.0 - (distance / normal).clamp(0.0, 2.0)


def ratio(u: Tensor, h: Tensor, perturbation: float | None = None) -> Tensor:
    """Return R = U / max(H, eps) with eps = `_EPS_SHARE` of H's own mean, so that no H = 0 dominates var(R).

    With a `perturbation` (printed, but without its value) R = U / (H + perturbation).
    """
    if perturbation is not None:
        return u / (h + perturbation)
    return u / torch.maximum(h, (_EPS_SHARE * h.mean()).clamp(min=1e-6))


def global_mask(
    r: Tensor, size: int = 3, spread: Spread = "var", gate: float = 0.0, hard: float = 0.0
) -> Tensor:
    """Return M_global [h, w] bool: box-filtered R above its threshold (Eq. 6).

    Args:
        r: [h, w] float64.
        size: side of the box filter in cells.
        spread: threshold is mean + var (printed), mean + std, median + gate * 1.4826 MAD (`robust`), or the
            fixed value `hard` (T_hard, with which the paper compares T_glb).
        gate: for every spread also the least number of robust deviations above the median; 0 = none.
        hard: threshold of spread `hard`.
    """
    if spread not in get_args(Spread):
        raise unknown("spread", spread, get_args(Spread))
    smooth = box_filter(r[None], size)[0]
    middle, deviation = spread_of(smooth.flatten())
    floor = middle + gate * deviation
    if spread == "robust":
        return smooth > floor
    if spread == "hard":
        threshold = torch.full_like(floor, hard)
    else:
        threshold = r.mean() + (r.var(correction=0) if spread == "var" else r.std(correction=0))
    return smooth > (torch.maximum(threshold, floor) if gate > 0 else threshold)


def global_mask_from_maps(maps: ComparisonMaps, config: MaskConfig) -> Tensor:
    """Return M_global on the feature grid, [h, w] bool: the ratio of U and H above its threshold (Eq. 6)."""
    assert maps.cosine is not None and maps.entropy is not None  # `compare` fills them
    cosine = maps.cosine
    if config.cosine == "calibrated":
        cosine = calibrated_cosine(maps.distance, config.normal_units)
    r = ratio(uncertainty(cosine), maps.entropy, perturbation=config.perturbation)
    coarse = global_mask(r, config.box, config.spread, config.global_gate, config.global_hard)
    return coarse & (maps.distance > config.global_units) if config.global_units > 0 else coarse
