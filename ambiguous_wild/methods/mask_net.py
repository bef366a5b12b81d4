"""A per-pixel net on frozen features of the photo: Linear - ReLU - Linear - sigmoid."""

from __future__ import annotations

from functools import cache

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core.config import State
from ambiguous_wild.splat.backend import backend_of


class MaskNet(nn.Module):
    """Maps features [h, w, C] to a static map [H, W]; standardises them first."""

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor, hidden: int, seed: int) -> None:
        """
        Args:
            mean, std: [C], which standardise features; zeros and ones change nothing.
            hidden: width of the hidden layer.
            seed: seed of the weights, which are initialised as by `nn.Linear`.
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
        """Return the map [height, width].

        The first layer runs on the grid, and its output is enlarged. As bilinear weights sum to one, this
        equals enlarging all C channels first, at hidden / C of the work.
        """
        z = self.first((features - self.mean) / self.std)
        if z.shape[:2] != (height, width):
            z = enlarged(z, height, width)
        return torch.sigmoid(self.last(F.relu(z)).squeeze(2))


def enlarged(z: Tensor, height: int, width: int) -> Tensor:
    """Enlarge [h, w, C] to [height, width, C], bilinear, with pixel centres in place (not align_corners).

    Two products with small matrices: with many channels on the CPU a third of the cost of `F.interpolate`
    and its backward pass, equal up to rounding.
    """
    h, w, channels = z.shape
    rows = _weights(h, height, z.dtype, z.device)
    columns = _weights(w, width, z.dtype, z.device)
    return columns @ (rows @ z.reshape(h, w * channels)).reshape(height, w, channels)


@cache
def _weights(size: int, to: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weight of each value in each enlarged one, [to, size]; rows sum to one. Copied once."""
    at = ((torch.arange(to, dtype=torch.float64) + 0.5) * (size / to) - 0.5).clamp(min=0.0)
    low = at.floor().long().clamp(max=size - 1)
    high = (low + 1).clamp(max=size - 1)
    share, number = at - low, torch.arange(to)
    weights = torch.zeros(to, size, dtype=torch.float64)
    weights[number, low] += 1.0 - share
    weights[number, high] += share
    return weights.float().to(device, dtype)


def adam_of(net: nn.Module, lr: float, device: torch.device) -> torch.optim.Adam:
    """Return Adam for the net's parameters, see `Backend.adam`."""
    return backend_of(device).adam(net.parameters(), lr)


def adam_state(optimiser: torch.optim.Adam) -> list[State]:
    """Return moments and step count of every parameter, in order; empty before the first step."""
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    return [dict(optimiser.state[p]) for p in parameters if p in optimiser.state]


def load_adam_state(optimiser: torch.optim.Adam, rows: list[State]) -> None:
    """Restore what `adam_state` returned."""
    optimiser.state.clear()  # a state saved before the first step is empty
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    fused = bool(optimiser.defaults["fused"])
    for parameter, row in zip(parameters, rows):
        # Adam keeps the count of steps on the CPU, the fused one on the parameter's device
        optimiser.state[parameter] = {
            k: v.clone() if k == "step" and not fused else v.clone().to(parameter) for k, v in row.items()
        }
