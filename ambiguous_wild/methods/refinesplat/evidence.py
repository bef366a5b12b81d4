"""One photo compared with one render: the maps, and the masks made from them. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.refinesplat import masking
from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.entropy import Statistic, contrast, entropy, surprise
from ambiguous_wild.methods.refinesplat.identity import Psi
from ambiguous_wild.methods.refinesplat.threshold import Cut, robust_floor, t_ent


@dataclass(frozen=True)
class Maps:
    """Float arrays of one photo compared with one render: on the feature grid [h, w], or on pixels [H, W]."""

    statistic: np.ndarray  # what is judged, in its unit
    distance: np.ndarray  # distance of photo and render, in units of the normal one
    entropy: np.ndarray | None = None  # H of the render, in [0, 1]
    cosine: np.ndarray | None = None  # cos(phi(I), phi(render))


@dataclass(frozen=True)
class Judged:
    """Statistics of the instances of one photo; those of other photos say what is normal in the scene."""

    values: np.ndarray  # [K] float64, mean statistic (Hbar)
    distances: np.ndarray  # [K] float64, mean distance in units
    areas: np.ndarray  # [K] float64, px


@dataclass(frozen=True)
class Masks:
    """On the photo's pixels, [H, W] bool, True = transient; and what they were made from."""

    local: np.ndarray
    global_: np.ndarray
    keep: np.ndarray  # [H, W] float32, 1 - M_final, bounded
    judged: Judged
    cut: Cut


@torch.no_grad()
def compare(phi_photo: Tensor, phi_render: Tensor, psi: Psi | None, unit: float, config: MaskConfig) -> Maps:
    """Entropy, statistic and distance maps of features [h, w, C] of photo and render.

    Without psi (no instance has an identity) the entropy is 0 and the distance alone is judged.
    """
    norms = torch.linalg.vector_norm(phi_photo, dim=2) * torch.linalg.vector_norm(phi_render, dim=2)
    # a feature of length 0 (black in both) counts as agreement
    cosine = torch.where(norms > 0, (phi_photo * phi_render).sum(2) / norms.clamp(min=1e-12), 1.0)
    distance = (1.0 - cosine).clamp(min=0.0) / unit
    if psi is None:
        zero = np.zeros(tuple(distance.shape))
        return Maps(_array(distance), _array(distance), zero, _array(cosine))
    render = psi(phi_render)
    h = entropy(render, config.variant)
    if config.statistic == "entropy":
        statistic = h
    elif config.statistic == "surprise":
        statistic = surprise(render, psi(phi_photo), config.variant)
    elif config.statistic == "contrast":
        statistic = contrast(render, psi(phi_photo), config.variant)
    elif config.statistic in ("evidence", "structure"):
        statistic = torch.sqrt(contrast(render, psi(phi_photo), config.variant) * distance)
    else:
        raise unknown("statistic", config.statistic, get_args(Statistic))
    return Maps(_array(statistic), _array(distance), _array(h), _array(cosine))


def silence(maps: Maps, unseen: np.ndarray) -> Maps:
    """The maps without evidence where the model is not learnt yet (bool [h, w]).

    A sky without points differs from every photo until it is learnt; if masked, it would never be learnt.
    """
    return Maps(
        np.where(unseen, 0.0, maps.statistic),
        np.where(unseen, 0.0, maps.distance),
        maps.entropy,
        None if maps.cosine is None else np.where(unseen, 1.0, maps.cosine),
    )


def scaled_by(structure: np.ndarray, evidence: np.ndarray, weight: float) -> np.ndarray:
    """Pixel evidence [H, W], raised where identities disagree and lowered where they agree.

    The factor 1 + weight (2 g - 1), g = evidence / (evidence + 4), lies in [1 - weight, 1 + weight]: the unit
    of the scene stays what it is.

    Args:
        structure: from `PixelEvidence`.
        evidence: [h, w] on the feature grid, in units; instances are suspect from 4 on.
        weight: 0 = identities are ignored.
    """
    share = np.maximum(evidence, 0.0)
    factor = 1.0 + weight * (2.0 * share / (share + 4.0) - 1.0)
    size = (structure.shape[1], structure.shape[0])
    return structure * cv2.resize(factor.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)


