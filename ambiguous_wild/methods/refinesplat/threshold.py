"""The adaptive entropy threshold T_ent (RefineSplat, Eq. 4) and its learnt weight w2, in float64.

Printed: argmax_t (1 - w2) Ent(Hbar >= t) + w2 Ent(Hbar < t), Ent(X) = -sum x log x on raw values. That sum is
additive over the two subsets, so for w2 < 1/2 the smallest value wins (all others are transient) and for
w2 > 1/2 the largest (nothing is). The default normalises within each subset (Kapur's maximum entropy):
q_i = x_i / sum x, Ent = -sum q_i log q_i. Both always divide the set in two, so a gate requires outliers.

Missing values (NaN) stay, and values that are no candidates score -inf: no count is read on the host.

Entropy of identity logits (RefineSplat, Eq. 3), and how it compares between photo and render.

Everything is computed through log-sigmoid and log-softmax, never through the log of a clipped
probability: sigma log sigma is 0 at saturated logits and its gradient is finite there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.refinesplat.ranks import spread_of

Variant = Literal["sigmoid", "softmax"]
Statistic = Literal["structure", "entropy", "surprise", "contrast", "evidence"]


def entropy(logits: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """H in [0, 1] of logits [..., P].

    sigmoid (printed form, Eq. 3): sum_k -sigma(E_k) log sigma(E_k), over its largest value P / e.
    softmax: -sum_k p_k log p_k over log P; 0 where P = 1.

    Returns:
        H [...], the logits' dtype.
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


