"""Entropy of identity logits (RefineSplat, Eq. 3), and how it compares between photo and render.

Everything is computed through log-sigmoid and log-softmax, never through the log of a clipped
probability: sigma log sigma is 0 at saturated logits and its gradient is finite there.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.errors import unknown

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
