"""L_id and the consistency regulariser L_cr (RefineSplat, Eq. 13), and their gradient to the image."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.errors import unknown
from ambiguous_wild.methods.refinesplat.entropy import Variant


def identity_loss(
    logits: Tensor,  # [n, P]
    identities: Tensor,  # [n] int64 in 0..P; 0 = none
    weights: Tensor,  # [n] >= 0, the keep map at these cells
    variant: Variant = "sigmoid",
) -> Tensor:
    """L_id = CE(psi(phi(render)), identities), a mean over cells weighted by keep.

    Without weights it would make the render show the distractor. sigmoid: binary cross-entropy, one against
    rest, summed over identities; cells without identity are ignored.
    """
    counts = weights * (identities > 0)
    index = (identities - 1).clamp(min=0)[:, None]
    if variant == "sigmoid":
        # sum_k softplus(E_k) - E_target: binary cross-entropy against a one-hot target
        cells = F.softplus(logits).sum(1) - logits.gather(1, index)[:, 0]
    elif variant == "softmax":
        cells = -F.log_softmax(logits, 1).gather(1, index)[:, 0]
    else:
        raise unknown("entropy variant", variant, ("sigmoid", "softmax"))
    return (counts * cells).sum() / counts.sum().clamp(min=1e-6)


def consistency_loss(logits: Tensor, one_hot: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """L_cr = 1/K sum_j mean_{p,q in j} KL(sigma(E(p)) || sigma(E(q))), in O(N).

    Printed as a double loop over pixel pairs. With s = sigma(E), the mean of s_p (log s_p - log s_q) over
    pairs is mean_p[s log s] - mean_p[s] mean_q[log s], per channel; with the same for 1 - s, the covariance
    of s and E.

    Args:
        logits: [n, P].
        one_hot: [K, n] float, membership of each cell in each instance (weights are allowed: keep).
            Instances without cells are ignored.
        variant: sigmoid sums both sides of each channel; softmax has one distribution.
    """
    sizes = one_hot.sum(1)
    used = sizes > 0
    # instances without cells stay, with weights of 0: which they are is not read on the host
    weights = one_hot / torch.where(used, sizes, 1.0)[:, None]
    # logits beyond +-1e4 are saturated; the clamp keeps products finite
    logits = logits.clamp(-1e4, 1e4)
    if variant == "sigmoid":
        # both sides of a channel in one: log s - log(1 - s) is the logit
        s, log_s = torch.sigmoid(logits), logits
    elif variant == "softmax":
        s, log_s = torch.softmax(logits, 1), F.log_softmax(logits, 1)
    else:
        raise unknown("entropy variant", variant, ("sigmoid", "softmax"))
    of = one_hot.argmax(0)  # the instance of each cell; cells without one have weight 0
    with torch.no_grad():  # the means have no gradient: deviations from them sum to 0
        middle, middle_log = (weights @ s)[of], (weights @ log_s)[of]
    # mean[s l] - mean[s] mean[l] = mean[(s - mean s) (l - mean l)]: if the cells agree, the first form is a
    # difference of numbers that are equal to seven digits
    total = weights @ ((s - middle) * (log_s - middle_log)).sum(1)
    return total.sum() / used.sum().clamp(min=1)


def instance_matrix(labels: Tensor, count: int, weights: Tensor | None = None) -> Tensor:
    """Membership [count, n] float32 of cells in instances 1..count; labels [n], 0 = none.

    A dense matrix instead of scatter adds: sums by matmul repeat bit for bit.
    """
    ids = torch.arange(1, count + 1, device=labels.device)
    matrix = (labels[None, :] == ids[:, None]).float()
    return matrix if weights is None else matrix * weights[None, :]
