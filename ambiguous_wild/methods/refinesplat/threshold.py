"""The adaptive entropy threshold T_ent (RefineSplat, Eq. 4) with its learnt weight w2, and entropies (Eq. 3).

The printed objective is argmax_t (1 - w2) Ent(Hbar >= t) + w2 Ent(Hbar < t), Ent(X) = -sum x log x on raw
values. That sum is additive over the two subsets, so for w2 < 1/2 the smallest value wins (all others are
transient) and for w2 > 1/2 the largest (nothing is). The default normalises within each subset (Kapur's
maximum entropy): q_i = x_i / sum x, Ent = -sum q_i log q_i. Both always divide the set in two, so a gate
requires outliers. It is computed in float64. Missing values (NaN) stay, and values that are no candidates
score -inf, so that no count is read on the host.

Entropies of identity logits compare photo and render. They are computed through log-sigmoid and log-softmax,
never through the log of a clipped probability: sigma log sigma is 0 at saturated logits and its gradient is
finite there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.refinesplat.maps import spread_of

Variant = Literal["sigmoid", "softmax"]
Statistic = Literal["structure", "entropy", "surprise", "contrast", "evidence"]
THETA_LIMIT = 8.0  # |theta| beyond this, sigmoid(theta) rounds to 0 or 1 in float32
TEMPERATURE = 0.1  # nats, temperature of the soft threshold by which w2 is learnt
RATE = 1.0  # rate of plain gradient steps on theta, each clipped to 1


def entropy(logits: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """Return H in [0, 1] of logits [..., P].

    sigmoid (printed form, Eq. 3): sum_k -sigma(E_k) log sigma(E_k), over its largest value P / e.
    softmax: -sum_k p_k log p_k over log P; 0 where P = 1.

    Returns:
        H [...], in the dtype of the logits.
    """
    channels = logits.shape[-1]
    if variant == "sigmoid":
        log_p = F.logsigmoid(logits)
        return -_x_log_x(log_p).sum(-1) * (math.e / channels)
    if variant == "softmax":
        if channels == 1:
            return (logits * 0.0).sum(-1)
        log_p = F.log_softmax(logits, dim=-1)
        return -_x_log_x(log_p).sum(-1) / math.log(channels)
    raise unknown("entropy variant", variant, ("sigmoid", "softmax"))


def cross_entropy(render: Tensor, photo: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """Return the cross-entropy in nats of the render's identities under the photo's, H(p_I, p_render).

    It equals the entropy of the photo's own identities where the render shows the same thing, and grows by
    KL(p_I || p_render) where it does not. Shapes as `entropy`; both logits [..., P].
    """
    if variant == "sigmoid":
        p = torch.sigmoid(photo)
        return -(p * F.logsigmoid(render) + (1 - p) * F.logsigmoid(-render)).sum(-1)
    if variant == "softmax":
        return -(torch.softmax(photo, -1) * F.log_softmax(render, -1)).sum(-1)
    raise unknown("entropy variant", variant, ("sigmoid", "softmax"))


def kl_divergence(render: Tensor, photo: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """Return KL(p_I || p_render) in nats: `cross_entropy` without the photo's own ambiguity."""
    return (cross_entropy(render, photo, variant) - cross_entropy(photo, photo, variant)).clamp(min=0.0)


def _x_log_x(log_p: Tensor) -> Tensor:
    # exp underflows to 0 long before log_p is large enough to overflow: the product is 0, not NaN
    log_p = log_p.clamp(min=-1e5)
    return log_p.exp() * log_p


Form = Literal["kapur", "literal", "hard", "statistics"]


