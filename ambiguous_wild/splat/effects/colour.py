"""Colours that change from photo to photo: affine exposure, and an embedding that also depends on position.

Affine exposure is 3DGS's option (Kerbl et al., later release): a matrix 3x3 and an offset change the scene's
colours for each photo. One constraint is added: over the train photos the changes sum to zero. So the scene
cannot become darker while all photos become brighter, and a test view, which has no photo, is drawn as the
mean train photo shows it.

The embedding follows WildGaussians (Kulhanek et al. 2024), but is smaller: a few numbers per photo change the
colour of every Gaussian. The change is linear in them, and they sum to zero over the train photos, so that
zero is both the unchanged model and the mean of all photos. Positions enter as Fourier features, which need
no state per Gaussian and so nothing from density control.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.splat.effects.base import (
    Effect,
    RowAdam,
    exponential_decay,
    identity_frame_vjp,
    identity_vjp,
)
from ambiguous_wild.splat.effects.geometry import SceneNormaliser
from ambiguous_wild.splat.effects.tracks import photo_gains
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.rendered import (
    Cotangents,
    EffectGrads,
    Frame,
    FrameVjp,
    Gradients,
    Vjp,
    sum_effect_grads,
)
from ambiguous_wild.splat.step import TrainData, ViewContext

EXPOSURE_RATE, EXPOSURE_RATE_FINAL = 0.01, 0.001  # 3DGS's exposure_lr
EXPOSURE_FIT_RATE = 0.02
SIZE, HIDDEN, OCTAVES = 4, 32, 4  # sizes of the embedding, of the net, of the Fourier features
RATE_ROWS, RATE_NET, FINAL = 0.02, 2e-3, 0.1  # two learning rates, and the share that both decay to
EMBEDDING_FIT_RATE = 0.1  # WildGaussians


class AffineExposure(Effect):
    """toned = image (I + P_v)[:, :3]^T + offset; P_v [3, 4] per photo, their sum over photos is zero."""

    name = "exposure"

    def setup(self, data: TrainData) -> None:
        self.views = len(data.photos)
        table = torch.zeros(self.views + 1, 3, 4, device=data.device)  # the last row is a test photo's
        gains = photo_gains(data.scene, (photo.cpu().numpy() for photo in data.photos))
        table[: self.views, range(3), range(3)] = torch.from_numpy(gains.astype("float32") - 1).to(table)
        self.adam = RowAdam(table)
        self._close()

    def _close(self) -> None:
        rows = self.adam.values[: self.views]
        rows -= rows.mean(dim=0)

    def _affine(self, view: int) -> tuple[Tensor, Tensor]:
        row = self.adam.values[view]
        return row[:, :3] + torch.eye(3, dtype=row.dtype, device=row.device), row[:, 3]

    def image(self, frame: Frame, context: ViewContext) -> tuple[Frame, FrameVjp]:
        row = context.row(self.views)
        if row is None:
            return frame, identity_frame_vjp
        matrix, offset = self._affine(row)
        before = frame.image

        def vjp(cotangents: Cotangents) -> Cotangents:
            image, extra = (
                None if d is None else (d @ matrix).contiguous() for d in (cotangents.image, cotangents.extra)
            )
            effect_grads: EffectGrads = {}
            if cotangents.image is not None:
                flat = cotangents.image.reshape(-1, 3)
                gradient = torch.cat([flat.T @ before.reshape(-1, 3), flat.sum(dim=0)[:, None]], dim=1)
                effect_grads = {self.name: {"affine": gradient.to(self.adam.values)}}
            return replace(
                cotangents,
                image=image,
                extra=extra,
                effect_grads=sum_effect_grads(cotangents.effect_grads, effect_grads),
            )

        return replace(frame, image=(before @ matrix.T + offset).contiguous()), vjp

    def step(
        self, effect_grads: Mapping[str, Tensor], context: ViewContext, skip_step: Tensor | None = None
    ) -> None:
        assert context.view is not None
        self.adam.step(
            context.view,
            effect_grads["affine"],
            exponential_decay(EXPOSURE_RATE, EXPOSURE_RATE_FINAL, context.progress),
            skip_step,
        )
        self._close()

    def begin_fit(self) -> None:
        self.adam.reset(self.views)

    def fit(self, effect_grads: Mapping[str, Tensor]) -> None:
        self.adam.step(self.views, effect_grads["affine"], EXPOSURE_FIT_RATE)

    def facts(self) -> Facts:
        gains = self.adam.values[: self.views, range(3), range(3)] + 1
        return {"gain_lowest": float(gains.min()), "gain_highest": float(gains.max())}

    def state_dict(self) -> State:
        return self.adam.state_dict()

    def load_state_dict(self, state: State) -> None:
        self.adam.load_state_dict(state)


class AppearanceEmbedding(Effect):
    """colour' = colour (1 + m) + o of the constant harmonic; (m, o) = e_v . B(position)."""

    name = "appearance"

    def setup(self, data: TrainData) -> None:
        self.views = len(data.photos)
        self.unit = SceneNormaliser(data.scene.points.xyz, data.device)
        rng = np.random.default_rng([data.seed, 0xA9])

        def weights(*shape: int) -> Tensor:
            values = rng.normal(size=shape) / np.sqrt(shape[0])
            return torch.tensor(values, dtype=torch.float32, device=data.device)

        self.rows_of_photos = RowAdam(torch.zeros(self.views + 1, SIZE, device=data.device))
        inputs = 6 * OCTAVES + 1
        self.net = {"first": weights(inputs, HIDDEN), "last": 0.3 * weights(HIDDEN + 1, SIZE * 6)}
        self.moments = {name: RowAdam(values[None]) for name, values in self.net.items()}

    def features(self, means: Tensor) -> Tensor:
        """Return Fourier features of positions, as WildGaussians starts embeddings from, and 1, [N, 25]."""
        unit = self.unit(means).clamp(-1.5, 1.5)
        angles = torch.cat([unit * (torch.pi * 2.0**k / 2) for k in range(OCTAVES)], dim=1)
        return torch.cat([angles.sin(), angles.cos(), torch.ones_like(unit[:, :1])], dim=1)

    def change(self, features: Tensor, embedding: Tensor, net: dict[str, Tensor]) -> Tensor:
        """Return the changes of gain and offset, [N, 6]."""
        hidden = torch.relu(features @ net["first"])
        hidden = torch.cat([hidden, torch.ones_like(hidden[:, :1])], dim=1)
        # multiply by the embedding first: one matrix [33, 6] a view instead of SIZE of them a Gaussian
        return hidden @ torch.einsum("hse,s->he", net["last"].reshape(-1, SIZE, 6), embedding)

    def model(self, gaussians: Gaussians, context: ViewContext) -> tuple[Gaussians, Vjp]:
        row = context.row(self.views)
        if row is None:
            return gaussians, identity_vjp
        leaves = self.net | {"row": self.rows_of_photos.values[row], "sh0": gaussians.sh0}
        leaves = {name: tensor.detach().clone().requires_grad_(True) for name, tensor in leaves.items()}
        with torch.enable_grad():
            change = self.change(self.features(gaussians.means), leaves["row"], leaves)
            colour = (SH_C0 * leaves["sh0"] + 0.5) * (1 + change[:, :3]) + change[:, 3:]
            sh0 = (colour - 0.5) / SH_C0

        def vjp(gradients: Gradients) -> Gradients:
            parts = torch.autograd.grad(sh0, list(leaves.values()), gradients.sh0.to(sh0), retain_graph=True)
            effect_grads = dict(zip(leaves, parts))
            before = effect_grads.pop("sh0").contiguous()
            return replace(gradients, sh0=before).with_effect_grads(self.name, effect_grads)

        return replace(gaussians, sh0=sh0.detach()), vjp

    def step(
        self, effect_grads: Mapping[str, Tensor], context: ViewContext, skip_step: Tensor | None = None
    ) -> None:
        assert context.view is not None
        share = exponential_decay(1.0, FINAL, context.progress)
        self.rows_of_photos.step(context.view, effect_grads["row"], RATE_ROWS * share, skip_step)
        for name, adam in self.moments.items():
            adam.step(0, effect_grads[name], RATE_NET * share, skip_step)
        rows = self.rows_of_photos.values[: self.views]
        rows -= rows.mean(dim=0)

    def begin_fit(self) -> None:
        self.rows_of_photos.reset(self.views)

    def fit(self, effect_grads: Mapping[str, Tensor]) -> None:
        self.rows_of_photos.step(self.views, effect_grads["row"], EMBEDDING_FIT_RATE)

    def facts(self) -> Facts:
        return {"embedding_std": float(self.rows_of_photos.values[: self.views].std(unbiased=False))}

    def state_dict(self) -> State:
        return {"rows": self.rows_of_photos.state_dict()} | {
            name: m.state_dict() for name, m in self.moments.items()
        }

    def load_state_dict(self, state: State) -> None:
        self.rows_of_photos.load_state_dict(state["rows"])
        for name, adam in self.moments.items():
            adam.load_state_dict(state[name])