def surprise(render: Tensor, photo: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """Cross-entropy in nats of the render's identities under the photo's: H(p_I, p_render) >= H(p_I).

    It equals the entropy of the photo's own identities where the render shows the same thing, and grows by
    KL(p_I || p_render) where it does not. Shapes as `entropy`; both logits [..., P].
    """
    if variant == "sigmoid":
        p = torch.sigmoid(photo)
        return -(p * F.logsigmoid(render) + (1 - p) * F.logsigmoid(-render)).sum(-1)
    if variant == "softmax":
        return -(torch.softmax(photo, -1) * F.log_softmax(render, -1)).sum(-1)
    raise unknown("entropy variant", variant, ("sigmoid", "softmax"))


def contrast(render: Tensor, photo: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """KL(p_I || p_render) in nats: the part of `surprise` that the photo's own ambiguity does not explain."""
    return (surprise(render, photo, variant) - surprise(photo, photo, variant)).clamp(min=0.0)


def _x_log_x(log_p: Tensor) -> Tensor:
    # exp underflows to 0 long before log_p is large enough to overflow: the product is 0, not NaN
    log_p = log_p.clamp(min=-1e5)
    return log_p.exp() * log_p


Form = Literal["kapur", "literal", "hard", "statistics"]
THETA_LIMIT = 8.0  # |theta| beyond this, sigmoid(theta) rounds to 0 or 1 in float32
TEMPERATURE = 0.1  # nats, of the threshold that w2 is learnt through
RATE = 1.0  # of plain gradient steps on theta, each clipped to 1


@dataclass(frozen=True)
class Pool:
    """The instances that a threshold divides, with the sums that it and the learning of w2 need; float64."""

    order: Tensor  # [n] ascending, NaN (missing) last
    index: Tensor  # [n] int64, its instance
    x: Tensor  # [n] the same, 0 where it is missing
    total: Tensor  # 0-d sum of x
    middle: Tensor  # 0-d median
    spread: Tensor  # 0-d robust deviation
    upper: Tensor  # [n] entropy of the upper set of a cut below each value
    more_below: Tensor  # [n] how much greater that of the lower set is
    above_previous: Tensor  # [n] bool: larger than the one before, so a cut may lie between
    logs: Tensor  # [2, n] sum x log x of the lower and the upper set of a cut below each value

    def floor(self, gate: float) -> Tensor:
        """median + gate * robust spread, 0-d; NaN if all are missing."""
        return self.middle + gate * self.spread


@dataclass(frozen=True)
class Cut:
    """The threshold between static and transient values."""

    threshold: Tensor  # 0-d float64, above: transient; inf = no value is an outlier
    floor: Tensor  # 0-d: the gate's own bound, the larger of median + gate * robust spread and `least`

    def below(self, ceiling: Tensor | None) -> Cut:
        """The cut with threshold and floor limited to the ceiling."""
        if ceiling is None:
            return self
        high = self.threshold > ceiling
        floor = torch.where(high, torch.minimum(self.floor, ceiling), self.floor)
        return Cut(torch.minimum(self.threshold, ceiling), floor)


def pool_of(values: Tensor) -> Pool:
    """Sort values [n] >= 0 float64 and compute their statistics; NaN = missing; n >= 1."""
    order, index = values.sort()
    x = order.nan_to_num(nan=0.0).clamp_(min=0.0)
    sums = torch.stack([x, torch.xlogy(x, x)])
    through = sums.cumsum(1)
    lower = through - sums  # of all values before each
    totals, logs = torch.stack([lower, through[:, -1:] - lower], 1)  # [2, n] each
    # -sum q log q with q = x / total: log(total) - sum(x log x) / total; 0 of nothing
    lower, upper = (totals.log() - logs / totals).masked_fill_(totals <= 0, 0.0)
    above_previous = F.pad(order[1:] > order[:-1], (1, 0))
    return Pool(
        order, index, x, through[0, -1], *spread_of(values), upper, lower - upper, above_previous, logs
    )  # fmt: skip


def t_ent(
    pool: Pool,
    w2: float | Tensor = 0.5,
    form: Form = "kapur",
    gate: float = 0.0,
    least: float = 0.0,
    hard: float = 0.0,
) -> Cut:
    """The threshold T_ent, or one of the two it is compared with.

    Args:
        pool: of the mean statistic of each instance.
        w2: weight of the lower subset, in (0, 1).
        form: `kapur` or `literal` (the printed objective) for T_ent; `hard` for T_hard, a fixed value;
            `statistics` for T_statistics, mean + standard deviation (DroneSplat's).
        gate: only values this many robust deviations above the median may be flagged; 0 = no gate.
        least: and only values above this; 0 = no such bound.
        hard: the value of T_hard.

    Returns:
        The cut; with T_ent and T_statistics, one value or equal values flag nothing.
    """
    if form not in get_args(Form):
        raise unknown("threshold", form, get_args(Form))
    if form == "hard":
        fixed = torch.full_like(pool.middle, hard)  # whatever the values are
        return Cut(fixed, fixed)
    floor = pool.floor(gate) if gate > 0 else torch.full_like(pool.middle, -math.inf)
    if least > 0:
        floor = floor.clamp(min=least)
    last = pool.order.nan_to_num(nan=-math.inf).amax()
    apart = last - pool.order[0] > 1e-9 * last.abs().clamp(min=1e-300)
    if form == "statistics":
        there = ~pool.order.isnan()
        count = there.sum()
        mean = pool.total / count
        away = (pool.x - mean) * there
        statistics = torch.maximum(mean + (torch.dot(away, away) / count).sqrt(), floor)
        return Cut(torch.where(apart, statistics, math.inf), floor)
    candidate = candidates(pool, floor, form)
    scores, _ = objective(pool, w2, form)
    start = scores.masked_fill_(~candidate, -math.inf).argmax()
    # printed: the subset is H >= t, but the mask is H > T, so the value that gives T is itself kept
    threshold = pool.order.take(start)
    if form != "literal":
        threshold = 0.5 * (threshold + pool.order.take((start - 1).clamp(min=0)))
    return Cut(torch.where(candidate.any() & apart, threshold, math.inf), floor)


def candidates(pool: Pool, floor: Tensor, form: Form) -> Tensor:
    """The values below which a cut may lie, [n] bool; the printed form may cut below the smallest."""
    candidate = pool.above_previous & (pool.order > floor)
    if form == "literal":
        candidate[:1] = pool.order[:1] > floor
    return candidate


def objective(pool: Pool, w2: float | Tensor, form: Form = "kapur") -> tuple[Tensor, Tensor]:
    """(1 - w2) Ent(upper) + w2 Ent(lower) of a cut below each value, and its slope in w2, [n] each."""
    upper, slope = pool.upper, pool.more_below
    if form == "literal":
        upper, slope = -pool.logs[1], pool.logs[1] - pool.logs[0]
    return upper + w2 * slope, slope


def learnt(
    theta: Tensor,
    pool: Pool,
    costs: Tensor,
    areas: Tensor,
    floor: Tensor,
    form: Form = "kapur",
) -> Tensor:
    """theta after one gradient step on one photo, 0-d float64; w2 = sigmoid(theta).

    The paper does not say how w2 is learnt: an argmax has no gradient. Here T is soft: with
    p = softmax(objective / temperature), T = sum p x and dT/dw2 = sum p (x - T) slope / temperature. Soft
    memberships m = sigmoid((x - T) / spread) weight each instance: kept ones pay their residual, masked ones
    a price of 1 per pixel, so that masking everything is no solution. The gradient is written out.

    Args:
        theta: before, 0-d.
        pool: the instances.
        costs: [n] >= 0, residuals in units of the price of masking; in the order before sorting.
        areas: [n] px, likewise; NaN = missing.
        floor: of the cut; candidates lie above it.
        form: of the objective that T is soft in; other forms than `literal` learn through `kapur`.
    """
    w2 = torch.sigmoid(theta)
    candidate = candidates(pool, floor, form)
    scores, slope = objective(pool, w2, form)
    weights = areas.take(pool.index).nan_to_num_(nan=0.0)
    there = weights > 0
    count = there.sum()
    p = torch.softmax(scores.masked_fill_(~candidate, -math.inf) / TEMPERATURE, 0)
    away = pool.x - torch.dot(p, pool.x)  # from the soft threshold T
    dt_dw2 = torch.dot(p * away, slope) / TEMPERATURE
    centred = (pool.x - pool.total / count) * there
    variance = torch.dot(centred, centred) / count
    spread = variance.clamp_(min=1e-18).sqrt_() / 4
    member = torch.sigmoid(away / spread)
    cost = costs.take(pool.index).nan_to_num_(nan=0.0).clamp_(max=10.0)
    # of sum shares ((1 - member) cost + member), to T; shares are weights over their sum
    dl_dt = torch.dot(weights * (cost - 1.0), member * (1.0 - member)) / (spread * weights.sum())
    gradient = dl_dt * dt_dw2 * (w2 * (1.0 - w2))
    step = gradient.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).clamp_(-1.0, 1.0)
    moved = (theta - RATE * step).clamp_(-THETA_LIMIT, THETA_LIMIT)
    return torch.where(candidate.sum() >= 2, moved, theta)  # with fewer, w2 has no influence
