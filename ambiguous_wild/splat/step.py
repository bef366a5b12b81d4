"""What a part of the training loop is shown: the training side of the scene, a shot, and one step."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera, Scene
from ambiguous_wild.splat.backend import Backend, backend_of
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import Rendered

NOMINAL_ITERATIONS = 30_000  # every schedule is written for this length and scales with the run


@dataclass(frozen=True)
class TrainData:
    """What every part may look at: the training side of the scene, never the test side."""

    scene: Scene
    photos: Sequence[Tensor]  # of the train views: [H, W, 3] float32 in [0, 1], sRGB, on `device`
    cameras: list[Camera]  # of the train views, matching the photos
    user_keep: list[Tensor | None]  # [H, W] float32, 1 = static; the capture's own masks
    device: torch.device
    seed: int
    cache_dir: Path  # features and instance masks that survive the run; shared between runs

    @property
    def backend(self) -> Backend:
        """What computes there."""
        return backend_of(self.device)

    @property
    def sfm_points(self) -> Tensor:
        """[M, 3] float32 on `device`: where the scene is, whatever else training starts from."""
        return torch.from_numpy(self.scene.points.xyz.astype(np.float32)).to(self.device)


@dataclass(frozen=True, kw_only=True)
class Shot:
    """For whom and when a picture is drawn; every hook gets one."""

    iteration: int  # counts from 1; 0 while a test photo is fitted
    nominal: float  # progress of the run times NOMINAL_ITERATIONS: the unit schedules are written in
    view: int | None  # index into TrainData.photos; None for any other camera
    camera: Camera  # at the resolution of the picture
    photo: Tensor | None = None  # [H, W, 3] at that resolution; None where there is none
    divisor: int = 1  # image side is the photo's divided by this (resolution schedule)
    fitting: bool = False  # a test photo is fitted: `photo` is black outside of the part that may be read
    other_gaussians: bool = False  # not the model is drawn, but Gaussians that a method gave
    progress: float = -1.0  # of the run, in [0, 1]

    def __post_init__(self) -> None:
        if self.progress < 0:
            object.__setattr__(self, "progress", self.nominal / NOMINAL_ITERATIONS)

    @property
    def neutral(self) -> bool:
        """Whether no photo's own light or exposure belongs to the picture."""
        return self.view is None and not self.fitting

    def row(self, photos: int) -> int | None:
        """Row of a table with one row a train photo and a last one for a test photo; None if neutral."""
        return photos if self.fitting else self.view


# draws Gaussians for a shot; the last argument names effects that are left out
Drawer = Callable[[Gaussians, Shot, Collection[str]], Rendered]


@dataclass(frozen=True, kw_only=True)
class Step(Shot):
    """One training step, after the render and before the loss."""

    view: int
    photo: Tensor
    ceiling: int  # growth stops at this many Gaussians now (count schedule)
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
        """Another picture of this step, as the host draws: its effects, SH degree, background and filter.

        Args:
            camera: taken as it is; None = the step's.
            gaussians: None = the model's, with the other fields of the view; others are drawn alone.
            without: names of effects that are left out.

        Raises:
            RuntimeError: the step was made by hand, without a trainer.
        """
        if self.drawer is None:
            raise RuntimeError("this step belongs to no trainer: it cannot draw")
        shot: Any = self if camera is None else replace(self, camera=camera)
        return self.drawer(self.gaussians if gaussians is None else gaussians, shot, without)
