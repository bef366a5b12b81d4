"""The per-pixel net: Linear - ReLU - Linear - sigmoid on frozen features of the photo."""

from __future__ import annotations

from functools import cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.splat.backend import backend_of


class MaskNet(nn.Module):
    """Features [h, w, C] to a static map [H, W]; the features' mean and std are part of it."""

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor, hidden: int, seed: int) -> None:
        """
        Args:
            mean, std: [C], subtracted and divided by; zeros and ones change nothing.
            hidden: width.
            seed: of the weights, drawn as `nn.Linear` draws them.
        """
        super().__init__()
        self.register_buffer("mean", mean.clone())
        self.register_buffer("std", std.clone())
        self.first = nn.Linear(len(mean), hidden, device=mean.device)
        self.last = nn.Linear(hidden, 1, device=mean.device)
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for layer in (self.first, self.last):
                limit = layer.in_features**-0.5
                for values in (layer.weight, layer.bias):
                    values.copy_((2.0 * torch.rand(values.shape, generator=generator) - 1.0) * limit)

    def forward(self, features: Tensor, height: int, width: int) -> Tensor:
        """The map [height, width].

        The first layer runs on the grid and its output is enlarged: bilinear weights sum to one, so that is
        what enlarging all C channels first gives, at hidden / C of the work.
        """
        z = self.first((features - self.mean) / self.std)
        if z.shape[:2] != (height, width):
            z = enlarged(z, height, width)
        return torch.sigmoid(self.last(F.relu(z)).squeeze(2))


def enlarged(z: Tensor, height: int, width: int) -> Tensor:
    """[h, w, C] to [height, width, C], bilinear with pixel centres kept in place (not align_corners).

    Two products with small matrices: with many channels on the CPU a third of the cost of `F.interpolate`
    and its backward pass, equal up to rounding.
    """
    h, w, channels = z.shape
    rows = _weights(h, height, z.dtype, z.device)
    columns = _weights(w, width, z.dtype, z.device)
    return columns @ (rows @ z.reshape(h, w * channels)).reshape(height, w, channels)


@cache
def _weights(size: int, to: int, dtype: torch.dtype, place: torch.device) -> Tensor:
    """[to, size]: weight of each value in each enlarged one; rows sum to one. Copied to the device once."""
    at = ((torch.arange(to, dtype=torch.float64) + 0.5) * (size / to) - 0.5).clamp(min=0.0)
    low = at.floor().long().clamp(max=size - 1)
    high = (low + 1).clamp(max=size - 1)
    share, number = at - low, torch.arange(to)
    weights = torch.zeros(to, size, dtype=torch.float64)
    weights[number, low] += 1.0 - share
    weights[number, high] += share
    return weights.float().to(place, dtype)


def adam_of(net: nn.Module, lr: float, place: torch.device) -> torch.optim.Adam:
    """Adam on the net's parameters, see `Backend.adam`."""
    return backend_of(place).adam(net.parameters(), lr)


def adam_state(optimiser: torch.optim.Adam) -> list[dict[str, Any]]:
    """Moments and counts of every parameter, in the optimiser's order; empty before its first step."""
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    return [dict(optimiser.state[p]) for p in parameters if p in optimiser.state]


def load_adam_state(optimiser: torch.optim.Adam, rows: list[dict[str, Any]]) -> None:
    """Restore what `adam_state` returned."""
    optimiser.state.clear()  # what was saved before the first step is empty
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    fused = bool(optimiser.defaults["fused"])
    for parameter, row in zip(parameters, rows):
        # Adam keeps the count of steps on the CPU, the fused one on the parameter's device
        optimiser.state[parameter] = {
            k: v.clone() if k == "step" and not fused else v.clone().to(parameter) for k, v in row.items()
        }
