"""The adaptive entropy threshold T_ent (RefineSplat, Eq. 4) and its learnt weight w2.

Printed: argmax_t (1 - w2) Ent(Hbar >= t) + w2 Ent(Hbar < t), Ent(X) = -sum x log x on raw values. That sum is
additive over the two subsets, so for w2 < 1/2 the smallest value wins (all others are transient) and for
w2 > 1/2 the largest (nothing is). The default normalises within each subset (Kapur's maximum entropy):
q_i = x_i / sum x, Ent = -sum q_i log q_i. Both always divide the set in two, so a gate requires outliers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.errors import unknown

Form = Literal["kapur", "literal", "hard", "statistics"]
THETA_LIMIT = 8.0  # |theta| beyond this, sigmoid(theta) rounds to 0 or 1 in float32
TEMPERATURE = 0.1  # nats, of the threshold that w2 is learnt through


@dataclass(frozen=True)
class Cut:
    """The threshold between static and transient values of one photo."""

    threshold: float  # above: transient; inf = no value is an outlier
    flagged: np.ndarray  # [K] bool
    floor: float  # the gate's own bound: the larger of median + gate * robust spread and `least`


def t_ent(
    values: np.ndarray,  # [K] >= 0, mean entropy of each instance
    w2: float = 0.5,
    form: Form = "kapur",
    gate: float = 0.0,
    least: float = 0.0,
    hard: float = 0.0,
) -> Cut:
    """The threshold T_ent, or one of the two it is compared with, and the instances above it.

    Args:
        values: Hbar of each instance; without NaN.
        w2: weight of the lower subset, in (0, 1).
        form: `kapur` or `literal` (the printed objective) for T_ent; `hard` for T_hard, a fixed value;
            `statistics` for T_statistics, mean + standard deviation (DroneSplat's).
        gate: only values this many robust deviations above the median may be flagged; 0 = no gate.
        least: and only values above this; 0 = no such bound.
        hard: the value of T_hard.

    Returns:
        The cut; with T_ent and T_statistics, K <= 1 or equal values flag nothing.
    """
    values = np.asarray(values, dtype=np.float64)
    if form not in get_args(Form):
        raise unknown("threshold", form, get_args(Form))
    floor = max(robust_floor(values, gate) if gate > 0 else -math.inf, least if least > 0 else -math.inf)
    nothing = Cut(math.inf, np.zeros(len(values), dtype=bool), floor)
    if form == "hard":
        return Cut(hard, values > hard, hard)  # the fixed value, whatever the values are
    order = np.sort(values)
    if len(order) <= 1 or order[-1] - order[0] <= 1e-9 * max(abs(order[-1]), 1e-300):
        return nothing
    if form == "statistics":
        statistics = max(float(values.mean() + values.std()), floor)
        return Cut(statistics, values > statistics, floor)
    # a candidate is the smallest value of an upper set; each lies above the gate's floor
    starts = np.flatnonzero(np.r_[form == "literal", np.diff(order) > 0])
    starts = starts[order[starts] > floor]
    if not len(starts):
        return nothing
    scores = objective(order, starts, w2, form)
    start = int(starts[int(np.argmax(scores))])
    # printed: the subset is H >= t, but the mask is H > T, so the value that gives T is itself kept
    threshold = order[start] if form == "literal" else 0.5 * (order[start] + order[start - 1])
    return Cut(float(threshold), values > threshold, floor)


def objective(order: np.ndarray, starts: np.ndarray, w2: float, form: Form = "kapur") -> np.ndarray:
    """(1 - w2) Ent(upper) + w2 Ent(lower) for every cut.

    Args:
        order: values [K], ascending, >= 0.
        starts: index of the smallest upper value of each cut.
        w2: weight of the lower subset.
        form: see the module.
    """
    x = np.maximum(order, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        x_log_x = np.where(x > 0, x * np.log(x), 0.0)
    total, total_log = np.cumsum(np.r_[0.0, x]), np.cumsum(np.r_[0.0, x_log_x])
    lower, lower_log = total[starts], total_log[starts]
    upper, upper_log = total[-1] - lower, total_log[-1] - lower_log
    if form == "literal":
        return (1 - w2) * -upper_log + w2 * -lower_log
    return (1 - w2) * _normalised(upper, upper_log) + w2 * _normalised(lower, lower_log)


def _normalised(total: np.ndarray, total_log: np.ndarray) -> np.ndarray:
    """-sum q log q with q = x / total, from sum x and sum x log x: log(total) - total_log / total."""
    safe = np.where(total > 0, total, 1.0)
    return np.where(total > 0, np.log(safe) - total_log / safe, 0.0)


def robust_floor(values: np.ndarray, gate: float) -> float:
    """median + gate * 1.4826 MAD; the spread is at least 5 % of the median, so equal values do not flag."""
    if not len(values):
        return math.inf
    median = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - median)))
    return median + gate * max(spread, 0.05 * abs(median), 1e-12)


def soft_threshold(values: Tensor, starts: Tensor, w2: Tensor, tau: float, form: Form = "kapur") -> Tensor:
    """T = sum_t softmax(objective(t) / tau) t: T_ent with a gradient to w2.

    Args:
        values: [K] ascending.
        starts: [T] index of the smallest upper value of each candidate cut.
        w2: scalar in (0, 1), with a gradient.
        tau: temperature in nats.
        form: of the objective; `literal` is the printed one.
    """
    x = values.clamp(min=0.0)
    x_log_x = torch.where(x > 0, x * x.clamp(min=1e-30).log(), torch.zeros_like(x))
    zero = x.new_zeros(1)
    total, total_log = torch.cat([zero, x.cumsum(0)]), torch.cat([zero, x_log_x.cumsum(0)])
    lower, lower_log = total[starts], total_log[starts]
    upper, upper_log = total[-1] - lower, total_log[-1] - lower_log
    if form == "literal":
        score = (1 - w2) * -upper_log + w2 * -lower_log
    else:
        score = (1 - w2) * _normalised_t(upper, upper_log) + w2 * _normalised_t(lower, lower_log)
    return (torch.softmax(score / tau, 0) * x[starts]).sum()


def _normalised_t(total: Tensor, total_log: Tensor) -> Tensor:
    safe = torch.where(total > 0, total, torch.ones_like(total))
    return torch.where(total > 0, safe.log() - total_log / safe, torch.zeros_like(total))


@dataclass
class LearntWeight:
    """w2 = sigmoid(theta), learnt through the soft threshold.

    The paper does not say how: an argmax has no gradient. Here soft memberships
    m_j = sigmoid((Hbar_j - T) / spread) weight each instance: kept ones pay their residual, masked ones
    a price of 1 per pixel, so that masking everything is no solution.
    """

    theta: float = 0.0
    rate: float = 0.02  # of plain gradient steps on theta, clipped to 1

    @property
    def value(self) -> float:
        return 1.0 / (1.0 + math.exp(-self.theta))

    def learn(
        self,
        values: np.ndarray,
        residuals: np.ndarray,
        areas: np.ndarray,
        floor: float,
        form: Form = "kapur",
    ) -> None:
        """One step on one photo.

        Args:
            values: Hbar [K].
            residuals: [K] >= 0, in units of what is normal for the photo: 1 = the price of masking.
            areas: [K] px.
            floor: the gate's bound; only cuts above it are candidates.
            form: of the objective that T is soft in; other forms than `literal` learn through `kapur`.
        """
        index = np.argsort(values, kind="stable")
        order = values[index]
        starts = np.flatnonzero((order > floor) & np.r_[form == "literal", np.diff(order) > 0])
        if len(starts) < 2:  # w2 has no influence
            return
        theta = torch.tensor(self.theta, dtype=torch.float64, requires_grad=True)
        x = torch.from_numpy(order)
        t = soft_threshold(x, torch.from_numpy(starts), torch.sigmoid(theta), TEMPERATURE, form)
        spread = max(float(np.std(order)), 1e-9) / 4
        member = torch.sigmoid((x - t) / spread)
        share = torch.from_numpy(areas[index] / max(float(areas.sum()), 1.0))
        cost = torch.from_numpy(np.minimum(residuals[index], 10.0))
        loss = (share * ((1 - member) * cost + member)).sum()
        (gradient,) = torch.autograd.grad(loss, theta)
        step = float(gradient.clamp(-1.0, 1.0)) if torch.isfinite(gradient) else 0.0
        # not normalised: sign and size both matter, the clip bounds them
        self.theta = float(np.clip(self.theta - self.rate * 50 * step, -THETA_LIMIT, THETA_LIMIT))
