"""SpotLessSplats' net: features of a pixel and the place of the pixel to a static map."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.methods.robustsplat.net import MaskNet, enlarged

OCTAVES = 20


class PlacedNet(MaskNet):
    """The net of RobustSplat, which is this one's, with the pixel's place beside its features."""

    def __init__(self, mean: Tensor, std: Tensor, hidden: int, seed: int) -> None:
        super().__init__(mean, std, hidden, seed)
        self.place = nn.Linear(4 * OCTAVES, hidden, bias=False, device=mean.device)
        limit = (len(mean) + 4 * OCTAVES) ** -0.5  # both together are one layer
        generator = torch.Generator().manual_seed(seed + 1)
        with torch.no_grad():
            drawn = 2.0 * torch.rand(self.place.weight.shape, generator=generator) - 1.0
            self.place.weight.copy_(drawn * limit)
            for values in (self.first.weight, self.first.bias):
                values *= limit * len(mean) ** 0.5

    def forward(self, features: Tensor, height: int, width: int) -> Tensor:
        """[height, width]; columns and rows are coded apart, for their code is a sum in the first layer."""
        z = enlarged(self.first((features - self.mean) / self.std), height, width)
        x, y = (placed(size, z) for size in (width, height))
        across, down = self.place.weight[:, : 2 * OCTAVES], self.place.weight[:, 2 * OCTAVES :]
        z = z + (x @ across.T)[None, :, :] + (y @ down.T)[:, None, :]
        return torch.sigmoid(self.last(F.relu(z)).squeeze(2))


def placed(size: int, like: Tensor) -> Tensor:
    """[size, 40]: sin and cos of pi 2^k x, k = 0..19, at x from 0 to 1 along a side."""
    at = torch.arange(size, device=like.device, dtype=torch.float64) / max(size - 1, 1)
    angles = torch.pi * torch.stack([2.0**k * at for k in range(OCTAVES)], dim=1)
    return torch.cat([angles.sin(), angles.cos()], dim=1).to(like)
