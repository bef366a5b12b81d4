"""Merging of overlapping Gaussians (RefineSplat, Eqs. 11-12 and Algorithm 1), in float64.

Two readings are ours. The printed overlap is a probability density in 1/volume, so a threshold of 0.3 depends
on the scale of the scene; the default is normalised to [0, 1]. And the printed outer product
(mu_i - mu*)(mu* - mu_i)^T is negative: it makes the merged covariance indefinite; the sign here is a
mixture's second moment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.splat.density import rotation_matrices
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians

Overlap = Literal["normalised", "literal"]
EIGEN_FLOOR = 1e-14  # of the largest eigenvalue: condition numbers up to needles of 1e7 to 1


@dataclass(frozen=True)
class MergeConfig:
    """When two Gaussians merge. Colour and overlap are the paper's."""

    neighbours: int = 8  # k of Algorithm 1; not stated
    colour: float = 0.15  # largest L2 distance of the constant colours in [0, 1] RGB; 0.10 to 0.20 tried
    overlap: float = 0.3  # smallest overlap
    form: Overlap = "normalised"  # `literal` is the printed density
    most: int = 2  # members of a cluster, the most overlapping pairs first; 0 = whole connected components

    def __post_init__(self) -> None:
        positive = (0, math.inf)
        check_limits(
            self, "refinesplat.density.merge",
            neighbours=(1, math.inf), colour=positive, overlap=positive, most=positive,
        )  # fmt: skip
        if self.most == 1:
            raise AwError("refinesplat.density.merge.most is 0 (any number) or at least 2, got 1")


def covariances(gaussians: Gaussians) -> np.ndarray:
    """[N, 3, 3] float64, R diag(exp(log_scales))^2 R^T."""
    rotation = rotation_matrices(gaussians.quats.detach().cpu().double()).numpy()
    scale = np.exp(gaussians.log_scales.detach().cpu().double().numpy())
    half = rotation * scale[:, None, :]
    return half @ half.transpose(0, 2, 1)


def overlap(
    delta: np.ndarray, cov_i: np.ndarray, cov_j: np.ndarray, form: Overlap = "normalised"
) -> np.ndarray:
    """Overlap ratio of pairs (Eq. 11).

    normalised: exp(-d^T (Si + Sj)^-1 d / 2) (|2 Si| |2 Sj|)^(1/4) / |Si + Sj|^(1/2), in [0, 1], 1 for
    identical Gaussians and the same at every scale of the scene (Bhattacharyya's form with Si + Sj).
    literal: the printed density exp(...) / sqrt((2 pi)^3 |Si + Sj|), in 1/volume.

    Args:
        delta: mu_i - mu_j [n, 3].
        cov_i: [n, 3, 3].
        cov_j: [n, 3, 3].
    """
    total = cov_i + cov_j
    # unit variance on the diagonal first: a scene in millimetres must not underflow
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", total), 1e-300))
    normed = total / scale[:, :, None] / scale[:, None, :]
    d = delta / scale
    # by eigenvalues, floored: two parallel needles of aspect 1e12 are singular in float64, and solve raises
    values, vectors = np.linalg.eigh(normed)
    squared = (np.einsum("nij,ni->nj", vectors, d) ** 2 / np.maximum(values, EIGEN_FLOOR)).sum(1)
    log_total = _log_det(normed) + 2 * np.log(scale).sum(1)
    if form == "normalised":
        log_parts = 0.25 * (_log_det(cov_i) + _log_det(cov_j) + 6 * math.log(2.0))
        return np.exp(np.minimum(-0.5 * squared + log_parts - 0.5 * log_total, 0.0))
    if form == "literal":
        return np.exp(np.minimum(-0.5 * squared - 0.5 * (3 * math.log(2 * math.pi) + log_total), 700.0))
    raise unknown("overlap", form, ("normalised", "literal"))


def merge_pairs(gaussians: Gaussians, candidates: np.ndarray, config: MergeConfig) -> np.ndarray:
    """Pairs of rows [n, 2] to merge, the most overlapping first.

    Args:
        gaussians: all of them.
        candidates: [N] bool, rows that may merge (accumulated gradient below tau_e).
        config: thresholds.
    """
    rows = np.flatnonzero(candidates)
    if len(rows) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    chosen = gaussians.select(torch.from_numpy(rows).to(gaussians.device))
    means = chosen.means.detach().cpu().double().numpy()
    # many centres coincide after cloning: the tree needs leaves that split on ties
    _, near = cKDTree(means, balanced_tree=False).query(means, k=min(config.neighbours + 1, len(rows)))
    i = np.repeat(np.arange(len(rows)), near.shape[1])
    j = near.ravel()
    low, high = np.minimum(i, j)[i != j], np.maximum(i, j)[i != j]
    # as one number a pair: rows take forty times as long to sort
    pairs = np.stack(np.divmod(np.unique(low * len(rows) + high), len(rows)), 1)
    colour = chosen.sh0.detach().cpu().double().numpy() * SH_C0 + 0.5
    alike = np.linalg.norm(colour[pairs[:, 0]] - colour[pairs[:, 1]], axis=1) < config.colour
    pairs = pairs[alike]
    cov = covariances(chosen)
    a, b = pairs[:, 0], pairs[:, 1]
    ratio = overlap(means[a] - means[b], cov[a], cov[b], config.form)
    keep = ratio > config.overlap
    pairs, ratio = pairs[keep], ratio[keep]
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -ratio))
    return rows[pairs[order]]


