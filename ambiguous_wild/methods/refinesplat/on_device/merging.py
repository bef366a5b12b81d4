"""Merging of overlapping Gaussians on a device: merging.py with torch, without a copy to the host.

Pairs are those of `merge_pairs` and clusters those of `clusters` with at most two members. What differs is
rounding: overlaps are made by a factorisation of the sum of two covariances instead of its eigenvalues.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ambiguous_wild.methods.refinesplat.merging import EIGEN_FLOOR, MergeConfig
from ambiguous_wild.splat.density import rotation_matrices
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.gpu.nearest import nearest

_PAIRS = 2**20  # of which overlaps are computed at a time


@torch.no_grad()
def merge_couples(
    gaussians: Gaussians, candidates: Tensor, config: MergeConfig
) -> tuple[Tensor, Gaussians] | None:
    """Merge in twos, the most overlapping first; for `config.most` 2.

    Args:
        gaussians: all of them.
        candidates: [N] bool, rows that may merge.
        config: thresholds.

    Returns:
        Rows [n, 2] that merge and the n Gaussians that they become, or None where nothing merges.
    """
    pairs = merge_pairs(gaussians, candidates, config)
    couples = pairs[matching(len(gaussians), pairs)]
    if not len(couples):
        return None
    return couples, merge(gaussians.select(couples[:, 0]), gaussians.select(couples[:, 1]))


def merge_pairs(gaussians: Gaussians, candidates: Tensor, config: MergeConfig) -> Tensor:
    """As `merging.merge_pairs`, [n, 2] int64."""
    rows = torch.nonzero(candidates).squeeze(1)
    if len(rows) < 2:
        return rows.new_zeros((0, 2))
    chosen = gaussians.select(rows)
    near = nearest(chosen.means, min(config.neighbours + 1, len(rows)))
    i = torch.arange(len(rows), device=rows.device)[:, None].expand_as(near)
    keys = torch.minimum(i, near) * len(rows) + torch.maximum(i, near)
    keys = torch.unique(keys[i != near])
    pairs = torch.stack([keys // len(rows), keys % len(rows)], 1)
    colours = chosen.sh0.double() * SH_C0 + 0.5
    alike = torch.linalg.vector_norm(colours[pairs[:, 0]] - colours[pairs[:, 1]], dim=1) < config.colour
    pairs = pairs[alike]
    ratio = torch.cat([overlap(chosen, part, config.form) for part in pairs.split(_PAIRS)])
    kept = ratio > config.overlap
    pairs, ratio = pairs[kept], ratio[kept]
    # stable: ties stay in the order of rows
    return rows[pairs[ratio.argsort(descending=True, stable=True)]]


def covariances(gaussians: Gaussians) -> Tensor:
    """[N, 3, 3] float64."""
    half = rotation_matrices(gaussians.quats.double()) * gaussians.log_scales.double().exp()[:, None, :]
    return half @ half.mT


def overlap(gaussians: Gaussians, pairs: Tensor, form: str) -> Tensor:
    """As `merging.overlap` of rows [n, 2], [n] float64."""
    a, b = (gaussians.select(pairs[:, side]) for side in range(2))
    total = covariances(a) + covariances(b)
    # unit variance on the diagonal first: a scene in millimetres must not underflow
    scale = total.diagonal(dim1=1, dim2=2).clamp(min=1e-300).sqrt()
    normed = total / scale[:, :, None] / scale[:, None, :]
    d = (a.means.double() - b.means.double()) / scale
    # L D L^T with pivots that are floored: the sum of two parallel needles is singular in float64
    pivots = [torch.ones_like(d[:, 0])]
    l10, l20 = normed[:, 1, 0], normed[:, 2, 0]
    pivots.append((1.0 - l10 * l10).clamp(min=EIGEN_FLOOR))
    l21 = (normed[:, 2, 1] - l20 * l10) / pivots[1]
    pivots.append((1.0 - l20 * l20 - l21 * l21 * pivots[1]).clamp(min=EIGEN_FLOOR))
    y0 = d[:, 0]
    y1 = d[:, 1] - l10 * y0
    y2 = d[:, 2] - l20 * y0 - l21 * y1
    squared = y0 * y0 + y1 * y1 / pivots[1] + y2 * y2 / pivots[2]
    log_total = pivots[1].log() + pivots[2].log() + 2 * scale.log().sum(1)
    if form == "normalised":
        # |2 S| to the quarter of either; a determinant is the product of squared scales
        logs = 0.5 * (a.log_scales.double().sum(1) + b.log_scales.double().sum(1)) + 1.5 * math.log(2.0)
        return (-0.5 * squared + logs - 0.5 * log_total).clamp(max=0.0).exp()
    return (-0.5 * squared - 0.5 * (3 * math.log(2 * math.pi) + log_total)).clamp(max=700.0).exp()


def matching(count: int, pairs: Tensor) -> Tensor:
    """[n] bool: the pairs that are taken if each is tried in turn and a row is taken once.

    A pair that is the first of both its rows is taken whatever comes later; so all of these are taken at
    once, and the rows that are left are asked again.

    Args:
        count: rows.
        pairs: [n, 2] in the order they are tried.
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


def merge(a: Gaussians, b: Gaussians) -> Gaussians:
    """As `merging.merge_members` of couples: rows of `a` with the same rows of `b`."""
    alpha = torch.stack([torch.sigmoid(g.opacity_logits.double()) for g in (a, b)])  # [2, n]
    weight = alpha.clamp(min=1e-12)
    weight = weight / weight.sum(0)

    def mixed(x: Tensor, y: Tensor) -> Tensor:
        shape = (-1, *[1] * (x.dim() - 1))
        return weight[0].view(shape) * x.double() + weight[1].view(shape) * y.double()

    center = mixed(a.means, b.means)
    seconds = []
    for g in (a, b):
        away = g.means.double() - center
        seconds.append(covariances(g) + away[:, :, None] * away[:, None, :])
    log_scales, quats = scale_rotation(mixed(*seconds))
    mean_alpha = alpha.mean(0).clamp(1e-7, 1 - 1e-7)
    return Gaussians(
        means=center.float(),
        quats=quats.float(),
        log_scales=log_scales.float(),
        opacity_logits=(mean_alpha.log() - (-mean_alpha).log1p()).float(),
        sh0=mixed(a.sh0, b.sh0).float(),
        sh_rest=mixed(a.sh_rest, b.sh_rest).float(),
        extra={name: mixed(values, b.extra[name]).float() for name, values in a.extra.items()},
    )


def scale_rotation(cov: Tensor) -> tuple[Tensor, Tensor]:
    """log_scales [n, 3] and quats [n, 4] (w, x, y, z) of covariances [n, 3, 3], rotation right-handed."""
    values, vectors = torch.linalg.eigh(cov)
    values = torch.maximum(values, values[:, 2:].clamp(min=1e-300) * EIGEN_FLOOR)
    flip = torch.where(torch.linalg.det(vectors) < 0, -1.0, 1.0).to(vectors)
    vectors = torch.cat([vectors[:, :, :1] * flip[:, None, None], vectors[:, :, 1:]], 2)
    return 0.5 * values.log(), _quaternions(vectors)


def _quaternions(r: Tensor) -> Tensor:
    """[n, 4] (w, x, y, z) of rotations [n, 3, 3], by the largest of the four components (Shepperd)."""
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
