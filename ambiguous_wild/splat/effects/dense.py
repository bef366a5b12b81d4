"""A dense start: Gaussians at points of plane sweeps too, not only at those of structure from motion.

Where photos overlap little, 3DGS's growth puts Gaussians where they explain one photo, often close to its
camera. Points on which several photos agree leave less to be guessed. The idea is that of EDGS (Kotovenko et
al., 2025); we use plane sweeps instead of a matching network.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.effects.tracks import tracks_of
from ambiguous_wild.splat.plane_sweep import dense_points
from ambiguous_wild.splat.step import TrainData


class DenseStart(Effect):
    """Acts on the first Gaussians alone."""

    name = "dense"

    def __init__(self) -> None:
        self.count = 0

    def first_points(self, data: TrainData, most: int) -> tuple[np.ndarray, np.ndarray]:
        def photo(view: int) -> np.ndarray:  # one at a time: they may lie on a GPU
            return data.photos[view].cpu().numpy()

        keep = [None if k is None else k.cpu().numpy() for k in data.user_keep]
        xyz, rgb = dense_points(data.cameras, photo, data.scene.points.xyz, tracks_of(data.scene), keep, most)
        self.count = len(xyz)
        return xyz, rgb

    def facts(self) -> dict[str, Any]:
        return {"points": self.count}