@dataclass(frozen=True)
class InstanceStats:
    """The instances that a threshold divides, with the sums that it and the learning of w2 need; float64."""

    order: Tensor  # [n] values in ascending order, NaN (missing) last
    index: Tensor  # [n] int64, instance of each value
    x: Tensor  # [n] `order` with 0 for missing values
    total: Tensor  # 0-d, sum of x
    middle: Tensor  # 0-d, median
    spread: Tensor  # 0-d, robust deviation
    upper: Tensor  # [n] entropy of the upper set, for a cut below each value
    more_below: Tensor  # [n] entropy of the lower set minus that of the upper set
    above_previous: Tensor  # [n] bool, whether a value is larger than the one before: a cut may lie between
    logs: Tensor  # [2, n] sums of x log x over the lower and the upper set, for a cut below each value

    def floor(self, gate: float) -> Tensor:
        """Return median + gate * robust spread, 0-d; NaN if all are missing."""
        return self.middle + gate * self.spread


@dataclass(frozen=True)
class Threshold:
    """The threshold between static and transient values."""

    threshold: Tensor  # 0-d float64, larger values are transient; inf = no value is an outlier
    floor: Tensor  # 0-d, bound of the gate: the larger of median + gate * robust spread and `least`

    def capped(self, ceiling: Tensor | None) -> Threshold:
        """Return the cut with threshold and floor limited to the ceiling."""
        if ceiling is None:
            return self
        high = self.threshold > ceiling
        floor = torch.where(high, torch.minimum(self.floor, ceiling), self.floor)
        return Threshold(torch.minimum(self.threshold, ceiling), floor)


def instance_stats(values: Tensor) -> InstanceStats:
    """Sort values [n] >= 0 float64 and compute their statistics; NaN = missing; n >= 1."""
    order, index = values.sort()
    x = order.nan_to_num(nan=0.0).clamp_(min=0.0)
    sums = torch.stack([x, torch.xlogy(x, x)])
    through = sums.cumsum(1)
    lower = through - sums  # sums of all values before each
    totals, logs = torch.stack([lower, through[:, -1:] - lower], 1)  # [2, n] each
    # -sum q log q with q = x / total: log(total) - sum(x log x) / total; 0 of nothing
    lower, upper = (totals.log() - logs / totals).masked_fill_(totals <= 0, 0.0)
    above_previous = F.pad(order[1:] > order[:-1], (1, 0))
    return InstanceStats(
        order, index, x, through[0, -1], *spread_of(values), upper, lower - upper, above_previous, logs
    )  # fmt: skip


def t_ent(
    pool: InstanceStats,
    w2: float | Tensor = 0.5,
    form: Form = "kapur",
    gate: float = 0.0,
    least: float = 0.0,
    hard: float = 0.0,
) -> Threshold:
    """Compute the threshold T_ent, or one of the two that it is compared with.

    Args:
        pool: pool of the mean statistic of each instance.
        w2: weight of the lower subset, in (0, 1).
        form: `kapur` or `literal` (the printed objective) for T_ent; `hard` for T_hard, a fixed value;
            `statistics` for T_statistics, mean + standard deviation (DroneSplat's).
        gate: only values this many robust deviations above the median may be flagged; 0 = no gate.
        least: only values above this may be flagged; 0 = no such bound.
        hard: value of T_hard.

    Returns:
        The cut; with T_ent and T_statistics, one value or equal values flag nothing.
    """
    if form not in get_args(Form):
        raise unknown("threshold", form, get_args(Form))
    if form == "hard":
        fixed = torch.full_like(pool.middle, hard)  # does not depend on the values
        return Threshold(fixed, fixed)
    floor = pool.floor(gate) if gate > 0 else torch.full_like(pool.middle, -math.inf)
    if least > 0:
        floor = floor.clamp(min=least)
    last = pool.order.nan_to_num(nan=-math.inf).amax()
    apart = last - pool.order[0] > 1e-9 * last.abs().clamp(min=1e-300)
    if form == "statistics":
        present = ~pool.order.isnan()
        count = present.sum()
        mean = pool.total / count
        away = (pool.x - mean) * present
        statistics = torch.maximum(mean + (torch.dot(away, away) / count).sqrt(), floor)
        return Threshold(torch.where(apart, statistics, math.inf), floor)
    candidate = candidates(pool, floor, form)
    scores, _ = objective(pool, w2, form)
    start = scores.masked_fill_(~candidate, -math.inf).argmax()
    # printed: the subset is H >= t, but the mask is H > T, so the value that gives T is itself kept
    threshold = pool.order.take(start)
    if form != "literal":
        threshold = 0.5 * (threshold + pool.order.take((start - 1).clamp(min=0)))
    return Threshold(torch.where(candidate.any() & apart, threshold, math.inf), floor)


