"""Hooks of the training loop that a method can implement, and their arguments.

The loop is short and fixed (see `training_loop.py` and `Trainer.step`). A hook that is missing is never
called and allocates nothing.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.io.mask_reasons import MaskReasons
from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.fields import Fields
from ambiguous_wild.splat.free_space import free_space_violations
from ambiguous_wild.splat.gaussians import MIN_POINTS, Gaussians
from ambiguous_wild.splat.render import BLUR
from ambiguous_wild.splat.rendered import Cotangents, Gradients, Rendered
from ambiguous_wild.splat.step import Step, TrainData

# Share of the Gaussians that a run may have: `more_points` fill the start up to it, and more points than the
# run may have Gaussians are thinned to it. A fuller start leaves growth no room: 20.1 dB instead of 21.2 in a
# yard of 16 photos.
START_SHARE = 2 / 3

# (data, how many at most) -> xyz [M, 3] and rgb [M, 3] uint8
MorePoints = Callable[[TrainData, int], tuple[np.ndarray, np.ndarray]]
LOG = logging.getLogger(__name__)


class RenderLeaves:
    """The pictures of a render as leaves of torch's graph, each made when it is first read."""

    def __init__(self, rendered: Rendered) -> None:
        self._rendered = rendered
        self._leaves: dict[str, Tensor] = {}

    def _leaf(self, name: str) -> Tensor:
        if name not in self._leaves:
            self._leaves[name] = getattr(self._rendered, name).detach().requires_grad_()
        return self._leaves[name]

    @property
    def image(self) -> Tensor:
        """[H, W, 3] float32, not clamped."""
        return self._leaf("image")

    @property
    def alpha(self) -> Tensor:
        """[H, W] float32 in [0, 1]."""
        return self._leaf("alpha")

    @property
    def depth(self) -> Tensor:
        """[H, W] float32, sum of weight times z; divide by alpha for the expected depth."""
        return self._leaf("depth")

    def cotangents(self, loss: object, owner: str) -> Cotangents:
        """Differentiate a loss with respect to the pictures that it used.

        Raises:
            AwError: it is not one number, or does not depend on them.
        """
        leaves, gradients = list(self._leaves.values()), tuple[Tensor | None, ...]()
        if isinstance(loss, Tensor) and loss.numel() == 1 and loss.requires_grad and leaves:
            gradients = torch.autograd.grad(loss.reshape(()), leaves, allow_unused=True)
        if all(gradient is None for gradient in gradients):
            what = f"a tensor {list(loss.shape)}" if isinstance(loss, Tensor) else f"a {type(loss).__name__}"
            raise AwError(
                f"loss(render, step, keep) of {owner} gave {what}; it must give one number (a mean) computed "
                "from render.image, render.alpha or render.depth, not from step.rendered (docs/extend.md)"
            )
        by_name = dict(zip(self._leaves, gradients))
        return Cotangents(by_name.get("image"), None, by_name.get("alpha"), by_name.get("depth"))


