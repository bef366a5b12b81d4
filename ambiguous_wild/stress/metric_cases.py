"""Rows 19 to 24: merging, metrics and statistics."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.methods.refinesplat.merging import (
    MergeConfig,
    clusters,
    covariances,
    merge_members,
    merge_pairs,
    overlap,
)
from ambiguous_wild.metrics import ambiguity
from ambiguous_wild.metrics.image import psnr, ssim, ssim_inria
from ambiguous_wild.metrics.masks import confusion, psnr_valid
from ambiguous_wild.metrics.stats import bootstrap_interval, mean
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.stress.case import UNIT, Measured, case, failed_checks
from ambiguous_wild.stress.float64_check import cloud


def _line(positions: list[float]) -> Gaussians:
    """Equal unit Gaussians on the x axis."""
    n = len(positions)
    means = torch.zeros(n, 3)
    means[:, 0] = torch.tensor(positions)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(means, quats, torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 3), torch.zeros(n, 0, 3))


def _pairs(g: Gaussians, **config: float) -> set[tuple[int, int]]:
    everyone = torch.ones(len(g), dtype=torch.bool)
    return {(a, b) for a, b in merge_pairs(g, everyone, MergeConfig(**config)).tolist()}  # type: ignore[arg-type]


@case(19, "identical Gaussians, a chain, a thousand, far apart, orthogonal needles")
def merging(device: str) -> Measured:
    chain = _line([0.0, 2.0, 4.0])
    pairs = merge_pairs(chain, torch.ones(3).bool(), MergeConfig())
    thousand = _line([0.0] * 1000)
    cluster = clusters(1000, merge_pairs(thousand, torch.ones(1000).bool(), MergeConfig(neighbours=999)))
    merged = merge_members(thousand, cluster)
    needles = _line([0.0, 0.0])
    needles.log_scales[:] = torch.log(torch.tensor([[1e3, 1e-4, 1e-4], [1e-4, 1e3, 1e-4]]))
    crossed = covariances(merge_members(needles, torch.zeros(2).long()))[0]
    coloured = _line([0.0, 0.1])
    coloured.sh0[1] = 0.2 / SH_C0
    checks = {
        "identical overlap fully": abs(_own_overlap(cloud(30)) - 1) < 1e-9,
        "the chain's ends do not overlap": _pairs(chain) == {(0, 1), (1, 2)},
        "union-find joins them": len(np.unique(clusters(3, pairs))) == 1,
        "a limit does not": len(np.unique(clusters(3, pairs, most=2))) == 2,
        "a thousand are one": len(merged) == 1 and np.allclose(covariances(merged), np.eye(3), atol=1e-5),
        "far apart stay apart": not _pairs(_line([0.0, 100.0])),
        "other colours stay apart": not _pairs(coloured),
        "needles hardly overlap": not _pairs(needles),
        "merged needles are positive definite": float(np.linalg.eigvalsh(crossed).min()) > 0,
    }
    return failed_checks(checks, "clusters follow the overlap")


def _own_overlap(g: Gaussians) -> float:
    cov = covariances(g)
    return float(overlap(torch.zeros(len(g), 3).double(), cov, cov).min())


@case(20, "moments of the merged Gaussian")
def moments(device: str) -> Measured:
    """Against the moments of the mixture, summed in another order; with needles of aspect 1000."""
    g = cloud(9, 5)
    g.log_scales[::3] = torch.log(torch.tensor([1.0, 1e-3, 1e-3]))
    cluster = np.array([7, 7, 2, 2, 2, 9, 9, 9, 9])
    merged = merge_members(g, torch.from_numpy(cluster))
    cov, alpha = covariances(g).numpy(), torch.sigmoid(g.opacity_logits.double()).numpy()
    means, found, worst = g.means.double().numpy(), covariances(merged).numpy(), 0.0
    for row, name in enumerate((2, 7, 9)):
        rows = cluster == name
        w = alpha[rows] / alpha[rows].sum()
        mu = w @ means[rows]
        second = np.einsum("n,nij->ij", w, cov[rows] + means[rows][:, :, None] * means[rows][:, None, :])
        expected = second - np.outer(mu, mu)
        worst = max(worst, float(np.abs(found[row] - expected).max() / np.abs(expected).max()))
        worst = max(worst, float(np.abs(merged.means[row].double().numpy() - mu).max() / np.abs(mu).max()))
        if np.linalg.eigvalsh(found[row]).min() <= 0:
            worst = math.inf
    # rounding: |log s| u for log-scales, twice that for variances; u for quaternions, used twice in R S R^T
    bound = 2 * float(merged.log_scales.abs().max()) + 16
    return Measured(
        worst, bound * UNIT, "2 abs(log s) + 16 roundings", "positive definite, the mixture's moments"
    )


@case(21, "the scene in units a thousand times larger and smaller")
def units(device: str) -> Measured:
    g = cloud(300, 3, rest=0)
    here, checks = _pairs(g, colour=1.0), {}
    for factor in (1e-3, 1e3):
        other = g.clone()
        other.means *= factor
        other.log_scales += math.log(factor)
        checks[f"times {factor:g}"] = _pairs(other, colour=1.0) == here
    checks["there are clusters"] = len(here) > 20
    return failed_checks(checks, "the same clusters")


def _raises_aw_error(call: Callable[[], object]) -> bool:
    try:
        call()
    except AwError:
        return True
    return False


@case(22, "identical and constant pictures, empty masks, below the SSIM window")
def metrics(device: str) -> Measured:
    rng = np.random.default_rng(0)
    photo, flat = rng.random((16, 17, 3)), np.full((16, 17, 3), 0.7)
    nothing, pixel = np.zeros((16, 17), bool), np.zeros((16, 17), bool)
    pixel[3, 4] = True
    checks = {
        "identical: PSNR inf, in means too": psnr(photo, photo) == math.inf == mean([20.0, math.inf]),
        "identical: SSIM 1": abs(ssim(photo, photo) - 1) < 1e-12,
        "constant: SSIM finite": abs(ssim(flat, flat) - 1) < 1e-12 and 0 < ssim(flat, flat * 0.5) < 1,
        "below the window: named": _raises_aw_error(lambda: ssim(photo[:10], photo[:10])),
        "below the window, padded: finite": abs(ssim_inria(photo[:1, :1], photo[:1, :1]) - 1) < 1e-12,
        "one pixel differs least": math.isfinite(psnr(flat, flat + 1e-12)),
        "all masked: PSNR unknown": math.isnan(psnr_valid(photo, 1 - photo, nothing)),
        "one pixel kept": math.isfinite(psnr_valid(photo, 1 - photo, pixel)),
        "IoU of nothing is unknown": math.isnan(confusion(~nothing, ~nothing).iou),
    }
    return failed_checks(checks, "inf stays inf, unknown stays unknown, the rest is a named error")


@case(23, "ambiguity without, with only, and with unknown backgrounds")
def ambiguous(device: str) -> Measured:
    rng = np.random.default_rng(0)
    photo = rng.random((7, 9, 3)).astype(np.float32)
    everything, nothing = np.ones((7, 9), bool), np.zeros((7, 9), bool)
    none = ambiguity.colour_counts(photo, photo, nothing)
    whole = ambiguity.colour_counts(photo, photo, everything)
    unknown = ambiguity.colour_counts(photo, None, everything)
    hidden = ambiguity.colour_counts(photo, photo, everything, known=nothing)
    checks = {
        "no distractor: no share": none.occlusion == 0 and math.isnan(none.close_share),
        "no distractor: no verdict": ambiguity.verdict(none.close_share, 0.3) is None,
        "all distractor": whole.occlusion == 1 and whole.close_share == 1,
        "background unknown": unknown.unknown == 63 and math.isnan(unknown.close_share),
        "known nowhere": hidden.unknown == 63 and math.isnan(hidden.mean_residual),
    }
    return failed_checks(checks, "the share, or unknown")


@case(24, "bootstrap of one, of equal values, of a missing cell")
def bootstrap(device: str) -> Measured:
    one, equal = bootstrap_interval([3.0]), bootstrap_interval([0.25] * 8)
    gone, endless = bootstrap_interval([1.0, math.nan]), bootstrap_interval([1.0, 2.0, math.inf])
    checks = {
        "one: a mean, no interval": one.mean == 3.0 and math.isnan(one.low),
        "equal: no width": equal.low == equal.mean == equal.high == 0.25,
        "missing stays missing": math.isnan(gone.mean) and math.isnan(gone.low),
        "infinite stays infinite": endless.mean == endless.high == math.inf and endless.low >= 1,
        "none: named": _raises_aw_error(lambda: bootstrap_interval([])),
    }
    return failed_checks(checks, "missing stays missing; no interval of one value")


@case(24, "a mean of values of size 1e12 that differ by 1e-3")
def large_means(device: str) -> Measured:
    values = 1e12 + 1e-3 * np.arange(1000)
    found = bootstrap_interval(values, resamples=100)
    # pairwise sums of n values: log2(n) roundings of float64
    error = abs(found.mean - math.fsum(values) / 1000) / 1e12
    error = error if found.low <= found.mean <= found.high else math.inf
    return Measured(error, 12 * 2.0**-53, "log2(n) + 2 roundings of float64", "the exact mean", 1.0)


CASES = (merging, moments, units, metrics, ambiguous, bootstrap, large_means)
