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
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians, rotation_matrices

Overlap = Literal["normalised", "literal"]
EIGEN_FLOOR = 1e-14  # least eigenvalue, as a share of the largest: needles up to 1e7 to 1
_PAIRS = 2**16  # pairs whose overlaps are computed at a time, 1.2 kB each
# Matrices that are decomposed at a time: cuSOLVER refuses above about 32 000, and its workspace grows with
# their number.
_MATRICES = 2**10


@dataclass(frozen=True)
class MergeConfig:
    """When two Gaussians merge. Colour and overlap are the paper's."""

    neighbours: int = 8  # k of Algorithm 1, which the paper does not state
    colour: float = 0.15  # largest L2 distance of the constant colours in [0, 1] RGB; 0.10 to 0.20 tried
    overlap: float = 0.3  # smallest overlap
    form: Overlap = "normalised"  # `literal` is the printed density
    most: int = 2  # largest cluster, the most overlapping pairs first; 0 = whole connected components

    def __post_init__(self) -> None:
        positive = (0, math.inf)
        check_limits(
            self, "refinesplat.density.merge",
            neighbours=(1, math.inf), colour=positive, overlap=positive, most=positive,
        )  # fmt: skip
        if self.most == 1:
            raise AwError("refinesplat.density.merge.most is 0 (any number) or at least 2, got 1")


@torch.no_grad()
def merge_gaussians(
    gaussians: Gaussians, candidates: Tensor, config: MergeConfig
) -> tuple[Tensor, Gaussians] | None:
    """Merge Gaussians, the most overlapping pairs first.

    Args:
        gaussians: the N Gaussians.
        candidates: [N] bool, rows that may merge (accumulated gradient below tau_e).
        config: thresholds.

    Returns:
        Rows [n] that merge and the Gaussians that replace them; None if nothing merges.
    """
    pairs = merge_pairs(gaussians, candidates, config)
    if config.most == 2:
        couples = pairs[greedy_matching(len(gaussians), pairs)]
        rows, cluster = couples.flatten(), torch.arange(len(couples), device=pairs.device)
        cluster = cluster.repeat_interleave(2, output_size=len(rows))
    else:
        whole = clusters(len(gaussians), pairs, config.most)
        rows = torch.nonzero(torch.bincount(whole)[whole] > 1).squeeze(1)
        cluster = whole[rows]
    return (rows, merge_members(gaussians.select(rows), cluster)) if len(rows) else None


