"""One photo against one render: the maps, and from them the masks. Nothing here has a state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.refinesplat import masking
from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.entropy import contrast, entropy, surprise
from ambiguous_wild.methods.refinesplat.identity import Psi
from ambiguous_wild.methods.refinesplat.threshold import Cut, robust_floor, t_ent


@dataclass(frozen=True)
class Maps:
    """On the feature grid, [h, w] float64."""

    entropy: np.ndarray  # H of the render, in [0, 1]
    statistic: np.ndarray  # what instances are judged by
    distance: np.ndarray  # 1 - cos(phi(I), phi(render))


@dataclass(frozen=True)
class Masks:
    """On the photo's pixels, [H, W] bool, True = transient; and what they were made from."""

    local: np.ndarray
    global_: np.ndarray
    keep: np.ndarray  # [H, W] float32, 1 - M_final, bounded
    values: np.ndarray  # [K] Hbar
    distances: np.ndarray  # [K] mean distance, in units
    areas: np.ndarray  # [K] px
    cut: Cut


@torch.no_grad()
def compare(phi_photo: Tensor, phi_render: Tensor, psi: Psi | None, config: MaskConfig) -> Maps:
    """Entropy, statistic and distance maps of features [h, w, C] of photo and render.

    Without psi (no instance has an identity) entropy and statistic are 0 and only distance speaks.
    """
    norms = torch.linalg.vector_norm(phi_photo, dim=2) * torch.linalg.vector_norm(phi_render, dim=2)
    distance = 1.0 - (phi_photo * phi_render).sum(2) / norms.clamp(min=1e-12)
    distance = torch.where(norms > 0, distance, torch.zeros_like(distance))
    if psi is None:
        zero = np.zeros(tuple(distance.shape))
        return Maps(zero, zero, _array(distance))
    render = psi(phi_render)
    h = entropy(render, config.variant)
    if config.statistic == "entropy":
        statistic = h
    elif config.statistic == "surprise":
        statistic = surprise(render, psi(phi_photo), config.variant)
    elif config.statistic == "contrast":
        statistic = contrast(render, psi(phi_photo), config.variant)
    else:
        raise unknown("statistic", config.statistic, ("entropy", "surprise", "contrast"))
    return Maps(_array(h), _array(statistic), _array(distance))


def make_masks(
    maps: Maps, labels: np.ndarray, count: int, unit: float, w2: float, config: MaskConfig
) -> Masks:
    """M_local, M_global and the keep map of one photo (Eqs. 4-8).

    Args:
        maps: from `compare`.
        labels: [H, W] int32 instances, 0 = none.
        count: K.
        unit: of the features: the distance that blur and noise alone make.
        w2: weight of T_ent's lower subset.
        config: thresholds.
    """
    height, width = labels.shape
    values, areas = masking.instance_means(maps.statistic, labels, count)
    distances, _ = masking.instance_means(maps.distance / unit, labels, count)
    known = areas > 0
    flagged = np.zeros(count, dtype=bool)
    cut = t_ent(values[known], w2, config.threshold, config.gate)
    flagged[known] = cut.flagged & differs(distances[known], areas[known], config)
    local = masking.local_mask(labels, flagged) if config.use_local else np.zeros(labels.shape, bool)

    coarse = np.zeros(maps.distance.shape, dtype=bool)
    if config.use_global:
        cosine = 1.0 - maps.distance
        if config.cosine == "calibrated":
            cosine = masking.calibrated_cosine(maps.distance, unit, config.normal_units)
        r = masking.ratio(masking.uncertainty(cosine), maps.entropy)
        coarse = masking.global_mask(r, config.box, config.spread, config.global_gate)
    global_ = masking.enlarge(coarse, height, width)
    final = masking.dilate(local | global_, config.dilation)
    surest = masking.enlarge(maps.distance, height, width)
    keep = masking.keep_map(final, config.most, surest)
    return Masks(local, global_, keep, values[known], distances[known], areas[known], cut)


def differs(distances: np.ndarray, areas: np.ndarray, config: MaskConfig) -> np.ndarray:
    """[K] bool: instances whose photo and render disagree more than is normal in this photo.

    An identity that psi is unsure of is no distractor as long as the render shows what the photo shows.
    """
    if config.disagree <= 0:
        return np.ones(len(distances), dtype=bool)
    floor = robust_floor(distances, config.disagree)
    return distances > max(floor, config.disagree_units)


def _array(t: Tensor) -> np.ndarray:
    return t.double().cpu().numpy()
