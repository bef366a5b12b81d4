"""The places of the training loop a method can fill, and what each is shown.

The loop is short and fixed (see `trainer.py`). A method is a set of parts that fill its places; a part
that is not there is never called and allocates nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.splat.density import DensityConfig, DensityControl
from ambiguous_wild.splat.effects.base import Effect
from ambiguous_wild.splat.fields import Fields
from ambiguous_wild.splat.gaussians import LEAST_POINTS, Gaussians
from ambiguous_wild.splat.render import BLUR
from ambiguous_wild.splat.rendered import Cotangents, Gradients
from ambiguous_wild.splat.step import Step, TrainData

# of the Gaussians that a run may have; `more_points` fill the start up to it, and more points than
# the run may have are thinned to it. With more, growth has no room:
# 20.1 dB instead of 21.2 in a yard of 16 photos
START_SHARE = 2 / 3

# (data, how many at most) -> xyz [M, 3] and rgb [M, 3] uint8
MorePoints = Callable[[TrainData, int], tuple[np.ndarray, np.ndarray]]
State = dict[str, Any]  # nested dicts of tensors and plain values, see checkpoint.py


class MaskPolicy:
    """Decides which pixels of a photo show the static scene. This one keeps everything.

    Subclass it and override `keep`; everything else is optional. Keep maps are [H, W] float32 at the
    step's resolution, 1 = static, 0 = transient; `None` means all of it.
    """

    # its masks learn by `cotangent` and `gradients`, with an effect of its method: no losses of a regulariser
    learns_by_gradients: ClassVar[bool] = False

    def setup(self, data: TrainData) -> None:
        """Called once before the first step (and again when a run resumes): frozen inputs, own nets."""

    def required_effect(self) -> Effect | None:
        """The effect of its method that it cannot work without; a graft that lacks it is refused."""
        return None

    def loss_effect(self) -> Effect | None:
        """The effect of its method that its own losses cannot work without."""
        return self.required_effect()

    def keep(self, step: Step) -> Tensor | None:
        """The keep map that weighs this step's loss. May train nets of its own."""
        return None

    def composed_keep(self, step: Step) -> Tensor | None:
        """For density control, where a composite weighs the loss and `keep` gives None: its keep map."""
        return None

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | Tensor | None:
        """dL/d(picture) of losses of the method's own on the step's render.

        A tensor [H, W, 3] is that of the image, kept apart for density control (`Cotangents.extra`).
        """
        return None

    def gradients(self, step: Step, keep: Tensor | None) -> Gradients | None:
        """Gradients of losses on other pictures of the static field (`Step.draw`), added to the step's."""
        return None

    def regularises(self) -> bool:
        """Whether the policy has losses of its own; where not, a graft leaves it out altogether."""
        own = type(self)
        if self.learns_by_gradients:
            return False
        return own.cotangent is not MaskPolicy.cotangent or own.gradients is not MaskPolicy.gradients

    def predict(self, step: Step) -> Tensor | None:
        """The keep map for pictures and mask metrics: as `keep`, but nothing is learnt or cached."""
        return self.keep(step)

    def on_opacity_reset(self, step: Step) -> None:
        """Opacities were just clamped: renders mean little for a while."""

    def facts(self) -> dict[str, Any]:
        """Plain values worth a line in the run's metrics, e.g. the share of pixels masked."""
        return {}

    def panels(self, step: Step) -> dict[str, np.ndarray]:
        """Pictures of what the policy sees in this step, [H, W, 3] uint8 at the photo's size, by caption.

        Nothing is learnt or kept: a run is the same with and without them (a test compares the bits).
        """
        return {}

    def draw(self, folder: Path) -> list[Path]:
        """Write pictures of one's own after the last step; returns what was written."""
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
    sh_every: float = 1000.0  # one SH degree more each
    short_below: int = 15_000  # iterations; a run of fewer uses the short-run values
    per_pixel_short: float = 1.0  # Gaussians per pixel of a photo at most, in short runs
    resolution: Literal["full", "coarse-to-fine"] = "full"


@dataclass(frozen=True)
class Parts:
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
    start_scale: float = 1.0  # times 3DGS's
    # what training starts from instead: Gaussians, or points [M, 3] and colours [M, 3] uint8, where the user
    # gives them
    given: Gaussians | tuple[np.ndarray, np.ndarray] | None = None
    # the first Gaussians; None = one at every point of the sparse model and of `more_points`
    start: Callable[[TrainData], Gaussians] | None = None
    more_points: tuple[MorePoints, ...] = ()  # further points to start from; each gets the room that is left
    blur: float = BLUR  # px^2 added to both variances of a splat
    fields: Fields | None = None  # other fields beside the static one, see fields.py
    # trains on something else than the capture's photos (references on clean ones); None = the capture
    train_data: Callable[[TrainData], TrainData] | None = None
    effects: tuple[Effect, ...] = ()  # optional ones, see effects/; none = that code is never reached

    def suited_to(self, effect: Effect) -> Parts:
        """The method with what an effect that is added to it needs: points to start from, the 2D filter."""
        more = (effect.first_points,) if effect.acts("first_points") else ()
        return replace(
            self, more_points=(*self.more_points, *more), antialias=self.antialias or effect.antialias
        )

    def first_gaussians(self, data: TrainData, most: int = 0) -> Gaussians:
        """What training starts from.

        Args:
            data: with the sparse model.
            most: Gaussians that the run may have: of more points, two thirds of it are chosen at random;
                0 = all points, and no `more_points`.

        Raises:
            AwError: fewer than 4 points.
        """
        if isinstance(self.given, Gaussians):
            rows = torch.from_numpy(thinned(len(self.given), most))
            return self.given.select(rows).of_degree(self.sh_degree).to(data.device)
        if self.start is not None and self.given is None:
            return self.start(data)
        xyz, rgb = self.given or (data.scene.points.xyz, data.scene.points.rgb)
        kept = thinned(len(xyz), most)
        xyz, rgb = xyz[kept], rgb[kept]
        for points in self.more_points if len(xyz) >= LEAST_POINTS else ():  # else refused below
            room = int(START_SHARE * most) - len(xyz)
            if room > 0:
                more = points(data, room)
                xyz, rgb = np.concatenate([xyz, more[0]]), np.concatenate([rgb, more[1]])
        found = Gaussians.from_points(
            xyz, rgb, sh_degree=self.sh_degree, opacity=self.start_opacity, device=data.device
        )
        return replace(found, log_scales=found.log_scales + math.log(self.start_scale))


def thinned(count: int, most: int) -> np.ndarray:
    """Rows of so many points that a run starts from, if it may have `most` Gaussians; 0 = all."""
    if not most or count <= most:
        return np.arange(count)
    # an even choice: the points of a scan have no tracks that tell which of them matter
    chosen = np.random.default_rng(0).choice(count, max(int(START_SHARE * most), LEAST_POINTS), replace=False)
    return np.sort(chosen)