def merge_pairs(gaussians: Gaussians, candidates: Tensor, config: MergeConfig) -> Tensor:
    """Return pairs of rows [n, 2] int64 to merge, the most overlapping first; see `merge_gaussians`."""
    rows = torch.nonzero(candidates).squeeze(1)
    if len(rows) < 2:
        return rows.new_zeros((0, 2))
    chosen = gaussians.with_sh_degree(0).select(rows)  # higher harmonics are not compared
    # many centres coincide after cloning: a point itself may not be among its neighbours
    near = backend_of(rows.device).neighbours(chosen.means, min(config.neighbours + 1, len(rows)))
    i = torch.arange(len(rows), device=rows.device)[:, None].expand_as(near)
    keys = torch.minimum(i, near) * len(rows) + torch.maximum(i, near)
    keys = torch.unique(keys[i != near])  # one number for each pair: rows take forty times as long to sort
    pairs = torch.stack([keys // len(rows), keys % len(rows)], 1)
    colours = chosen.sh0.double() * SH_C0 + 0.5
    alike = torch.linalg.vector_norm(colours[pairs[:, 0]] - colours[pairs[:, 1]], dim=1) < config.colour
    pairs = pairs[alike]
    ratio = torch.cat([overlap_of_rows(chosen, part, config.form) for part in pairs.split(_PAIRS)])
    kept = ratio > config.overlap
    pairs, ratio = pairs[kept], ratio[kept]
    # stable: ties stay in the order of rows
    return rows[pairs[ratio.argsort(descending=True, stable=True)]]


def covariances(gaussians: Gaussians) -> Tensor:
    """Return R diag(exp(log_scales))^2 R^T, [N, 3, 3] float64."""
    half = rotation_matrices(gaussians.quats.double()) * gaussians.log_scales.double().exp()[:, None, :]
    return half @ half.mT


def overlap_of_rows(gaussians: Gaussians, pairs: Tensor, form: Overlap) -> Tensor:
    """Return `overlap` of pairs of rows [n, 2], [n] float64."""
    a, b = (gaussians.select(pairs[:, side]) for side in range(2))
    return overlap(a.means.double() - b.means.double(), covariances(a), covariances(b), form)


def overlap(delta: Tensor, cov_i: Tensor, cov_j: Tensor, form: Overlap = "normalised") -> Tensor:
    """Return the overlap ratio of pairs (Eq. 11), [n] float64.

    normalised: exp(-d^T (Si + Sj)^-1 d / 2) (|2 Si| |2 Sj|)^(1/4) / |Si + Sj|^(1/2), in [0, 1], 1 for
    identical Gaussians and the same at every scale of the scene (Bhattacharyya's form with Si + Sj).
    literal: the printed density exp(...) / sqrt((2 pi)^3 |Si + Sj|), in 1/volume.

    Args:
        delta: mu_i - mu_j [n, 3] float64.
        cov_i: [n, 3, 3].
        cov_j: [n, 3, 3].
        form: which of the two.
    """
    total = cov_i + cov_j
    # unit variance on the diagonal first: a scene in millimetres must not underflow
    scale = total.diagonal(dim1=1, dim2=2).clamp(min=1e-300).sqrt()
    d = delta / scale
    # L D L^T with pivots that are floored: the sum of two parallel needles is singular in float64
    lower, pivots = _factors(total / scale[:, :, None] / scale[:, None, :])
    y0 = d[:, 0]
    y1 = d[:, 1] - lower[0] * y0
    y2 = d[:, 2] - lower[1] * y0 - lower[2] * y1
    squared = y0 * y0 + y1 * y1 / pivots[0] + y2 * y2 / pivots[1]
    log_total = pivots[0].log() + pivots[1].log() + 2 * scale.log().sum(1)
    if form == "normalised":
        log_parts = 0.25 * (torch.linalg.slogdet(torch.stack([cov_i, cov_j]))[1].sum(0) + 6 * math.log(2.0))
        return (-0.5 * squared + log_parts - 0.5 * log_total).clamp(max=0.0).exp()
    if form == "literal":
        return (-0.5 * squared - 0.5 * (3 * math.log(2 * math.pi) + log_total)).clamp(max=700.0).exp()
    raise unknown("overlap", form, ("normalised", "literal"))


def _factors(normed: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return L (1,0), (2,0), (2,1) and the last two pivots, floored, of L D L^T; the diagonal is 1."""
    l10, l20 = normed[:, 1, 0], normed[:, 2, 0]
    second = (1.0 - l10 * l10).clamp(min=EIGEN_FLOOR)
    l21 = (normed[:, 2, 1] - l20 * l10) / second
    third = (1.0 - l20 * l20 - l21 * l21 * second).clamp(min=EIGEN_FLOOR)
    return (l10, l20, l21), (second, third)


def greedy_matching(count: int, pairs: Tensor) -> Tensor:
    """Choose pairs greedily in this order, each row at most once, [n] bool.

    A pair that is the first of both its rows is always chosen. So all of these are chosen at once, and then
    again among the rows that are left.

    Args:
        count: number of rows.
        pairs: [n, 2] in the order in which they are tried.
    """
    place = torch.arange(len(pairs), device=pairs.device)
    taken = torch.zeros(len(pairs), dtype=torch.bool, device=pairs.device)
    free = torch.ones(count, dtype=torch.bool, device=pairs.device)
    alive = place
    while len(alive):
        a, b = pairs[alive].unbind(1)
        first = torch.full((count,), len(pairs), dtype=torch.int64, device=pairs.device)
        first = first.scatter_reduce(0, a, alive, "amin").scatter_reduce(0, b, alive, "amin")
        sure = alive[(first[a] == alive) & (first[b] == alive)]
        taken[sure] = True
        free[pairs[sure].flatten()] = False
        alive = alive[free[a] & free[b]]
    return taken


def clusters(count: int, pairs: Tensor, most: int = 0) -> Tensor:
    """Return the cluster of every row [count] int64; rows that pairs join share a number. Runs on the host.

    Without a limit a chain of pairs becomes one cluster, and a plain wall, whose neighbours all overlap,
    one Gaussian; with `most`, a pair whose cluster would exceed it is skipped.

    Args:
        count: number of rows.
        pairs: [n, 2], in the order in which they are tried.
        most: largest cluster; 0 = no limit (union-find over all pairs).
    """
    if most <= 0:
        i, j = pairs.T.cpu().numpy()
        graph = sparse.coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count))
        labels = connected_components(graph, directed=False)[1].astype(np.int64)
        return torch.from_numpy(labels).to(pairs.device)
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
    return torch.tensor([root(k) for k in range(count)], dtype=torch.int64, device=pairs.device)


def merge_members(members: Gaussians, cluster: Tensor) -> Gaussians:
    """Replace each cluster by a Gaussian with the moments of the opacity-weighted mixture (Eq. 12).

    Args:
        members: the rows that merge.
        cluster: [len(members)] int64, any numbers; the result is in the order of these numbers.

    Returns:
        Gaussians, float32: mu*, c* and SH weighted by opacity, alpha* the mean opacity, Sigma* the mixture's.
    """
    names, index, sizes = torch.unique(cluster, return_inverse=True, return_counts=True)

    def summed(x: Tensor) -> Tensor:
        return x.new_zeros(len(names), *x.shape[1:]).index_add_(0, index, x)

    alpha = torch.sigmoid(members.opacity_logits.double())
    # weights floored: a cluster of invisible members still has a mean
    weight = alpha.clamp(min=1e-12)
    weight = weight / summed(weight)[index]

    def mixed(x: Tensor) -> Tensor:
        return summed(x.double() * weight.view(-1, *[1] * (x.dim() - 1)))

    center = mixed(members.means)
    away = members.means.double() - center[index]
    log_scales, quats = scale_rotation(mixed(covariances(members) + away[:, :, None] * away[:, None, :]))
    mean_alpha = (summed(alpha) / sizes).clamp(1e-7, 1 - 1e-7)
    return Gaussians(
        means=center.float(),
        quats=quats.float(),
        log_scales=log_scales.float(),
        opacity_logits=(mean_alpha.log() - (-mean_alpha).log1p()).float(),
        sh0=mixed(members.sh0).float(),
        sh_rest=mixed(members.sh_rest).float(),
        attributes={name: mixed(values).float() for name, values in members.attributes.items()},
    )


def scale_rotation(cov: Tensor) -> tuple[Tensor, Tensor]:
    """Return log_scales [n, 3] and quats [n, 4] (w, x, y, z) of covariances [n, 3, 3]."""
    parts = [torch.linalg.eigh(part) for part in cov.split(_MATRICES)]
    values, vectors = (torch.cat(part) for part in zip(*parts))
    values = torch.maximum(values, values[:, 2:].clamp(min=1e-300) * EIGEN_FLOOR)
    flip = torch.where(torch.linalg.det(vectors) < 0, -1.0, 1.0).to(vectors)
    vectors = torch.cat([vectors[:, :, :1] * flip[:, None, None], vectors[:, :, 1:]], 2)
    return 0.5 * values.log(), _quaternions(vectors)


def _quaternions(r: Tensor) -> Tensor:
    """Return quaternions [n, 4] (w, x, y, z) of rotations [n, 3, 3], by the largest component (Shepperd)."""
    xx, yy, zz = r.diagonal(dim1=1, dim2=2).unbind(1)
    four = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], 1)
    x, y, z = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    xy, xz, yz = r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1]
    rows = torch.stack(
        [
            torch.stack([four[:, 0], x, y, z], 1),
            torch.stack([x, four[:, 1], xy, xz], 1),
            torch.stack([y, xy, four[:, 2], yz], 1),
            torch.stack([z, xz, yz, four[:, 3]], 1),
        ],
        1,
    )
    best = four.argmax(1)[:, None, None].expand(-1, 1, 4)
    return torch.nn.functional.normalize(rows.gather(1, best)[:, 0], dim=1)
