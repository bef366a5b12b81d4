"""What a part of the training loop is shown: the training side of the scene, and one step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ambiguous_wild.core import Camera, Scene
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


@dataclass(frozen=True)
class Step:
    """One training step, after the render and before the loss."""

    iteration: int  # counts from 1
    nominal: float  # progress of the run times NOMINAL_ITERATIONS: the unit schedules are written in
    view: int  # index into TrainData.photos
    divisor: int  # image side is the photo's divided by this (resolution schedule)
    ceiling: int  # growth stops at this many Gaussians now (count schedule)
    photo: Tensor  # [H, W, 3] at the resolution of this step
    camera: Camera  # at the resolution of this step
    rendered: Rendered
    gaussians: Gaussians
