"""Affine exposure: each photo sees the scene's colours through a 3x3 matrix and an offset of its own.

3DGS's exposure option (Kerbl et al., later release) with a constraint: over the train photos the changes
sum to zero, so that the scene cannot drift darker while all photos grow brighter, and a test view, which has
no photo, is drawn as the mean train photo sees it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.splat.effects.base import Effect, RowAdam, State, decayed, unchanged
from ambiguous_wild.splat.effects.tracks import photo_gains
from ambiguous_wild.splat.rendered import Cotangents, Frame, FramePull, Own, sum_own
from ambiguous_wild.splat.step import Shot, TrainData

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
        self._close()

    def _close(self) -> None:
        rows = self.adam.values[: self.views]
        rows -= rows.mean(dim=0)

    def _affine(self, view: int) -> tuple[Tensor, Tensor]:
        row = self.adam.values[view]
        return row[:, :3] + torch.eye(3, dtype=row.dtype, device=row.device), row[:, 3]

    def image(self, frame: Frame, shot: Shot) -> tuple[Frame, FramePull]:
        row = shot.row(self.views)
        if row is None:
            return frame, unchanged
        matrix, offset = self._affine(row)
        before = frame.image

        def pull(cotangents: Cotangents) -> Cotangents:
            image, extra = (
                None if d is None else (d @ matrix).contiguous() for d in (cotangents.image, cotangents.extra)
            )
            own: Own = {}
            if cotangents.image is not None:
                flat = cotangents.image.reshape(-1, 3)
                gradient = torch.cat([flat.T @ before.reshape(-1, 3), flat.sum(dim=0)[:, None]], dim=1)
                own = {self.name: {"affine": gradient.to(self.adam.values)}}
            return replace(cotangents, image=image, extra=extra, own=sum_own(cotangents.own, own))

        return replace(frame, image=(before @ matrix.T + offset).contiguous()), pull

    def step(self, own: Mapping[str, Tensor], shot: Shot, called_off: Tensor | None = None) -> None:
        assert shot.view is not None
        self.adam.step(shot.view, own["affine"], decayed(RATE, RATE_FINAL, shot.progress), called_off)
        self._close()

    def begin_fit(self) -> None:
        self.adam.reset(self.views)

    def fit(self, own: Mapping[str, Tensor]) -> None:
        self.adam.step(self.views, own["affine"], FIT_RATE)

    def facts(self) -> dict[str, Any]:
        gains = self.adam.values[: self.views, range(3), range(3)] + 1
        return {"gain_lowest": float(gains.min()), "gain_highest": float(gains.max())}

    def state_dict(self) -> State:
        return self.adam.state_dict()

    def load_state_dict(self, state: State) -> None:
        self.adam.load_state_dict(state)
