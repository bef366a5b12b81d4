"""WildGaussians' appearance on the shared trainer: an embedding per Gaussian and one per photo.

Source: "WildGaussians: 3D Gaussian Splatting in the Wild", Kulhanek et al., NeurIPS 2024 (arXiv
2407.08447), and its code. An MLP of (colour, embedding of the Gaussian, embedding of the photo) gives (o,
m); the colour becomes m colour + o. Different from the release: the MLP reads the colour in the view's
direction, not the constant harmonic; m is 1 + its output, so that training starts from unchanged colours;
D-SSIM is of the toned picture (one render a step); the MLP runs on visible Gaussians only. Masks, sky and
growth are not part of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.splat.effects.learnt import Leaf, Learnt, Visible, mlp, mlp_leaves
from ambiguous_wild.splat.field import Row
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.parts import Parts
from ambiguous_wild.splat.step import Shot, TrainData

PHOTO, OCTAVES = 32, 4  # of the photo's embedding; of the Fourier features that the Gaussians' start from
GAUSSIAN = 6 * OCTAVES


@dataclass(frozen=True)
class WildGaussiansConfig:
    """Options. Its code has lr_photo 1e-3, lr_net 5e-4 and scale 0.01, for 70 000 to 200 000 iterations."""

    lr_photo: float = 0.01
    lr_gaussian: float = 5e-3
    lr_net: float = 1e-3
    width: int = 128  # of both hidden layers
    scale: float = 0.1  # of the MLP's output; at 0.01 a run of 700 iterations gains 0.8 dB, at 0.1 2.0


def build(options: WildGaussiansConfig) -> Parts:
    """3DGS with that appearance."""
    return Parts(effects=(WildAppearance(options),))


Config = WildGaussiansConfig


class WildAppearance(Learnt):
    """colour' = (1 + m) colour + o, (o, m) = scale MLP(colour, g of the Gaussian, a of the photo)."""

    name = "wildgaussians"

    def __init__(self, config: WildGaussiansConfig) -> None:
        self.config = config

    def setup(self, data: TrainData) -> None:
        self.seed = data.seed
        super().setup(data)

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        start = torch.tensor(0.01 * rng.normal(size=(len(data.photos), PHOTO)), dtype=torch.float32)
        widths = (3 + GAUSSIAN + PHOTO, self.config.width, self.config.width, 6)
        net = mlp_leaves("net", widths, rng, self.config.lr_net)
        return {"photo": Leaf(start, self.config.lr_photo, per_photo=True), **net}

    def rows(self, gaussians: Gaussians) -> Mapping[str, Row]:
        start = fourier(gaussians.means)
        noise = 1e-4 * np.random.default_rng([self.seed, 0x36]).normal(size=tuple(start.shape))
        start += torch.from_numpy(noise.astype(np.float32)).to(start.device)
        return {"wild_embedding": Row(start, self.config.lr_gaussian)}

    def forward(self, visible: Visible, leaf: Mapping[str, Tensor], shot: Shot) -> Tensor:
        photo = leaf["photo"].expand(len(visible.base), PHOTO)
        inputs = torch.cat([visible.base, visible.extra["wild_embedding"], photo], dim=1)
        offset, gain = (self.config.scale * mlp(inputs, leaf, "net")).split(3, dim=1)
        return (1.0 + gain) * visible.base + offset


def fourier(means: Tensor) -> Tensor:
    """[N, 24]: sin(2 pi 2^k x + {0, pi/2}), k = 0..3, of positions scaled by the 97 % quantile to [0, 1]."""
    centred = means - means.mean(dim=0)
    spread = torch.quantile(centred.abs(), 0.97, dim=0).clamp(min=1e-6)
    unit = 0.5 * centred / spread + 0.5
    angles = torch.cat([2.0 * torch.pi * 2.0**k * unit for k in range(OCTAVES)], dim=1)
    return torch.cat([angles.sin(), (angles + torch.pi / 2).sin()], dim=1)
