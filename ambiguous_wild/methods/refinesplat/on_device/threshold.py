"""T_ent and its learnt weight w2: threshold.py with torch, in float64, without reading counts on the host.

The host path selects candidates and drops NaN; here all values stay, and values that are no candidates score
-inf.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.methods.refinesplat.config import MaskConfig
from ambiguous_wild.methods.refinesplat.on_device.ranks import spread_of
from ambiguous_wild.methods.refinesplat.threshold import TEMPERATURE, THETA_LIMIT, LearntWeight


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
        """`threshold.robust_floor`, 0-d; NaN if all are missing."""
        return self.middle + gate * self.spread


@dataclass(frozen=True)
class Cut:
    """The threshold between static and transient values, as `threshold.Cut`."""

    threshold: Tensor  # 0-d float64, inf = no value is an outlier
    floor: Tensor  # 0-d float64

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


def t_ent(pool: Pool, w2: Tensor, config: MaskConfig) -> Cut:
    """`threshold.t_ent`."""
    if config.threshold == "hard":
        fixed = torch.full_like(pool.middle, config.hard)
        return Cut(fixed, fixed)
    floor = pool.floor(config.gate) if config.gate > 0 else torch.full_like(pool.middle, -math.inf)
    if config.floor > 0:
        floor = floor.clamp(min=config.floor)
    if config.threshold == "statistics":
        there = ~pool.order.isnan()
        count = there.sum()
        mean = pool.total / count
        away = (pool.x - mean) * there
        statistics = mean + (torch.dot(away, away) / count).sqrt()
        return Cut(torch.where(_apart(pool), torch.maximum(statistics, floor), math.inf), floor)
    if config.threshold == "literal":
        return _literal(pool, w2, floor)
    candidate, scores = _candidates(pool, w2, floor)
    start = scores.argmax().clamp(min=1)
    between = 0.5 * (pool.order.take(start) + pool.order.take(start - 1))
    apart = candidate.any()
    if config.gate <= 0:  # with a gate, its bound is above values that are all equal
        apart = apart & _apart(pool)
    return Cut(torch.where(apart, between, math.inf), floor)


def _apart(pool: Pool) -> Tensor:
    """0-d bool: there are two values that differ."""
    last = pool.order.nan_to_num(nan=-math.inf).amax()
    return last - pool.order[0] > 1e-9 * last.abs().clamp(min=1e-300)


def _literal(pool: Pool, w2: Tensor, floor: Tensor) -> Cut:
    """The printed objective, on raw sums; the value that gives the threshold is itself kept."""
    candidate, scores, _ = _printed(pool, w2, floor)
    threshold = pool.order.take(scores.argmax())
    return Cut(torch.where(candidate.any() & _apart(pool), threshold, math.inf), floor)


def _candidates(pool: Pool, w2: Tensor, floor: Tensor) -> tuple[Tensor, Tensor]:
    """The values below which a cut may lie, [n] bool, and the objective there, else -inf."""
    candidate = pool.above_previous & (pool.order > floor)
    return candidate, torch.addcmul(pool.upper, pool.more_below, w2).masked_fill_(~candidate, -math.inf)


def _printed(pool: Pool, w2: Tensor, floor: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The same of the printed objective, which may cut below the smallest value; and its slope in w2, [n]."""
    candidate = pool.above_previous.clone()
    candidate[0] = True
    candidate &= pool.order > floor
    lower, upper = pool.logs
    slope = upper - lower
    return candidate, (slope * w2 - upper).masked_fill(~candidate, -math.inf), slope


def learnt(theta: Tensor, pool: Pool, areas: Tensor, floor: Tensor, config: MaskConfig) -> Tensor:
    """theta after one step of `threshold.LearntWeight.learn`, 0-d float64.

    The gradient is written out: with p = softmax(scores / tau), dT/dw2 = sum p (x - T) slope / tau.

    Args:
        theta: before.
        pool: the instances.
        areas: [n] px, in the order before sorting; NaN = missing.
        floor: of the cut; candidates lie above it.
        config: `disagree` decides the price of a masked pixel.
    """
    w2 = torch.sigmoid(theta)
    if config.threshold == "literal":
        candidate, scores, slope = _printed(pool, w2, floor)
    else:
        candidate, scores = _candidates(pool, w2, floor)
        slope = pool.more_below
    weights = areas.take(pool.index).nan_to_num_(nan=0.0)
    there = weights > 0
    count = there.sum()
    p = torch.softmax(scores / TEMPERATURE, 0)
    away = pool.x - torch.dot(p, pool.x)  # from the soft threshold T
    dt_dw2 = torch.dot(p * away, slope) / TEMPERATURE
    centred = (pool.x - pool.total / count) * there
    variance = torch.dot(centred, centred) / count
    spread = variance.clamp_(min=1e-18).sqrt_() / 4
    member = torch.sigmoid(away / spread)
    price = pool.floor(max(config.disagree, 1.0)).clamp_(min=1e-12)
    cost = (pool.x / price).clamp_(max=10.0)
    # of sum shares ((1 - member) cost + member), to T; shares are weights over their sum
    dl_dt = torch.dot(weights * (cost - 1.0), member * (1.0 - member)) / (spread * weights.sum())
    gradient = dl_dt * dt_dw2 * (w2 * (1.0 - w2))
    step = gradient.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0).clamp_(-1.0, 1.0)
    moved = (theta - LearntWeight.rate * 50 * step).clamp_(-THETA_LIMIT, THETA_LIMIT)
    return torch.where(candidate.sum() >= 2, moved, theta)  # with fewer, w2 has no influence
