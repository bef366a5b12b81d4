"""Appearance embedding: a few numbers per photo change the colour of every Gaussian, by where it is.

After WildGaussians (Kulhanek et al. 2024), smaller and with a neutral that is exact: the change is *linear*
in the photo's embedding, and embeddings sum to zero over the train photos, so that an embedding of zero is
both the unchanged model and the mean of all photos. Positions enter as Fourier features, which needs no
state per Gaussian and so nothing of density control.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.splat.effects.base import Effect, RowAdam, State, decayed, same
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.rendered import Gradients, Pull
from ambiguous_wild.splat.step import Shot, TrainData

SIZE, HIDDEN, OCTAVES = 4, 32, 4  # of the embedding, of the net, of the Fourier features
RATE_ROWS, RATE_NET, FINAL = 0.02, 2e-3, 0.1  # both decay to this share
FIT_RATE = 0.1  # WildGaussians


class AppearanceEmbedding(Effect):
    """colour' = colour (1 + m) + o of the constant harmonic; (m, o) = e_v . B(position)."""

    name = "appearance"

    def setup(self, data: TrainData) -> None:
        self.views = len(data.photos)
        xyz = data.scene.points.xyz
        self.centre = torch.tensor(np.median(xyz, axis=0), dtype=torch.float32, device=data.device)
        spread = np.maximum(np.quantile(np.abs(xyz - np.median(xyz, axis=0)), 0.97, axis=0), 1e-6)
        self.spread = torch.tensor(spread, dtype=torch.float32, device=data.device)
        rng = np.random.default_rng([data.seed, 0xA9])

        def weights(*shape: int) -> Tensor:
            values = rng.normal(size=shape) / np.sqrt(shape[0])
            return torch.tensor(values, dtype=torch.float32, device=data.device)

        self.rows_of_photos = RowAdam(torch.zeros(self.views + 1, SIZE, device=data.device))
        inputs = 6 * OCTAVES + 1
        self.net = {"first": weights(inputs, HIDDEN), "last": 0.3 * weights(HIDDEN + 1, SIZE * 6)}
        self.moments = {name: RowAdam(values[None]) for name, values in self.net.items()}

    def features(self, means: Tensor) -> Tensor:
        """[N, 25]: Fourier features of positions, as WildGaussians starts its embeddings from, and 1."""
        unit = ((means - self.centre) / self.spread).clamp(-1.5, 1.5)
        angles = torch.cat([unit * (torch.pi * 2.0**k / 2) for k in range(OCTAVES)], dim=1)
        return torch.cat([angles.sin(), angles.cos(), torch.ones_like(unit[:, :1])], dim=1)

    def change(self, features: Tensor, embedding: Tensor, net: dict[str, Tensor]) -> Tensor:
        """[N, 6]: what is added to gain and offset."""
        hidden = torch.relu(features @ net["first"])
        hidden = torch.cat([hidden, torch.ones_like(hidden[:, :1])], dim=1)
        # the embedding first: one [33, 6] matrix a view instead of SIZE of them a Gaussian
        return hidden @ torch.einsum("hse,s->he", net["last"].reshape(-1, SIZE, 6), embedding)

    def model(self, gaussians: Gaussians, shot: Shot) -> tuple[Gaussians, Pull]:
        row = shot.row(self.views)
        if row is None:
            return gaussians, same
        leaves = self.net | {"row": self.rows_of_photos.values[row], "sh0": gaussians.sh0}
        leaves = {name: tensor.detach().clone().requires_grad_(True) for name, tensor in leaves.items()}
        with torch.enable_grad():
            change = self.change(self.features(gaussians.means), leaves["row"], leaves)
            colour = (SH_C0 * leaves["sh0"] + 0.5) * (1 + change[:, :3]) + change[:, 3:]
            sh0 = (colour - 0.5) / SH_C0

        def pull(gradients: Gradients) -> Gradients:
            found = torch.autograd.grad(sh0, list(leaves.values()), gradients.sh0.to(sh0), retain_graph=True)
            own = dict(zip(leaves, found))
            before = own.pop("sh0").contiguous()
            return replace(gradients, sh0=before).with_own(self.name, own)

        return replace(gaussians, sh0=sh0.detach()), pull

    def step(self, own: Mapping[str, Tensor], shot: Shot, called_off: Tensor | None = None) -> None:
        assert shot.view is not None
        share = decayed(1.0, FINAL, shot.progress)
        self.rows_of_photos.step(shot.view, own["row"], RATE_ROWS * share, called_off)
        for name, adam in self.moments.items():
            adam.step(0, own[name], RATE_NET * share, called_off)
        rows = self.rows_of_photos.values[: self.views]
        rows -= rows.mean(dim=0)

    def begin_fit(self) -> None:
        self.rows_of_photos.reset(self.views)

    def fit(self, own: Mapping[str, Tensor]) -> None:
        self.rows_of_photos.step(self.views, own["row"], FIT_RATE)

    def facts(self) -> dict[str, Any]:
        return {"embedding_std": float(self.rows_of_photos.values[: self.views].std(unbiased=False))}

    def state_dict(self) -> State:
        return {"rows": self.rows_of_photos.state_dict()} | {
            name: m.state_dict() for name, m in self.moments.items()
        }

    def load_state_dict(self, state: State) -> None:
        self.rows_of_photos.load_state_dict(state["rows"])
        for name, adam in self.moments.items():
            adam.load_state_dict(state[name])