def candidates(pool: InstanceStats, floor: Tensor, form: Form) -> Tensor:
    """Return the values below which a cut may lie, [n] bool; the printed form may cut below the smallest."""
    candidate = pool.above_previous & (pool.order > floor)
    if form == "literal":
        candidate[:1] = pool.order[:1] > floor
    return candidate


def objective(pool: InstanceStats, w2: float | Tensor, form: Form = "kapur") -> tuple[Tensor, Tensor]:
    """Return (1 - w2) Ent(upper) + w2 Ent(lower) for a cut below each value, and its slope in w2, [n]."""
    upper, slope = pool.upper, pool.more_below
    if form == "literal":
        upper, slope = -pool.logs[1], pool.logs[1] - pool.logs[0]
    return upper + w2 * slope, slope


def updated_theta(
    theta: Tensor,
    pool: InstanceStats,
    costs: Tensor,
    areas: Tensor,
    floor: Tensor,
    form: Form = "kapur",
) -> Tensor:
    """Return theta after one gradient step on one photo, 0-d float64; w2 = sigmoid(theta).

    The paper does not say how w2 is learnt: an argmax has no gradient. Here T is soft: with
    p = softmax(objective / temperature), T = sum p x and dT/dw2 = sum p (x - T) slope / temperature. Soft
    memberships m = sigmoid((x - T) / spread) weight each instance: kept ones pay their residual, masked ones
    a price of 1 per pixel, so that masking everything is no solution. The gradient is written out.

    Args:
        theta: value before the step, 0-d.
        pool: the instances.
        costs: [n] >= 0, residuals in units of the price of masking, in the order before sorting.
        areas: [n] px, in the order before sorting; NaN = missing.
        floor: floor of the cut; candidates lie above it.
        form: form of the objective; forms other than `literal` learn through `kapur`.
    """
    w2 = torch.sigmoid(theta)
    candidate = candidates(pool, floor, form)
    scores, slope = objective(pool, w2, form)
    weights = areas.take(pool.index).nan_to_num_(nan=0.0)
    present = weights > 0
    count = present.sum()
    p = torch.softmax(scores.masked_fill_(~candidate, -math.inf) / TEMPERATURE, 0)
    away = pool.x - torch.dot(p, pool.x)  # from the soft threshold T
    dt_dw2 = torch.dot(p * away, slope) / TEMPERATURE
    centred = (pool.x - pool.total / count) * present
    variance = torch.dot(centred, centred) / count
    spread = variance.clamp_(min=1e-18).sqrt_() / 4
    member = torch.sigmoid(away / spread)
    cost = costs.take(pool.index).nan_to_num_(nan=0.0).clamp_(max=10.0)
    # derivative of sum shares ((1 - member) cost + member) by T; shares are weights over their sum
    dl_dt = torch.dot(weights * (cost - 1.0), member * (1.0 - member)) / (spread * weights.sum())
    gradient = dl_dt * dt_dw2 * (w2 * (1.0 - w2))
    step = gradient.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).clamp_(-1.0, 1.0)
    moved = (theta - RATE * step).clamp_(-THETA_LIMIT, THETA_LIMIT)
    return torch.where(candidate.sum() >= 2, moved, theta)  # w2 has no influence on fewer candidates
