"""Mask cases: entropy, thresholds, masks, regulariser, printed formulas, merging, metrics, statistics."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from ambiguous_wild.core import AwError
from ambiguous_wild.methods.refinesplat.evidence import global_mask, ratio, uncertainty
from ambiguous_wild.methods.refinesplat.masks import instance_means
from ambiguous_wild.methods.refinesplat.merging import (
    MergeConfig,
    clusters,
    covariances,
    merge_members,
    merge_pairs,
    overlap,
)
from ambiguous_wild.methods.refinesplat.recipe import consistency_loss
from ambiguous_wild.methods.refinesplat.threshold import (
    Variant,
    entropy,
    instance_stats,
    objective,
    t_ent,
    updated_theta,
)
from ambiguous_wild.metrics import ambiguity
from ambiguous_wild.metrics.image import psnr, ssim, ssim_inria
from ambiguous_wild.metrics.mask_scores import confusion, psnr_valid
from ambiguous_wild.metrics.stats import mean, mean_interval
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.stress.case import UNIT, CaseResult, case, cloud, failed_checks, worst


def _logits(n: int, channels: int, scale: float, seed: int = 0) -> torch.Tensor:
    return scale * torch.randn(n, channels, generator=torch.Generator().manual_seed(seed))


def _flagged(values: np.ndarray, *settings: Any, **more: Any) -> np.ndarray:
    """Return which instances are above T_ent, [K] bool."""
    return values > float(t_ent(instance_stats(torch.from_numpy(values)), *settings, **more).threshold)


@case(11, "entropy at logits of 1e4 either way, for 1, 2 and 255 identities")
def entropy_saturated(device: str) -> CaseResult:
    parts = []
    variants: tuple[Variant, ...] = ("sigmoid", "softmax")
    for variant in variants:
        for channels in (1, 2, 255):
            extremes = torch.full((2, channels), 1e4) * torch.tensor([[1.0], [-1.0]])
            logits = torch.cat([_logits(40, channels, 8.0), extremes]).requires_grad_(True)
            value = entropy(logits, variant)
            (gradient,) = torch.autograd.grad(value.sum(), logits)
            exact = entropy(logits.detach().double(), variant)
            error = float((value.detach() - exact).abs().max() / exact.abs().max().clamp(min=1e-30))
            sound = bool(torch.isfinite(gradient).all()) and float(value.detach().min()) >= 0
            # x e^x changes by (1 + |x|) u if x = log p changes by u, and |x| e^x <= 1 / e
            tolerance = (8 + channels) * UNIT
            parts.append(CaseResult(error if sound else math.inf, tolerance, "8 + P roundings", ""))
    m = worst(parts)
    return CaseResult(m.error, m.tolerance, m.why, "0 where saturated, gradient finite", 1.0)


@case(12, "0, 1 and 2 instances, equal values, gaps and negative labels")
def few_instances(device: str) -> CaseResult:
    none = torch.zeros(8, 8, dtype=torch.int32)
    labels = torch.tensor([[-2, 1, 1, 0], [3, 3, -1, 1], [0, 3, 3, 3], [1, 1, 1, 1]])  # no label 2
    grid = torch.arange(16.0).reshape(4, 4).double()
    means, areas = instance_means(grid, labels, 3)
    two = np.array([0.1, 0.9])
    checks = {
        "none": not _flagged(np.array([np.nan])).any() and instance_means(grid, none, 0)[0].numel() == 0,
        "one": not _flagged(np.array([0.4]), gate=3.0).any(),
        "two": _flagged(two).tolist() == [False, True],
        "equal": not _flagged(np.full(50, 0.2), gate=3.0).any(),
        "means": torch.isclose(means[0], grid[labels == 1].mean())
        and torch.isclose(means[2], grid[labels == 3].mean()),
        "a label without pixels": bool(means[1].isnan() and areas[1] == 0),
        "one over the photo": instance_means(torch.full((2, 2), 0.25), none + 1, 1)[0][0] == 0.25,
        "negative labels": not instance_means(grid, none - 1, 1)[1].any(),
    }
    return failed_checks(checks, "no mask without outliers")


@case(13, "1 of 50 far away, 49 of 50, heavy tails")
def skewed(device: str) -> CaseResult:
    rng = np.random.default_rng(0)
    checks = {}
    for high in (1, 3, 20):
        low, far = rng.normal(0.1, 0.01, 50 - high), rng.normal(0.8, 0.03, high)
        threshold = float(t_ent(instance_stats(torch.from_numpy(np.r_[low, far])), gate=5.0).threshold)
        checks[f"{high} of 50 apart"] = bool(low.max() < threshold < far.min())
    many = np.r_[0.05, rng.normal(0.8, 0.01, 49)]
    checks["49 of 50: the majority is the scene"] = bool(_flagged(many, gate=5.0).mean() < 0.1)
    tail = rng.pareto(1.5, 400) + 0.1
    flagged = _flagged(tail, gate=3.0)
    checks["heavy tail"] = bool(0 < flagged.mean() < 0.3 and tail[flagged].min() > np.quantile(tail, 0.7))
    return failed_checks(checks, "the threshold lies between the groups")


@case(14, "a photo without distractors")
def nothing_to_mask(device: str) -> CaseResult:
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(10):
        h, cosine = rng.uniform(0.4, 0.6, (34, 60)), rng.uniform(0.9, 1.0, (34, 60))
        r = ratio(uncertainty(torch.from_numpy(cosine)), torch.from_numpy(h))
        mask = global_mask(r, spread="std", gate=6.0)
        local = _flagged(rng.normal(0.3, 0.03, 40), gate=5.0)
        shares += [float(mask.double().mean()), float(local.mean())]
    return CaseResult(max(shares), 0.02, "share of masked pixels and instances, from the list", "below 2 %")


@case(15, "H of 0 over half the photo, cosines of -1, 1 and none")
def planted_region(device: str) -> CaseResult:
    rng = np.random.default_rng(0)
    h, cosine = rng.uniform(0.3, 0.6, (34, 60)), rng.uniform(0.85, 1.0, (34, 60))
    h[:, :30] = 0.0
    cosine[10:16, 8:16], cosine[0, 0], cosine[1, 1] = -1.0, np.nan, 1.0
    ratios = ratio(uncertainty(torch.from_numpy(cosine)), torch.from_numpy(h))
    r, mask = ratios.numpy(), global_mask(ratios, spread="std", gate=6.0).numpy()
    extremes = torch.tensor([-1.0, 1.0, math.nan, math.inf])
    grown = np.zeros_like(mask)
    grown[9:17, 7:17] = True
    checks = {
        "finite": bool(np.isfinite(r).all()),
        "H of 0 counts at most a hundred times": bool(r[20:, :30].max() < 100 * r[20:, 30:].max()),
        "the region is found": bool(mask[11:15, 9:15].all()),
        "nothing else is": not bool((mask & ~grown).any()),
        "U is at least 1": bool((uncertainty(extremes) >= 1).all()),
    }
    return failed_checks(checks, "U / H finite, the planted region found")


@case(16, "printed formulas where they degenerate")
def literal(device: str) -> CaseResult:
    values = np.r_[np.full(20, 0.05), 0.25, 0.3] + np.arange(22) * 1e-4
    scores = objective(instance_stats(torch.from_numpy(values)), 0.5, "literal")[0].numpy()
    unit, zero = torch.eye(3, dtype=torch.float64)[None], torch.zeros(1, 3, dtype=torch.float64)
    away = np.array([[-2.0, 0, 0], [2.0, 0, 0]])
    printed = (np.eye(3) + away[:, :, None] * -away[:, None, :]).mean(0)
    rng = np.random.default_rng(0)
    h, cosine = rng.uniform(0.3, 0.6, (34, 60)), rng.uniform(0.85, 1.0, (34, 60))
    h[:, :30], cosine[10:16, 8:16] = 0.0, -0.99
    raw = uncertainty(torch.from_numpy(cosine)) / torch.from_numpy(h + 1e-6)
    checks = {
        "Ent: w2 below 1/2 flags all but one": _flagged(values, 0.4, "literal").sum() == 21,
        "Ent: w2 above 1/2 flags nothing": _flagged(values, 0.6, "literal").sum() == 0,
        "Ent: w2 of 1/2 decides nothing": bool(np.ptp(scores) < 1e-12),
        "overlap: depends on the unit": bool(
            overlap(zero, unit, unit, "literal")[0]
            < 0.3
            < overlap(zero, unit * 1e-6, unit * 1e-6, "literal")[0]
        ),
        "merged covariance: indefinite": bool(np.linalg.eigvalsh(printed).min() < 0),
        "global mask: the variance swallows it": not bool(global_mask(raw, spread="var").any()),
    }
    return failed_checks(checks, "each fails as described in docs/fidelity.md")


def _double_loop(logits: torch.Tensor) -> float:
    """Return the mean of KL over all pairs in float64, as the paper prints it."""
    log_s, log_r = F.logsigmoid(logits), F.logsigmoid(-logits)
    one = (log_s.exp()[:, None] * (log_s[:, None] - log_s[None])).sum(2)
    two = (log_r.exp()[:, None] * (log_r[:, None] - log_r[None])).sum(2)
    return float((one + two).mean())


@case(17, "consistency in closed form against the double loop, 1, 2 and 500 cells")
def consistency(device: str) -> CaseResult:
    parts = []
    for n in (1, 2, 500):
        logits = _logits(n, 6, 3.0, n)
        exact = _double_loop(logits.double())
        loss = float(consistency_loss(logits.double(), torch.ones(1, n, dtype=torch.float64)))
        parts.append(CaseResult(abs(loss - exact) / max(exact, 1e-3), 1e-6, "the list's own", ""))
        # float32: sums of terms of size |s log s| cancel down to the loss
        size = float((torch.sigmoid(logits) * F.logsigmoid(logits)).abs().sum(1).mean()) * 2
        condition = max(size / max(exact, 1e-3), 1.0)
        loss = float(consistency_loss(logits, torch.ones(1, n)))
        parts.append(
            CaseResult(
                abs(loss - exact) / max(exact, 1e-3),
                32 * condition * UNIT,
                "32 roundings x condition",
                "",
                condition,
            )
        )
    m = worst(parts)
    return CaseResult(m.error, m.tolerance, m.why, "the double loop's value", m.condition)


@case(17, "consistency of saturated logits")
def consistency_saturated(device: str) -> CaseResult:
    checks = {}
    for variant in ("sigmoid", "softmax"):
        logits = torch.tensor([[1e4, -1e4], [-1e4, 1e4], [1e30, 0.0]], requires_grad=True)
        loss = consistency_loss(logits, torch.ones(1, 3), variant)
        (gradient,) = torch.autograd.grad(loss, logits)
        checks[f"{variant}: loss"] = bool(torch.isfinite(loss))
        checks[f"{variant}: gradient"] = bool(torch.isfinite(gradient).all())
    return failed_checks(checks, "finite, gradient finite")


@case(18, "w2 driven to 0 and to 1")
def learnt_weight(device: str) -> CaseResult:
    checks = {}
    for name, residual in (("down", 1e6), ("up", 0.0)):
        rng, theta = np.random.default_rng(0), torch.zeros((), dtype=torch.float64)
        one = torch.ones(40, dtype=torch.float64)
        for _ in range(300):
            pool = instance_stats(torch.from_numpy(rng.gamma(2.0, 1.0, 40)))
            theta = updated_theta(theta, pool, residual * one, one, torch.tensor(0.5))
        w2, single = float(torch.sigmoid(theta)), float(torch.sigmoid(theta.float()))
        checks[f"{name}: inside (0, 1), in float32 too"] = 0 < w2 < 1 and 0 < single < 1
        checks[f"{name}: moved that way"] = (w2 < 0.5) == (name == "down")
    return failed_checks(checks, "stays inside (0, 1)")


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
def merging(device: str) -> CaseResult:
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
def moments(device: str) -> CaseResult:
    """Against the moments of the mixture, summed in another order; with needles of aspect 1000."""
    g = cloud(9, 5)
    g.log_scales[::3] = torch.log(torch.tensor([1.0, 1e-3, 1e-3]))
    cluster = np.array([7, 7, 2, 2, 2, 9, 9, 9, 9])
    merged = merge_members(g, torch.from_numpy(cluster))
    cov, alpha = covariances(g).numpy(), torch.sigmoid(g.opacity_logits.double()).numpy()
    means, merged_cov, worst = g.means.double().numpy(), covariances(merged).numpy(), 0.0
    for row, name in enumerate((2, 7, 9)):
        rows = cluster == name
        w = alpha[rows] / alpha[rows].sum()
        mu = w @ means[rows]
        second = np.einsum("n,nij->ij", w, cov[rows] + means[rows][:, :, None] * means[rows][:, None, :])
        expected = second - np.outer(mu, mu)
        worst = max(worst, float(np.abs(merged_cov[row] - expected).max() / np.abs(expected).max()))
        worst = max(worst, float(np.abs(merged.means[row].double().numpy() - mu).max() / np.abs(mu).max()))
        if np.linalg.eigvalsh(merged_cov[row]).min() <= 0:
            worst = math.inf
    # rounding: |log s| u for log-scales, twice that for variances; u for quaternions, used twice in R S R^T
    bound = 2 * float(merged.log_scales.abs().max()) + 16
    return CaseResult(
        worst, bound * UNIT, "2 abs(log s) + 16 roundings", "positive definite, the mixture's moments"
    )


@case(21, "the scene in units a thousand times larger and smaller")
def units(device: str) -> CaseResult:
    g = cloud(300, 3, rest=0)
    pairs, checks = _pairs(g, colour=1.0), {}
    for factor in (1e-3, 1e3):
        other = g.clone()
        other.means *= factor
        other.log_scales += math.log(factor)
        checks[f"times {factor:g}"] = _pairs(other, colour=1.0) == pairs
    checks["there are clusters"] = len(pairs) > 20
    return failed_checks(checks, "the same clusters")


def _raises_aw_error(call: Callable[[], object]) -> bool:
    try:
        call()
    except AwError:
        return True
    return False


@case(22, "identical and constant pictures, empty masks, below the SSIM window")
def metrics(device: str) -> CaseResult:
    rng = np.random.default_rng(0)
    photo, flat = rng.random((16, 17, 3)), np.full((16, 17, 3), 0.7)
    nothing, pixel = np.zeros((16, 17), bool), np.zeros((16, 17), bool)
    pixel[3, 4] = True
    checks = {
        "identical: PSNR inf, in no mean": psnr(photo, photo) == math.inf and mean([20.0, math.inf]) == 20.0,
        "identical: SSIM 1": abs(ssim(photo, photo) - 1) < 1e-12,
        "constant: SSIM finite": abs(ssim(flat, flat) - 1) < 1e-12 and 0 < ssim(flat, flat * 0.5) < 1,
        "below the window: named": _raises_aw_error(lambda: ssim(photo[:10], photo[:10])),
        "below the window, padded: finite": abs(ssim_inria(photo[:1, :1], photo[:1, :1]) - 1) < 1e-12,
        "one pixel differs least": math.isfinite(psnr(flat, flat + 1e-12)),
        "all masked: PSNR unknown": math.isnan(psnr_valid(photo, 1 - photo, nothing)),
        "one pixel kept": math.isfinite(psnr_valid(photo, 1 - photo, pixel)),
        "IoU of nothing is unknown": math.isnan(confusion(~nothing, ~nothing).iou),
    }
    return failed_checks(checks, "inf enters no mean, unknown stays unknown, the rest is a named error")


@case(23, "ambiguity without, with only, and with unknown backgrounds")
def ambiguous(device: str) -> CaseResult:
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


@case(24, "interval of one, of equal values, of a missing cell")
def intervals(device: str) -> CaseResult:
    one, equal = mean_interval([3.0]), mean_interval([0.25] * 8)
    gone, endless = mean_interval([1.0, math.nan]), mean_interval([1.0, 2.0, math.inf])
    checks = {
        "one: a mean, no interval": one.mean == 3.0 and math.isnan(one.low),
        "equal: no width": equal.low == equal.mean == equal.high == 0.25,
        "missing stays missing": math.isnan(gone.mean) and math.isnan(gone.low),
        "infinite stays infinite": endless.mean == math.inf and math.isnan(endless.low),
        "none: named": _raises_aw_error(lambda: mean_interval([])),
    }
    return failed_checks(checks, "missing stays missing; no interval of one value")


@case(24, "a mean of values of size 1e12 that differ by 1e-3")
def large_means(device: str) -> CaseResult:
    values = 1e12 + 1e-3 * np.arange(1000)
    interval = mean_interval(values)
    # pairwise sums of n values: log2(n) roundings of float64
    error = abs(interval.mean - math.fsum(values) / 1000) / 1e12
    error = error if interval.low <= interval.mean <= interval.high else math.inf
    return CaseResult(error, 12 * 2.0**-53, "log2(n) + 2 roundings of float64", "the exact mean", 1.0)
