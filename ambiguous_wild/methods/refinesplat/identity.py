"""psi: the frozen identity classifier on features, trained once on the photos (RefineSplat, stage 0)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.refinesplat.entropy import Variant


@dataclass(frozen=True)
class PsiConfig:
    """psi's size and training. The paper states neither."""

    hidden: int = 64  # units of the one hidden layer
    steps: int = 1000  # Adam steps
    batch: int = 1024  # cells a step
    rate: float = 3e-3  # Adam's, decayed to a tenth by a cosine

    def __post_init__(self) -> None:
        whole = (1, math.inf)
        check_limits(self, "refinesplat.psi", hidden=whole, steps=whole, batch=whole, rate=(1e-9, math.inf))


class Psi(nn.Module):
    """Identity logits [..., P] of features [..., C]: standardise, Linear, ReLU, Linear."""

    mean: Tensor
    std: Tensor

    def __init__(self, channels: int, hidden: int, identities: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("std", torch.ones(channels))
        self.first = nn.Linear(channels, hidden)
        self.last = nn.Linear(hidden, identities)

    def forward(self, features: Tensor) -> Tensor:
        standard = (features - self.mean) / self.std
        return self.last(torch.relu(self.first(standard)))

    @property
    def identities(self) -> int:
        return self.last.out_features


def train_psi(
    features: Tensor,  # [n, C] cells of all photos
    identities: Tensor,  # [n] int64, 0 = none
    count: int,  # P
    config: PsiConfig,
    variant: Variant,
    seed: int,
) -> Psi:
    """Train psi and freeze it.

    sigmoid: binary cross-entropy one against rest, cells without identity are against all. softmax:
    cross-entropy over cells with an identity.

    Raises:
        AwError: no cell has an identity, or count is outside 1..255.
    """
    if not 1 <= count <= 255 or not bool((identities > 0).any()):
        raise AwError(f"psi needs 1 to 255 identities with cells, got {count}: check the instance masks")
    if variant == "softmax":
        features, identities = features[identities > 0], identities[identities > 0]
    generator = torch.Generator().manual_seed(seed)
    psi = Psi(features.shape[1], config.hidden, count)
    with torch.no_grad():
        psi.mean.copy_(features.double().mean(0).float())
        psi.std.copy_(features.double().std(0, correction=0).float().clamp(min=1e-6))
        for layer in (psi.first, psi.last):
            bound = layer.in_features**-0.5
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.zero_()
        if variant == "sigmoid":
            psi.last.bias.fill_(-3.0)  # most identities are absent from most cells
    optimiser = torch.optim.Adam(psi.parameters(), lr=config.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps, config.rate / 10)
    for _ in range(config.steps):
        rows = torch.randint(len(features), (config.batch,), generator=generator)
        loss = _loss(psi(features[rows]), identities[rows], variant)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return psi.requires_grad_(False).eval()


def _loss(logits: Tensor, identities: Tensor, variant: Variant) -> Tensor:
    if variant == "softmax":
        return F.cross_entropy(logits, identities - 1)
    # binary cross-entropy, cells of no identity included: sum_k softplus(E_k), minus the target's logit
    target = logits.gather(1, (identities - 1).clamp(min=0)[:, None])[:, 0]
    return (F.softplus(logits).sum(1) - target * (identities > 0)).mean()


def psi_arrays(psi: Psi) -> dict[str, Any]:
    """psi's tensors as numpy arrays, for the cache."""
    return {name: tensor.cpu().numpy() for name, tensor in psi.state_dict().items()}


def psi_from_arrays(arrays: dict[str, Any]) -> Psi:
    """psi from `psi_arrays`, frozen."""
    hidden, channels = arrays["first.weight"].shape
    psi = Psi(channels, hidden, arrays["last.weight"].shape[0])
    psi.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})
    return psi.requires_grad_(False).eval()