def make_masks(
    maps: Maps,
    labels: np.ndarray,
    static: np.ndarray,
    others: Sequence[Judged],
    w2: float,
    config: MaskConfig,
    ceiling: float = math.inf,
    unseen: np.ndarray | None = None,
) -> Masks:
    """M_local, M_global and the keep map of one photo (Eqs. 3-7).

    Args:
        maps: from `compare`.
        labels: [H, W] int32 instances, 0 = none.
        static: [K] bool, instances that are not to be masked.
        others: instances of the scene's other photos when they were last judged (`scope` = scene).
        w2: weight of T_ent's lower subset.
        config: thresholds.
        ceiling: upper limit of the threshold.
        unseen: [H, W] bool, pixels that are not judged: part of no instance, and never masked.
    """
    if unseen is not None:
        labels = np.where(unseen, 0, labels)
    height, width = labels.shape
    count = len(static)
    means, areas = masking.instance_means(maps.statistic, labels, count)
    distances, _ = masking.instance_means(maps.distance, labels, count)
    known = areas > 0
    judged = Judged(means[known], distances[known], areas[known])
    pool = pooled([judged, *others] if config.scope == "scene" else [judged])
    cut = t_ent(pool.values, w2, config.threshold, config.gate, config.floor, config.hard)
    if cut.threshold > ceiling:
        cut = Cut(ceiling, pool.values > ceiling, min(cut.floor, ceiling))
    flagged = np.zeros(count, dtype=bool)
    flagged[known] = judged.values > cut.threshold
    if config.statistic != "structure":
        flagged[known] &= differs(judged, pool, config)
    flagged &= ~static
    local = masking.local_mask(labels, flagged) if config.use_local else np.zeros(labels.shape, bool)
    pixels = masking.enlarge(maps.statistic, height, width)
    if config.use_global:
        global_ = _global(maps, pixels, cut.threshold, config) & ~masking.local_mask(labels, static)
    else:
        global_ = np.zeros(labels.shape, bool)
    final, judging = local | global_, pixels
    if config.combine == "fused" and config.use_local and config.use_global:
        of_pixel = np.r_[0.0, np.nan_to_num(means)][np.clip(labels, 0, count)]
        # a pixel without an instance is judged alone
        judging = np.where(labels > 0, np.sqrt(pixels * of_pixel), pixels)
        final = masking.hysteresis(judging, config.hold * cut.threshold, cut.threshold)
        final &= ~masking.local_mask(labels, static)
    if unseen is not None:
        final &= ~unseen
    final = masking.grown(final, config, judging)
    if unseen is not None:
        final &= ~unseen
    return Masks(local, global_, (~final).astype(np.float32), judged, cut)


def _global(maps: Maps, pixels: np.ndarray, threshold: float, config: MaskConfig) -> np.ndarray:
    """M_global [H, W]: pixels above the threshold, or on the feature grid Eq. 6's ratio of U and H."""
    if config.statistic == "structure":
        return masking.hysteresis(pixels, config.hold * threshold, threshold)
    assert maps.cosine is not None and maps.entropy is not None  # `compare` fills them
    cosine = maps.cosine
    if config.cosine == "calibrated":
        cosine = masking.calibrated_cosine(maps.distance, config.normal_units)
    r = masking.ratio(masking.uncertainty(cosine), maps.entropy, perturbation=config.perturbation)
    coarse = masking.global_mask(r, config.box, config.spread, config.global_gate, config.global_hard)
    if config.global_units > 0:
        coarse &= maps.distance > config.global_units
    return masking.enlarge(coarse, *pixels.shape)


def pooled(parts: Sequence[Judged]) -> Judged:
    """The instances of several photos as one set."""
    return Judged(
        np.concatenate([p.values for p in parts]),
        np.concatenate([p.distances for p in parts]),
        np.concatenate([p.areas for p in parts]),
    )


def differs(judged: Judged, pool: Judged, config: MaskConfig) -> np.ndarray:
    """[K] bool: instances in which photo and render disagree more than is normal.

    An instance whose identity psi is unsure of is no distractor if the render agrees with the photo.
    """
    if config.disagree <= 0:
        return np.ones(len(judged.distances), dtype=bool)
    floor = robust_floor(pool.distances, config.disagree)
    return judged.distances > max(floor, config.disagree_units)


def _array(t: Tensor) -> np.ndarray:
    return t.double().cpu().numpy()