def clusters(count: int, pairs: np.ndarray, most: int = 0) -> np.ndarray:
    """Cluster of every row [count]: rows joined by pairs share a number.

    Without a limit a chain of pairs becomes one cluster, and a plain wall, whose neighbours all overlap,
    one Gaussian; with `most`, a pair whose cluster would exceed it is skipped.

    Args:
        count: rows.
        pairs: [n, 2], in the order they are tried.
        most: members of a cluster at most; 0 = no limit (union-find over all pairs).
    """
    if most <= 0:
        graph = sparse.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
        return connected_components(graph, directed=False)[1].astype(np.int64)
    parent = list(range(count))
    size = [1] * count

    def root(k: int) -> int:
        while parent[k] != k:
            parent[k] = parent[parent[k]]
            k = parent[k]
        return k

    for i, j in pairs.tolist():
        a, b = root(i), root(j)
        if a != b and size[a] + size[b] <= most:
            parent[max(a, b)] = min(a, b)
            size[min(a, b)] += size[max(a, b)]
    return np.array([root(k) for k in range(count)], dtype=np.int64)


def merge_members(members: Gaussians, cluster: np.ndarray) -> Gaussians:
    """One Gaussian a cluster with the first two moments of the opacity-weighted mixture (Eq. 12).

    Args:
        members: the rows that merge.
        cluster: [len(members)], any numbers; the result is in their order.

    Returns:
        Gaussians, float32: mu*, c* and SH weighted by opacity, alpha* the mean opacity, Sigma* the mixture's.
    """
    _, index = np.unique(cluster, return_inverse=True)
    count = int(index.max()) + 1
    alpha = torch.sigmoid(members.opacity_logits.detach().cpu().double()).numpy()
    # weights floored: a cluster of invisible members still has a mean
    total = np.bincount(index, weights=np.maximum(alpha, 1e-12), minlength=count)
    weight = np.maximum(alpha, 1e-12) / total[index]
    mix = sparse.csr_matrix((weight, (index, np.arange(len(index)))), shape=(count, len(index)))

    means = members.means.detach().cpu().double().numpy()
    center = mix @ means
    away = means - center[index]
    second = covariances(members) + away[:, :, None] * away[:, None, :]
    cov = (mix @ second.reshape(-1, 9)).reshape(-1, 3, 3)
    log_scales, quats = scale_rotation(cov)

    mean_alpha = np.bincount(index, weights=alpha, minlength=count) / np.bincount(index, minlength=count)
    logits = np.log(np.clip(mean_alpha, 1e-7, 1 - 1e-7)) - np.log1p(-np.clip(mean_alpha, 1e-7, 1 - 1e-7))
    sh_rest = members.sh_rest.detach().cpu().double().numpy().reshape(len(members), -1)
    return Gaussians(
        means=_tensor(center),
        quats=_tensor(quats),
        log_scales=_tensor(log_scales),
        opacity_logits=_tensor(logits),
        sh0=_tensor(mix @ members.sh0.detach().cpu().double().numpy()),
        sh_rest=_tensor((mix @ sh_rest).reshape(count, members.sh_rest.shape[1], 3)),
        extra={name: _mixed(mix, values, count) for name, values in members.extra.items()},
    ).to(members.device)


def _mixed(mix: sparse.csr_matrix, values: Tensor, count: int) -> Tensor:
    """Weighted means [count, ...] of what every member carries."""
    flat = values.detach().cpu().double().numpy().reshape(len(values), -1)
    return _tensor((mix @ flat).reshape(count, *values.shape[1:]))


def scale_rotation(cov: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """log_scales [n, 3] and quats [n, 4] (w, x, y, z) of covariances [n, 3, 3], rotation right-handed."""
    values, vectors = np.linalg.eigh(cov)
    largest = np.maximum(values[:, 2:], 1e-300)
    values = np.maximum(values, largest * EIGEN_FLOOR)
    left = np.linalg.det(vectors) < 0
    vectors[left, :, 0] *= -1.0
    xyzw = Rotation.from_matrix(vectors).as_quat()
    return 0.5 * np.log(values), xyzw[:, [3, 0, 1, 2]]


def _log_det(cov: np.ndarray) -> np.ndarray:
    return np.linalg.slogdet(cov)[1]


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
