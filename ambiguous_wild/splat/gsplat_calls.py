"""The calls of gsplat that draw a picture, and the only module that imports it.

They were checked against the source of release 1.5.3 (`readiness.GSPLAT`).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import install_command
from ambiguous_wild.splat.gpu_kernels import compensation

NEAR = 0.01  # world units, as on the CPU
BLUR = 0.3  # px^2, as on the CPU
TILE = 16  # px


@dataclass(frozen=True)
class ProjectedGaussians:
    """N Gaussians projected for one camera, before blending. All but `radii` have gradients."""

    radii: Tensor  # [N, 2] int32 px along x and y; 0 where culled
    means2d: Tensor  # [N, 2] px
    depths: Tensor  # [N]
    conics: Tensor  # [N, 3] a, b, c of the inverse covariance
    opacities: Tensor  # [N], antialiasing included


@dataclass(frozen=True)
class Tiles:
    """The splats of every tile, ordered by depth."""

    offsets: Tensor  # [1, rows, columns] int32
    flatten_ids: Tensor  # [intersections] int32


@functools.cache
def gsplat() -> Any:
    """Return the installed package.

    Raises:
        AwError: it is not installed; the message holds the command that installs it.
    """
    try:
        import gsplat
    except ImportError:
        raise AwError(
            f"the Gaussians are on a GPU and gsplat is not installed: {install_command('cuda')}, "
            "or run with --device cpu"
        ) from None
    return gsplat


@functools.cache
def max_alpha(device: str = "cuda") -> float:
    """Return the value at which gsplat clamps alpha: 0.999 in release 1.5.3, 0.99 in later sources.

    Later sources have the same version number, so the value is measured: one picture of an opaque Gaussian in
    front of one pixel. The CPU clamps at 0.99; only opacities above it are drawn differently.
    """
    one = torch.ones(1, device=device)
    pose, k = torch.eye(4, device=device)[None], torch.eye(3, device=device)[None]
    k[0, :2, 2] = 0.5
    means, centre = torch.tensor([[0.0, 0.0, 1.0]], device=device), torch.zeros(3, device=device)
    quats, scales = torch.tensor([[1.0, 0.0, 0.0, 0.0]], device=device), torch.ones(1, 3, device=device)
    splats = project(means, quats, scales, one, pose, k, 1, 1, antialias=False)
    colours = shade(1, means, centre, torch.ones(1, 4, 3, device=device), splats.radii[:, 0] > 0)
    _, alpha, _ = blend(splats.means2d, splats.conics, colours, splats.opacities, sort(splats, 1, 1), 1, 1)
    return round(float(alpha), 4)


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmat: Tensor,  # [1, 4, 4] cam_from_world
    intrinsics: Tensor,  # [1, 3, 3]
    width: int,
    height: int,
    *,
    antialias: bool,
    blur: float = BLUR,  # px^2 added to both variances
) -> ProjectedGaussians:
    """Project by EWA and cull; differentiable."""
    if not len(means):  # gsplat's C++ code divides by their number, which would end the process
        none = means.new_zeros((0, 2), dtype=torch.int32)
        return ProjectedGaussians(none, means[:, :2], means[:, 2], scales, opacities)
    if antialias:
        size = size_on(width, height, means.device)
        opacities = opacities * compensation(means, quats, scales, viewmat, intrinsics, size, blur)
    radii, means2d, depths, conics, _ = gsplat().fully_fused_projection(
        means=means,
        covars=None,
        quats=quats,
        scales=scales,
        viewmats=viewmat,
        Ks=intrinsics,
        width=width,
        height=height,
        eps2d=blur,
        near_plane=NEAR,
        packed=False,
        calc_compensations=False,
        opacities=opacities.detach(),
    )
    return ProjectedGaussians(radii[0], means2d[0], depths[0], conics[0], opacities)


@functools.cache
def size_on(width: int, height: int, device: torch.device) -> Tensor:
    """Return the size [2] float32, copied once: a copy in every step would make the host wait."""
    return torch.tensor([width, height], dtype=torch.float32).to(device)


def shade(
    degree: int,
    means: Tensor,  # [N, 3]
    centre: Tensor,  # [3] of the camera
    coefficients: Tensor,  # [N, K, 3], K at least (degree + 1)^2
    visible: Tensor,  # [N] bool; other rows may get any colour
) -> Tensor:
    """Return colours [N, 3] of spherical harmonics, without the offset 0.5; differentiable."""
    colours: Tensor = gsplat().spherical_harmonics(degree, means - centre, coefficients, masks=visible)
    return colours


def sort(splats: ProjectedGaussians, width: int, height: int) -> Tiles:
    """List the splats of every tile by depth. The host waits for their number, to allocate memory."""
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    _, ids, flatten_ids = gsplat().isect_tiles(
        splats.means2d.detach()[None],
        splats.radii[None],
        splats.depths.detach()[None],
        TILE,
        columns,
        rows,
        packed=False,
    )
    return Tiles(gsplat().isect_offset_encode(ids, 1, columns, rows), flatten_ids)


def blend(
    means2d: Tensor,  # [N, 2]
    conics: Tensor,  # [N, 3]
    colours: Tensor,  # [N, C]
    opacities: Tensor,  # [N]
    tiles: Tiles,
    width: int,
    height: int,
    *,
    background: Tensor | None = None,  # [1, C]
    absolute: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a picture [H, W, C], alpha [H, W], and the tensor for `absolute_gradient`; differentiable.

    Args:
        absolute: let the backward pass also sum absolute values over pixels (AbsGS).
    """
    batch = means2d[None]
    picture, alpha = gsplat().rasterize_to_pixels(
        batch,
        conics[None],
        colours[None],
        opacities[None],
        width,
        height,
        TILE,
        tiles.offsets,
        tiles.flatten_ids,
        backgrounds=background,
        packed=False,
        absgrad=absolute,
    )
    return picture[0], alpha[0, ..., 0], batch


def absolute_gradient(batch: Tensor) -> Tensor:
    """Return sums over pixels of |dL/du| and |dL/dv|, [N, 2], after the backward pass of `blend`."""
    sums: Tensor = batch.absgrad[0]  # type: ignore[attr-defined]  # gsplat stores it on its argument
    return sums
