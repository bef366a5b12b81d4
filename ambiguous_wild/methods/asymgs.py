"""AsymGS: the model must agree with a second one that is trained under other masks.

EMA-GS form (`asymgs`): the second one is an exponential moving average (EMA) of the first, and the masks
change in turn. The EMA is stored with every Gaussian, so that density control changes both alike.

GS-GS form (`asymgs-twin`): two models; the first sees a photo under the hard mask, the second another photo
under the learnt one; in both views their pictures must agree. The first is the result. A step draws four
pictures with gradients.

Source: arXiv 2506.03538 and its released code. Ours: features (Lab and HOG; the published patch embedding of
DINOv2 is no option) and instances (graph segments for Semantic-SAM's) without weights, both options; masks
weigh SSIM's map, not its gradient; the base is 3DGS without Mip-Splatting's filters and growth; the camera of
the twin's photo stays as COLMAP gave it even if an effect moves cameras. Left out: the appearance model for
photo collections (codes of photos and Gaussians, and a net of colours).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import State
from ambiguous_wild.methods.dronesplat import unit_range
from ambiguous_wild.methods.masking_common import nearest, residual, resized
from ambiguous_wild.splat.data import shrink, shrink_camera, shrink_keep
from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.effects.base import Effect, RowAdam
from ambiguous_wild.splat.field import GaussianAttribute, Rates
from ambiguous_wild.splat.fields import STATIC, Fields, FieldStart
from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks, Schedule
from ambiguous_wild.splat.rendered import Cotangents, Frame, Gradients
from ambiguous_wild.splat.step import Step, TrainData, ViewContext
from ambiguous_wild.vision.backends import make_features, make_instances
from ambiguous_wild.vision.mask_ops import drop_static_instances, keep_from_suspects
from ambiguous_wild.vision.precompute import instance_labels, photo_features

TWIN = "twin"


class ParameterEma(Effect):
    """Updates EMA = keep EMA + (1 - keep) p of the raw parameters after every step."""

    name = "slow-average"

    def __init__(self, keep: float) -> None:
        self.share = 1.0 - keep

    def rows(self, gaussians: Gaussians) -> Mapping[str, GaussianAttribute]:
        return {ema_attribute(name): GaussianAttribute(tensor.clone()) for name, tensor in gaussians.items()}

    @torch.no_grad()
    def after_step(self, step: Step, gaussians: Gaussians) -> None:
        gaussians.flush()
        for name, tensor in gaussians.items():
            gaussians.attributes[ema_attribute(name)].lerp_(tensor, self.share)


class EmaDensity(DensityControl):
    """Gives the EMA of a split's child the child's position and size, and else the parent's values."""

    def _split_half(self, parents: Gaussians) -> Gaussians:
        child = super()._split_half(parents)
        for name in ("means", "log_scales"):
            if ema_attribute(name) in child.attributes:
                child.attributes[ema_attribute(name)].copy_(getattr(child, name))
        return child


def ema_attribute(name: str) -> str:
    """Return the name of the attribute that holds a parameter's EMA."""
    return f"slow_{name}"


def ema_gaussians(gaussians: Gaussians) -> Gaussians | None:
    """Return the EMA as Gaussians, which share its tensors; None if there is none."""
    if ema_attribute("means") not in gaussians.attributes:
        return None
    return Gaussians(*(gaussians.attributes[ema_attribute(name)] for name in PARAMETERS))


@dataclass(frozen=True)
class AsymGsConfig:
    """Times in nominal iterations (of 30 000)."""

    features: str = "labhog"  # see vision/backends.py
    instances: str = "graph"
    density: DensityConfig = field(default_factory=lambda: DensityConfig(every=1000.0, resets=()))
    warm_up: float = 1000.0  # before it soft masks do not learn, and no loss compares with the average
    consistency: float = 0.1  # weight of mean |picture - picture of the EMA| in the loss
    colour: float = 0.95  # quantile of the residual above which a pixel is suspect
    feature: float = 0.9  # quantile of the features' distance
    support: float = 0.1  # instances with this share of the photo's density of points are static


def build(options: AsymGsConfig) -> MethodHooks:
    """Return 3DGS with masks, the average as an effect, and growth that updates it."""
    average, rates = ParameterEma(0.8), Schedule(lr_opacity=0.1)
    return MethodHooks(
        AlternatingMask(options, average), EmaDensity, options.density, rates, effects=(average,)
    )


