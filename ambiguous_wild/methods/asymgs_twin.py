"""AsymGS in its GS-GS form: two models under different masks must agree; the first is the result.

Source: arXiv 2506.03538 and its released code. The first model sees a photo under the hard mask, the second
another photo under the learnt one; in both views their pictures must agree. Ours: what `asymgs.py` lists, and
the camera of the second photo stays as COLMAP gave it even if an effect moves cameras.

Cost: four pictures with gradients in each step, and two models.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.asymgs import AsymGsConfig, AsymMask
from ambiguous_wild.splat.data import shrink, shrink_camera, shrink_keep
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.field import Rates
from ambiguous_wild.splat.fields import STATIC, Fields, FieldStart
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.parts import MaskPolicy, Parts, Schedule
from ambiguous_wild.splat.rendered import Cotangents, Frame, Gradients
from ambiguous_wild.splat.step import Shot, Step, TrainData

TWIN = "twin"


@dataclass(frozen=True)
class TwinConfig(AsymGsConfig):
    """`AsymGsConfig` with the released settings for two models."""

    consistency: float = 1.0  # weight of mean |picture - the other model's picture| in each view
    colour: float = 0.9


def build(options: TwinConfig) -> Parts:
    """Return 3DGS with the hard mask, and the second model as a field that no picture shows."""
    masks, rates = HardMask(options), Schedule(lr_opacity=0.1)
    return Parts(masks, DensityControl, options.density, rates, fields=Twin(options, masks))


class HardMask(AsymMask):
    """The mask of the first model; the second model uses the learnt maps."""

    def keep(self, step: Step) -> Tensor:
        return self.hard_keep(step)

    predict = keep

    cotangent = MaskPolicy.cotangent  # type: ignore[assignment]  # no loss here: `Twin` compares the models


class Twin(Fields):
    """The second model. It is drawn beside the first and is part of no picture; both must agree."""

    def __init__(self, config: TwinConfig, masks: AsymMask) -> None:
        self.config, self.masks = config, masks
        self._second: tuple[int, Camera] | None = None  # photo and camera of the second model in this step

    def setup(self, data: TrainData, static: Gaussians, rates: Rates) -> Mapping[str, FieldStart]:
        self.data = data
        start = replace(static, attributes={}).clone()
        density = DensityControl(self.config.density, data.scene.extent, data.seed + 1)
        return {TWIN: FieldStart(start, rates, density, most=None)}

    def drawn(self, shot: Shot) -> tuple[str, ...]:
        return (TWIN,)

    def regularise(self, frames: Mapping[str, Frame], shot: Shot) -> Mapping[str, Cotangents]:
        """Return gradients of the models' difference and of the second one's loss in its own view."""
        apart = frames[STATIC].image - frames[TWIN].image
        weight = self.config.consistency if shot.nominal > self.config.warm_up else 0.0
        pull = apart.sign() * (weight / apart.numel())
        second = -pull
        if self._second is not None and shot.camera is self._second[1]:
            second = second + self._photometric(self._second[0], frames[TWIN].image, shot.divisor)
        return {STATIC: Cotangents(image=pull), TWIN: Cotangents(image=second)}

    def gradients(self, step: Step, keep: Tensor | None) -> Mapping[str, Gradients]:
        """Return gradients of both models in the second view, which is drawn with replacement."""
        view = int(np.random.default_rng((self.data.seed, step.iteration)).integers(len(self.data.cameras)))
        camera = shrink_camera(self.data.cameras[view], step.divisor)
        self._second = view, camera
        rendered = step.draw(camera=camera)
        gradients = rendered.backward(Cotangents(image=torch.zeros_like(rendered.image)))
        self._second = None
        return {STATIC: gradients}  # those of the second model are in `fields`

    def _photometric(self, view: int, image: Tensor, divisor: int) -> Tensor:
        """Return dL/dimage of the second model under the learnt mask of its photo; the mask learns too."""
        keep, user = self.masks.soft_keep(view, image.shape[:2]), self.data.user_keep[view]
        if user is not None:
            keep = keep * shrink_keep(user, divisor)
        self.masks.learn_soft(view, image)
        photo = shrink(self.data.photos[view], divisor)
        return photometric(image, photo, keep).d_image
