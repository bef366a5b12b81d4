"""The model: N anisotropic Gaussians as raw (unactivated) parameters, one torch tensor each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.neighbours import nearest_three

SH_C0 = 0.28209479177387814  # zeroth real spherical harmonic, 1 / (2 sqrt(pi))


@dataclass
class Gaussians:
    """Raw parameters, all float32 on one device; activations happen inside the renderer.

    covariance = R(quats / |quats|) diag(exp(log_scales))^2 R^T, opacity = sigmoid(opacity_logits),
    colour = max(SH(direction) + 0.5, 0).
    """

    means: Tensor  # [N, 3] world
    quats: Tensor  # [N, 4] w, x, y, z; any positive norm
    log_scales: Tensor  # [N, 3]
    opacity_logits: Tensor  # [N]
    sh0: Tensor  # [N, 3] coefficient of the constant harmonic
    sh_rest: Tensor  # [N, (D + 1)^2 - 1, 3] the others, D = largest degree (0 to 3)

    # Set on an instance by an optimiser that postpones updates of rows nobody sees: the renderer calls it
    # with the rows about to be drawn before it reads their harmonics. Copies do not carry it.
    before_colours: ClassVar[Any] = None

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {
            "means": (n, 3),
            "quats": (n, 4),
            "log_scales": (n, 3),
            "opacity_logits": (n,),
            "sh0": (n, 3),
        }
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise AwError(f"{name} must be {list(shape)}, got {list(getattr(self, name).shape)}")
        rest = tuple(self.sh_rest.shape)
        if len(rest) != 3 or rest[0] != n or rest[1] not in (0, 3, 8, 15) or rest[2] != 3:
            raise AwError(f"sh_rest must be [{n}, 0|3|8|15, 3], got {list(rest)}")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def device(self) -> torch.device:
        return self.means.device

    @property
    def sh_degree(self) -> int:
        """Largest SH degree the parameters can hold."""
        return round((self.sh_rest.shape[1] + 1) ** 0.5) - 1

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """(name, tensor) in a fixed order."""
        for f in fields(self):
            yield f.name, getattr(self, f.name)

    def select(self, rows: Tensor) -> Gaussians:
        """The rows given by a bool mask [N] or an index tensor, copied."""
        return Gaussians(**{name: tensor[rows].contiguous() for name, tensor in self.items()})

    def cat(self, other: Gaussians) -> Gaussians:
        """These rows followed by the other's."""
        return Gaussians(
            **{name: torch.cat([tensor, getattr(other, name)]).contiguous() for name, tensor in self.items()}
        )

    def to(self, device: torch.device | str) -> Gaussians:
        return Gaussians(**{name: tensor.to(device).contiguous() for name, tensor in self.items()})

    def clone(self) -> Gaussians:
        return Gaussians(**{name: tensor.clone() for name, tensor in self.items()})

    @classmethod
    def from_points(
        cls,
        xyz: np.ndarray,  # [M, 3]
        rgb: np.ndarray,  # [M, 3] uint8
        *,
        sh_degree: int = 3,
        opacity: float = 0.1,
        min_scale: float = 1e-7,
        device: torch.device | str = "cpu",
    ) -> Gaussians:
        """3DGS's start: one isotropic Gaussian a point, as large as its three neighbours are far.

        Args:
            xyz: points, world.
            rgb: their colours, uint8.
            sh_degree: largest SH degree to hold, 0 to 3.
            opacity: of every Gaussian.
            min_scale: floor of the scale, so that coincident points stay finite.
            device: where neighbours are looked for and the Gaussians lie.

        Raises:
            AwError: fewer than 4 points.
        """
        if len(xyz) < 4:
            raise AwError(
                f"cannot start from {len(xyz)} points: at least 4 are needed; check the sparse model"
            )
        distances = nearest_three(xyz, device)
        scale = np.sqrt((distances**2).mean(axis=1)).clip(min=min_scale)
        n = len(xyz)
        quats = torch.zeros(n, 4)
        quats[:, 0] = 1.0
        rest = (sh_degree + 1) ** 2 - 1
        return cls(
            means=torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float32)),
            quats=quats,
            log_scales=torch.from_numpy(np.log(scale).astype(np.float32))[:, None].repeat(1, 3).contiguous(),
            opacity_logits=torch.full((n,), float(np.log(opacity / (1 - opacity)))),
            sh0=torch.from_numpy(((rgb.astype(np.float64) / 255.0 - 0.5) / SH_C0).astype(np.float32)),
            sh_rest=torch.zeros(n, rest, 3),
        ).to(device)