class AlternatingMask(MaskPolicy):
    """Masks suspicious instances in even iterations, and by a map learnt for the photo in odd ones."""

    def __init__(self, config: AsymGsConfig, average: ParameterEma | None = None) -> None:
        self.average = average
        self.config, self.features = config, make_features(config.features)
        self.instances = make_instances(config.instances)

    def setup(self, data: TrainData) -> None:
        self.features.fit(data.photos)
        self.phi = photo_features(self.features, data.photos, data.cache_dir)
        names, least = [view.name for view in data.scene.train], self.config.support
        labelled = zip(instance_labels(self.instances, data.photos, names, data.cache_dir).labels, names)
        suspects = (drop_static_instances(labels, data.scene, name, least) for labels, name in labelled)
        self.labels = [torch.from_numpy(labels).to(data.device) for labels in suspects]
        self.soft = [RowAdam(torch.ones(1, *x.shape, device=data.device)) for x in self.labels]

    def loss_effect(self) -> ParameterEma | None:
        return self.average

    def keep(self, step: Step) -> Tensor:
        keep = self.predict(step)
        if step.iteration % 2 and step.nominal > self.config.warm_up:
            self.learn_soft(step.view, step.rendered.image)
        return keep

    def predict(self, step: Step) -> Tensor:
        if step.iteration % 2:
            return self.soft_keep(step.view, step.photo.shape[:2])
        return self.hard_keep(step)

    def learn_soft(self, view: int, image: Tensor) -> None:
        """Take one step of Adam on |M - (1 - distance)| of a photo's learnt map."""
        soft = self.soft[view]
        share, target = torch.sigmoid(8 * soft.values[0]), 1.0 - unit_range(self._distance(view, image))
        soft.step(0, (share - target).sign() * 8 * share * (1 - share) / share.numel(), 0.1)

    def soft_keep(self, view: int, size: Sequence[int]) -> Tensor:
        """Return the learnt map, [H, W]."""
        return resized(torch.sigmoid(8 * self.soft[view].values[0]), *size)

    def hard_keep(self, step: Step) -> Tensor:
        """Return a map [H, W] that masks instances whose residual and features are suspicious."""
        size = step.photo.shape[:2]
        distance = resized(self._distance(step.view, step.rendered.image), *size)
        error = residual(step.photo, step.rendered.image)
        suspect = error > torch.quantile(error, self.config.colour)
        suspect &= distance > torch.quantile(distance, self.config.feature)
        return keep_from_suspects(nearest(self.labels[step.view], *size), suspect)

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | None:
        if step.nominal <= self.config.warm_up or not (teacher := ema_gaussians(step.gaussians)):
            return None
        apart = step.rendered.image - step.draw(gaussians=teacher).image
        return Cotangents(image=apart.sign() * (self.config.consistency / apart.numel()))

    @torch.no_grad()
    def _distance(self, view: int, image: Tensor) -> Tensor:
        """Return 1 - cosine of the features of render and photo, [H, W] of the photo."""
        size, chw = self.labels[view].shape, image.permute(2, 0, 1)
        seen = self.features(F.interpolate(chw[None], size=size, mode="bilinear")[0].permute(1, 2, 0))
        return resized(1.0 - F.cosine_similarity(self.phi[view], seen, dim=2), *size)

    def state_dict(self) -> State:
        return {str(view): soft.state_dict() for view, soft in enumerate(self.soft)}

    def load_state_dict(self, state: State) -> None:
        for view, soft in enumerate(self.soft):
            soft.load_state_dict(state[str(view)])


@dataclass(frozen=True)
class TwinConfig(AsymGsConfig):
    """`AsymGsConfig` with the released settings for two models."""

    consistency: float = 1.0  # weight of mean |picture - the other model's picture| in each view
    colour: float = 0.9


def build_twin(options: TwinConfig) -> MethodHooks:
    """Return 3DGS with the hard mask, and the second model as a field that no picture shows."""
    masks, rates = HardMask(options), Schedule(lr_opacity=0.1)
    return MethodHooks(masks, DensityControl, options.density, rates, fields=TwinField(options, masks))


class HardMask(AlternatingMask):
    """The mask of the first model; the second model uses the learnt maps."""

    def keep(self, step: Step) -> Tensor:
        return self.hard_keep(step)

    predict = keep

    cotangent = MaskPolicy.cotangent  # type: ignore[assignment]  # no loss here: `TwinField` compares the models


class TwinField(Fields):
    """The second model. It is drawn beside the first and is part of no picture; both must agree."""

    def __init__(self, config: TwinConfig, masks: AlternatingMask) -> None:
        self.config, self.masks = config, masks
        self._second: Camera | None = None  # camera of the second model in this step

    def setup(self, data: TrainData, static: Gaussians, rates: Rates) -> Mapping[str, FieldStart]:
        self.data = data
        start = replace(static, attributes={}).clone()
        density = DensityControl(self.config.density, data.scene.extent, data.seed + 1)
        return {TWIN: FieldStart(start, rates, density, most=None)}

    def drawn(self, context: ViewContext) -> tuple[str, ...]:
        return (TWIN,)

    def regularise(self, frames: Mapping[str, Frame], context: ViewContext) -> Mapping[str, Cotangents]:
        """Return gradients of the models' difference and of the second one's loss in its own view."""
        apart = frames[STATIC].image - frames[TWIN].image
        weight = self.config.consistency if context.nominal > self.config.warm_up else 0.0
        cotangent = apart.sign() * (weight / apart.numel())
        second = -cotangent
        if context.camera is self._second:
            second = second + self._photometric(context, frames[TWIN].image)
        return {STATIC: Cotangents(image=cotangent), TWIN: Cotangents(image=second)}

    def gradients(self, step: Step, keep: Tensor | None) -> Mapping[str, Gradients]:
        """Return gradients of both models in the second view, which is drawn with replacement."""
        view = int(np.random.default_rng((self.data.seed, step.iteration)).integers(len(self.data.cameras)))
        self._second = shrink_camera(self.data.cameras[view], step.downsampling)
        photo = shrink(self.data.photos[view], step.downsampling)
        rendered = replace(step, view=view, camera=self._second, photo=photo).draw()
        gradients = rendered.backward(Cotangents(image=torch.zeros_like(rendered.image)))
        self._second = None
        # effects learn the rows of the step's photo alone; gradients of the second model are in `fields`
        return {STATIC: replace(gradients, effect_grads={})}

    def _photometric(self, context: ViewContext, image: Tensor) -> Tensor:
        """Return dL/dimage of the second model under the learnt mask of its photo; the mask learns too."""
        assert context.view is not None and context.photo is not None
        keep, user = self.masks.soft_keep(context.view, image.shape[:2]), self.data.user_keep[context.view]
        if user is not None:
            keep = keep * shrink_keep(user, context.downsampling)
        self.masks.learn_soft(context.view, image)
        return photometric(image, context.photo, keep).d_image
