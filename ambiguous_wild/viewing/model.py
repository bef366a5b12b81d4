"""A trained model as it is shown, and the call that renders it as its run did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.io.images import to_uint8
from ambiguous_wild.io.ply import read_splat_ply, splat_count

Arrays = Mapping[str, np.ndarray]  # raw parameters, see `io.ply.read_splat_ply`


@dataclass(frozen=True)
class Look:
    """How a method draws its Gaussians."""

    sh_degree: int = 3
    antialias: bool = False  # Mip-Splatting's 2D filter
    blur: float = 0.3  # px^2 added to both variances of a splat
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Model:
    """One method's model of a scene."""

    label: str  # unique among the models that are shown together
    ply: Path
    look: Look = field(default_factory=Look)
    psnr: Mapping[str, float] = field(default_factory=dict)  # dB by name of the test view
    masks: Path | None = None  # folder of keep maps of train views, white = keep

    def read(self) -> dict[str, np.ndarray]:
        """The Gaussians.

        Raises:
            AwError: no splat PLY.
        """
        return read_splat_ply(self.ply)

    @property
    def count(self) -> int:
        """Number of Gaussians, from the file's header."""
        return splat_count(self.ply)


class Renderer:
    """Renders one model on the CPU, with the kernels it was trained with."""

    def __init__(self, gaussians: Arrays, look: Look) -> None:
        """
        Args:
            gaussians: raw parameters; of none nothing can be drawn.
            look: how they are drawn.

        Raises:
            AwError: there is no Gaussian.
        """
        import torch

        from ambiguous_wild.splat.gaussians import PARAMETERS, Gaussians

        if not len(gaussians["means"]):
            raise AwError("the model has no Gaussian: there is nothing to draw")
        tensors: dict[str, Any] = {
            name: torch.from_numpy(np.array(gaussians[name], np.float32)) for name in PARAMETERS
        }
        self._gaussians = Gaussians(**tensors)
        self._look = look

    def __call__(self, camera: Camera) -> np.ndarray:  # [H, W, 3] uint8
        """The picture that a camera sees, as a run writes it to PNG."""
        import torch

        from ambiguous_wild.splat.render import render

        look = self._look
        with torch.no_grad():
            drawn = render(
                self._gaussians,
                camera,
                sh_degree=min(look.sh_degree, self._gaussians.sh_degree),
                background=look.background,
                antialias=look.antialias,
                blur=look.blur,
            )
        return to_uint8(drawn.image.numpy())
