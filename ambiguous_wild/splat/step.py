"""Arguments of the training loop's parts: the training side of the scene, a view context, one step."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera, Scene
from ambiguous_wild.core.scene import NO_PHOTO
from ambiguous_wild.splat.backend import Backend, backend_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import Rendered
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS


@dataclass(frozen=True)
class TrainData:
    """The training side of the scene. A method gets test views without photo and mask, see `for_method`."""

    scene: Scene
    photos: Sequence[Tensor]  # one for each train view: [H, W, 3] float32 in [0, 1], sRGB, on `device`
    cameras: list[Camera]  # one for each train view, of the size of its photo
    # [H, W] float32, 1 = static; the capture's own masks, with what was corrected by hand
    user_keep: Sequence[Tensor | None]
    device: torch.device
    seed: int
    cache_dir: Path  # features and instance masks that survive the run; shared between runs
    # [H, W] float32, marked by hand: 1 = static, -1 = distractor, 0 = as masks say; empty = no photo was
    by_hand: Sequence[Tensor | None] = ()

    @property
    def backend(self) -> Backend:
        """The back end that computes on `device`."""
        return backend_of(self.device)

    def for_method(self) -> TrainData:
        """Return the data whose test views have cameras alone."""
        shown = (
            view if view.split == "train" else replace(view, image_path=NO_PHOTO, keep_path=None)
            for view in self.scene.views
        )
        return replace(self, scene=replace(self.scene, views=tuple(shown)))

    @property
    def sfm_points(self) -> Tensor:
        """Points of the sparse model, [M, 3] float32 on `device`; training may start from more."""
        return torch.from_numpy(self.scene.points.xyz.astype(np.float32)).to(self.device)


@dataclass(frozen=True, kw_only=True)
class ViewContext:
    """View, camera, photo and time of one picture; every hook gets a view context."""

    iteration: int  # counts from 1; 0 while a test photo is fitted
    nominal: float  # progress of the run times NOMINAL_ITERATIONS, the unit of schedules
    view: int | None  # index into TrainData.photos; None for any other camera
    camera: Camera  # at the resolution of the picture
    photo: Tensor | None = None  # [H, W, 3] at that resolution; None if the picture has no photo
    downsampling: int = 1  # factor of the resolution schedule: the photo's size over the picture's
    fitting: bool = False  # a test photo is fitted; `photo` is black outside of the part to fit to
    other_gaussians: bool = False  # Gaussians of a method are drawn instead of the model
    progress: float = -1.0  # share of the run that is done, in [0, 1]

    def __post_init__(self) -> None:
        if self.progress < 0:
            object.__setattr__(self, "progress", self.nominal / NOMINAL_ITERATIONS)

    @property
    def divisor(self) -> NoReturn:
        raise AwError("step.divisor is step.downsampling now")

    @property
    def neutral(self) -> bool:
        """Whether the picture is drawn without the light and exposure of a photo."""
        return self.view is None and not self.fitting

    def row(self, photos: int) -> int | None:
        """Return the row in a table of train photos, with a last one for a test photo; None if neutral."""
        return photos if self.fitting else self.view


# draws Gaussians for a view context, without the effects that the last argument names
Drawer = Callable[[Gaussians, ViewContext, Collection[str]], Rendered]


@dataclass(frozen=True, kw_only=True)
class Step(ViewContext):
    """One training step, after the render and before the loss."""

    view: int
    photo: Tensor
    growth_cap: int  # growth stops at this many Gaussians now (count schedule)
    rendered: Rendered
    gaussians: Gaussians
    drawer: Drawer | None = field(default=None, repr=False)

    def draw(
        self,
        camera: Camera | None = None,
        gaussians: Gaussians | None = None,
        *,
        without: Collection[str] = (),
    ) -> Rendered:
        """Draw another picture of this step, with the run's effects, SH degree, background and filter.

        Args:
            camera: camera, which effects do not change; None = the step's.
            gaussians: Gaussians to draw alone; None = the model, with the other fields of the view.
            without: names of effects that are left out.

        Raises:
            RuntimeError: the step was made without a trainer.
        """
        if self.drawer is None:
            raise RuntimeError("this step belongs to no trainer: it cannot draw")
        context: Any = self if camera is None else replace(self, camera=camera)
        return self.drawer(self.gaussians if gaussians is None else gaussians, context, without)
