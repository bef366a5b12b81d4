"""Affine exposure: each photo sees the scene's colours through a 3x3 matrix and an offset of its own.

3DGS's exposure option (Kerbl et al., later release) with a constraint: over the train photos the changes
sum to zero, so that the scene cannot drift darker while all photos grow brighter, and a test view, which has
no photo, is drawn as the mean train photo sees it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.effects.base import Effect, RowAdam, State, decayed
from ambiguous_wild.splat.effects.tracks import photo_gains
from ambiguous_wild.splat.step import TrainData

RATE, RATE_FINAL = 0.01, 0.001  # 3DGS's exposure_lr
FIT_RATE = 0.02


class AffineExposure(Effect):
    """toned = image (I + P_v)[:, :3]^T + offset; P_v [3, 4] per photo, their sum over photos is zero."""

    name = "exposure"

    def setup(self, data: TrainData) -> None:
        self.views = len(data.photos)
        table = torch.zeros(self.views + 1, 3, 4, device=data.device)  # the last row is a test photo's
        gains = photo_gains(data.scene, [p.cpu().numpy() for p in data.photos])
        table[: self.views, range(3), range(3)] = torch.from_numpy(gains.astype("float32") - 1).to(table)
        self.adam = RowAdam(table)
        self._gradient: Tensor | None = None
        self._close()

    def _close(self) -> None:
        rows = self.adam.values[: self.views]
        rows -= rows.mean(dim=0)

    def _affine(self, view: int) -> tuple[Tensor, Tensor]:
        row = self.adam.values[view]
        return row[:, :3] + torch.eye(3, dtype=row.dtype, device=row.device), row[:, 3]

    def image(self, image: Tensor, view: int | None) -> Tensor:
        if view is None:
            return image
        matrix, offset = self._affine(view)
        return (image @ matrix.T + offset).contiguous()

    def image_backward(self, image: Tensor, d_image: Tensor, view: int | None, *, learn: bool) -> Tensor:
        if view is None:
            return d_image
        matrix, _ = self._affine(view)
        if learn:
            flat = d_image.reshape(-1, 3)
            gradient = torch.cat([flat.T @ image.reshape(-1, 3), flat.sum(dim=0)[:, None]], dim=1)
            self._gradient = gradient.to(self.adam.values)
        return (d_image @ matrix).contiguous()

    def step(self, view: int, progress: float, called_off: Tensor | None = None) -> None:
        if self._gradient is not None:
            self.adam.step(view, self._gradient, decayed(RATE, RATE_FINAL, progress), called_off)
            self._gradient = None
            self._close()

    def begin_fit(self) -> None:
        self.adam.reset(self.views)

    def fit(self) -> None:
        if self._gradient is not None:
            self.adam.step(self.views, self._gradient, FIT_RATE)
            self._gradient = None

    def facts(self) -> dict[str, Any]:
        gains = self.adam.values[: self.views, range(3), range(3)] + 1
        return {"gain_lowest": float(gains.min()), "gain_highest": float(gains.max())}

    def state_dict(self) -> State:
        return self.adam.state_dict()

    def load_state_dict(self, state: State) -> None:
        self.adam.load_state_dict(state)