class MaskPolicy:
    """Decides which pixels of a photo show the static scene. The base class keeps everything.

    Subclass it and override `keep`; everything else is optional. Keep maps are [H, W] float32 at the
    step's resolution, 1 = static, 0 = transient; `None` keeps every pixel.
    """

    # True: `cotangent` and `gradients` train the masks through an effect; they are no regulariser
    learns_by_gradients: ClassVar[bool] = False

    def setup(self, data: TrainData) -> None:
        """Called once before the first step (and again when a run resumes): frozen inputs, own nets."""

    def required_effect(self) -> Effect | None:
        """Return the effect of the method that the masks need; a graft without it is refused."""
        return None

    def loss_effect(self) -> Effect | None:
        """Return the effect of the method that its own losses need."""
        return self.required_effect()

    def keep(self, step: Step) -> Tensor | None:
        """Return the keep map that weights this step's loss. May train the policy's own nets."""
        return None

    def composed_keep(self, step: Step) -> Tensor | None:
        """Return the keep map for density control, where a composite picture replaces `keep` in the loss."""
        return None

    def loss(self, render: RenderLeaves, step: Step, keep: Tensor | None) -> Tensor | None:
        """Return a loss of the method's own, one number, that is added to the photo's loss.

        torch differentiates it with respect to `render.image`, `.alpha` and `.depth`, and nothing else: nets
        of the policy's own learn in `keep`. A policy that overrides `cotangent` has no `loss`.
        """
        return None

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | Tensor | None:
        """Return dL/d(picture) of the method's own losses on the step's render: `loss` without autograd.

        A tensor [H, W, 3] is the gradient to the image as a second cotangent: its screen-space gradients are
        kept apart for density control (`Cotangents.extra`).

        Raises:
            AwError: `loss` returned something else than one number that depends on the render.
        """
        if type(self).loss is MaskPolicy.loss:
            return None
        render = RenderLeaves(step.rendered)
        with torch.enable_grad():
            value = self.loss(render, step, keep)
        return None if value is None else render.cotangents(value, type(self).__name__)

    def gradients(self, step: Step, keep: Tensor | None) -> Gradients | None:
        """Return gradients of losses on further pictures (`Step.draw`); they are added to the step's."""
        return None

    def regularises(self) -> bool:
        """Whether the policy has losses of its own; a regulariser graft ignores one that has none."""
        own = type(self)
        if self.learns_by_gradients:
            return False
        return any(getattr(own, n) is not getattr(MaskPolicy, n) for n in ("loss", "cotangent", "gradients"))

    def predict(self, step: Step) -> Tensor | None:
        """Return the keep map for pictures and mask metrics: as `keep`, but nothing is learnt or cached."""
        return self.keep(step)

    def on_opacity_reset(self, step: Step) -> None:
        """Called after opacities were reset: for a while renders are no evidence."""

    def facts(self) -> Facts:
        """Return plain values for the run's metrics, e.g. the share of masked pixels."""
        return {}

    def panels(self, step: Step) -> dict[str, np.ndarray]:
        """Return pictures of what decides in this step, [H, W, 3] uint8 at the photo's size, by caption.

        Nothing is learnt or stored: a run has the same bits with and without them, which a test compares.
        """
        return {}

    def predict_with_reasons(self, step: Step) -> tuple[Tensor | None, MaskReasons | None]:
        """Return `predict` at the photo's own size, and why regions are kept or masked, if it is known."""
        return self.predict(step), None

    def explain(self, step: Step, x: int, y: int) -> list[str]:
        """Return what was measured at the pixel in column x and row y of the photo, in lines."""
        return []

    def draw(self, folder: Path) -> list[Path]:
        """Write the policy's own pictures after the last step; returns their paths."""
        return []

    def state_dict(self) -> State:
        return {}

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; exact, so that a resumed run gives the same bits."""


@dataclass(frozen=True)
class Schedule:
    """Learning rates and lengths, in nominal iterations (of 30 000)."""

    lr_means: float = 1.6e-4  # times the scene extent
    lr_means_final: float = 1.6e-6  # exponential decay to here at the end
    lr_means_final_short: float = 1.6e-5  # instead, in runs below `short_below` iterations
    lr_sh0: float = 2.5e-3
    lr_sh_rest: float = 1.25e-4
    lr_opacity: float = 0.05
    lr_scales: float = 5e-3
    lr_quats: float = 1e-3
    sh_every: float = 1000.0  # interval after which one more SH degree is used
    short_below: int = 15_000  # iterations; shorter runs use the values for short runs
    resolution: Literal["full", "coarse-to-fine"] = "full"


@dataclass(frozen=True)
class MethodHooks:
    """A method, ready to train: what fills each place of the loop."""

    mask: MaskPolicy = field(default_factory=MaskPolicy)
    density: type[DensityControl] = DensityControl
    density_config: DensityConfig = field(default_factory=DensityConfig)
    schedule: Schedule = field(default_factory=Schedule)
    lambda_dssim: float = 0.2
    weighting: Literal["map", "images"] = "map"  # how the keep map enters SSIM, see losses.photometric
    sh_degree: int = 3
    antialias: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start_opacity: float = 0.1
    start_scale: float = 1.0  # times the start size of 3DGS
    # what the user gives to start from: Gaussians, or points [M, 3] with colours [M, 3] uint8
    user_start: Gaussians | tuple[np.ndarray, np.ndarray] | None = None
    # the first Gaussians; None = one at every point of the sparse model (without those of
    # `free_space_violations`) and of `more_points`
    start: Callable[[TrainData], Gaussians] | None = None
    more_points: tuple[MorePoints, ...] = ()  # further points to start from; each fills the room that is left
    blur: float = BLUR  # px^2 added to both variances of a splat
    fields: Fields | None = None  # other fields beside the static one, see fields.py
    # returns other photos to train on (references: clean ones); None = those of the capture
    train_data: Callable[[TrainData], TrainData] | None = None
    effects: tuple[Effect, ...] = ()  # see effects/; of those that are not listed no code is reached

    def with_effect(self, effect: Effect) -> MethodHooks:
        """Return the method with the start points and the 2D filter of an added effect."""
        more = (effect.first_points,) if effect.acts("first_points") else ()
        return replace(
            self, more_points=(*self.more_points, *more), antialias=self.antialias or effect.antialias
        )

    def first_gaussians(self, data: TrainData, most: int = 0) -> Gaussians:
        """Return the Gaussians that training starts from.

        Args:
            data: training side with the sparse model.
            most: number of Gaussians that the run may have. If there are more points, two thirds of this
                number are chosen at random. 0 = all points, without `more_points`.

        Raises:
            AwError: fewer than 4 points.
        """
        if isinstance(self.user_start, Gaussians):
            rows = torch.from_numpy(start_rows(len(self.user_start), most))
            return self.user_start.select(rows).with_sh_degree(self.sh_degree).to(data.device)
        if self.start is not None and self.user_start is None:
            return self.start(data)
        if self.user_start is None:
            sparse, out = data.scene.points, free_space_violations(data)
            xyz, rgb = sparse.xyz[~out], sparse.rgb[~out]
            LOG.debug("%d of %d sparse points left out: in the free space of photos", out.sum(), len(out))
        else:
            xyz, rgb = self.user_start
        kept = start_rows(len(xyz), most)
        xyz, rgb = xyz[kept], rgb[kept]
        for points in self.more_points if len(xyz) >= MIN_POINTS else ():  # fewer are refused below
            room = int(START_SHARE * most) - len(xyz)
            if room > 0:
                more = points(data, room)
                xyz, rgb = np.concatenate([xyz, more[0]]), np.concatenate([rgb, more[1]])
        gaussians = Gaussians.from_points(
            xyz, rgb, sh_degree=self.sh_degree, opacity=self.start_opacity, device=data.device
        )
        return replace(gaussians, log_scales=gaussians.log_scales + math.log(self.start_scale))


def check_keep(keep: object, *, read: bool) -> None:
    """Raise AwError if `keep` of a mask policy returned no map, or values out of range.

    Args:
        keep: what it returned.
        read: whether its values are read; on an accelerator the host would wait.
    """
    if keep is None:
        return
    if not isinstance(keep, Tensor):
        raise AwError(
            f"keep(step) of the method's mask policy gave a {type(keep).__name__}; it must give a torch "
            "tensor [H, W], or None (docs/extend.md)"
        )
    if read:
        low, high = keep.min().item(), keep.max().item()
        if not (low >= -0.01 and high <= 1.01):  # rounding may leave the range; NaN fails both comparisons
            raise AwError(
                f"keep(step) of the method's mask policy gave values from {low:.3g} to {high:.3g}: "
                "weights of pixels lie between 0, masked, and 1, kept"
            )


def check_cotangents(value: object, step: Step) -> None:
    """Raise AwError if `cotangent` of a mask policy returned a loss, or a gradient of another shape."""
    if value is None:
        return
    shape = list(step.rendered.image.shape)
    if isinstance(value, Cotangents):
        for name, size in {"image": shape, "extra": shape, "alpha": shape[:2], "depth": shape[:2]}.items():
            tensor = getattr(value, name)
            if tensor is not None and list(tensor.shape) != size:
                raise AwError(
                    f"cotangent(step, keep) of the method's mask policy gave {name} {list(tensor.shape)}; it "
                    f"must be {size}"
                )
        return
    if not isinstance(value, Tensor) or list(value.shape) != shape:
        what = f"a tensor {list(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
        raise AwError(
            f"cotangent(step, keep) of the method's mask policy gave {what}; it must give a gradient, "
            f"{shape}; return a loss from loss(render, step, keep) instead (docs/extend.md)"
        )


def start_rows(count: int, most: int) -> np.ndarray:
    """Return the rows of `count` points that a run starts from, for at most `most` Gaussians; 0 = all."""
    if not most or count <= most:
        return np.arange(count)
    # chosen at random: points of a scan have no tracks that would show which of them matter
    chosen = np.random.default_rng(0).choice(count, max(int(START_SHARE * most), MIN_POINTS), replace=False)
    return np.sort(chosen)
