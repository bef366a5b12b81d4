"""The calls of gsplat that a picture is made of, whichever of its versions is installed.

No other module imports gsplat. Differences between its versions are handled here.
"""

from __future__ import annotations

import functools
import importlib.util
import inspect
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.extras import install_command
from ambiguous_wild.splat.gpu.footprint import compensation

NEAR = 0.01  # world units, as on the CPU
BLUR = 0.3  # px^2, as on the CPU
TILE = 16  # px
TESTED = "1.5.3"  # the release that was read line by line


@dataclass(frozen=True)
class Splats:
    """N Gaussians projected for one camera, before blending. All but `radii` have gradients."""

    radii: Tensor  # [N, 2] int32 px along x and y; 0 where culled
    means2d: Tensor  # [N, 2] px
    depths: Tensor  # [N]
    conics: Tensor  # [N, 3] a, b, c of the inverse covariance
    opacities: Tensor  # [N], antialiasing included


@dataclass(frozen=True)
class Tiles:
    """The splats of every tile, ordered by depth."""

    offsets: Tensor  # [1, rows, columns] int32, or with one more row
    flatten_ids: Tensor  # [intersections] int32
    over: Tensor | None = None  # [1] float32, 1 = the lists are too short; None = they cannot be


@functools.cache
def gsplat() -> Any:
    """The installed package.

    Raises:
        AwError: there is none; says the command that installs it.
    """
    try:
        import gsplat
    except ImportError:
        raise AwError(
            f"the Gaussians are on a GPU and gsplat is not installed: {install_command('cuda')}, "
            "or run with --device cpu"
        ) from None
    if torch.cuda.is_available():
        _use_own_build(gsplat)
    return gsplat


def _use_own_build(gsplat: Any) -> None:
    """Let gsplat call the kernels that we compiled of its sources; it looks for `gsplat.csrc` first."""
    from ambiguous_wild.splat.gpu import gsplat_cut
    from ambiguous_wild.splat.gpu.gsplat_build import kernels_folder

    package = Path(gsplat.__file__).parent
    if importlib.util.find_spec("gsplat.csrc") is not None:
        return
    folder = gsplat_cut.folder_of(package, kernels_folder(torch.version.cuda))
    if folder is not None and gsplat_cut.is_complete(folder):
        gsplat_cut.use(folder)


@functools.cache
def ready(kind: str) -> None:
    """Raise AwError, with what to do, where gsplat cannot compute on devices of this kind."""
    gsplat()
    if kind == "cuda":
        from ambiguous_wild.splat.gpu.readiness import look, why_not

        lack = why_not(look())
        if lack is not None:
            raise AwError(f"gsplat cannot use the GPU: {lack}")


def version() -> str:
    """Of the installed gsplat."""
    return str(gsplat().__version__)


@functools.cache
def max_alpha(device: str = "cuda") -> float:
    """Where alpha is clamped: 0.99 as on the CPU, but 0.999 up to release 1.5.3.

    The constant is compiled into the kernels, and sources after that release have the same version number.
    So it is measured: an opaque splat is drawn over one pixel. The clamp matters only for Gaussians with an
    opacity above 0.99, and changes how much light passes through them.
    """
    one = torch.ones(1, device=device)
    means2d, conics = 0.5 * one.expand(1, 2), torch.tensor([[1.0, 0.0, 1.0]], device=device)
    splats = Splats(one.expand(1, 2).to(torch.int32), means2d, one, conics, one)
    tiles = sort(splats, 1, 1)
    _, alpha, _ = blend(means2d, conics, one[:, None], one, tiles, 1, 1)
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
) -> Splats:
    """EWA projection and culls; differentiable."""
    if not len(means):  # gsplat divides by their number, in C++: the process would end
        none = means.new_zeros((0, 2), dtype=torch.int32)
        return Splats(none, means[:, :2], means[:, 2], scales, opacities)
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
    return Splats(radii[0], means2d[0], depths[0], conics[0], opacities)


@functools.cache
def size_on(width: int, height: int, device: torch.device) -> Tensor:
    """[2] float32; copied once: a copy from the host in every step would make it wait."""
    return torch.tensor([width, height], dtype=torch.float32).to(device)


def shade(
    degree: int,
    means: Tensor,  # [N, 3]
    viewmat: Tensor,  # [1, 4, 4] cam_from_world
    centre: Tensor,  # [3] of that camera
    coefficients: Tensor,  # [N, K, 3], K at least (degree + 1)^2
    visible: Tensor,  # [N] bool; the others' colours may be anything
) -> Tensor:
    """Colours [N, 3] of spherical harmonics, 0.5 not added; differentiable.

    Raises:
        AwError: the installed version takes other arguments than those that are known.
    """
    call = gsplat().spherical_harmonics
    if _takes_cameras():
        found = call(degree, means=means, viewmats=viewmat, coeffs=coefficients)
        return found.reshape(len(means), coefficients.shape[2])
    return call(degree, means - centre, coefficients, masks=visible)


@functools.cache
def _takes_cameras() -> bool:
    """Whether gsplat makes the directions itself, of means and cameras: after 1.5.3 (pull 1048)."""
    names = list(inspect.signature(gsplat().spherical_harmonics).parameters)
    if {"means", "viewmats", "coeffs"} <= set(names):
        return True
    if names[1:3] == ["dirs", "coeffs"]:
        return False
    raise AwError(
        f"gsplat {version()} is not known here: its spherical_harmonics takes ({', '.join(names)}); "
        f"install the tested version: pip install 'gsplat=={TESTED}'"
    )


def sort(splats: Splats, width: int, height: int) -> Tiles:
    """Tiles and order. The host waits here for their number, which decides how much memory is allocated."""
    columns, rows = math.ceil(width / TILE), math.ceil(height / TILE)
    finer = {}
    if _tests_tiles_by_ellipse():
        finer = {"conics": splats.conics.detach()[None], "opacities": splats.opacities.detach()[None]}
    _, ids, flatten_ids = gsplat().isect_tiles(
        splats.means2d.detach()[None],
        splats.radii[None],
        splats.depths.detach()[None],
        TILE,
        columns,
        rows,
        packed=False,
        **finer,
    )
    return Tiles(gsplat().isect_offset_encode(ids, 1, columns, rows), flatten_ids)


@functools.cache
def _tests_tiles_by_ellipse() -> bool:
    """Whether gsplat can leave out tiles that a splat's box touches and its ellipse does not: after 1.5.3."""
    return "conics" in inspect.signature(gsplat().isect_tiles).parameters


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
    """Pictures [H, W, C], alpha [H, W], and the tensor for `absolute_gradient`; differentiable.

    Args:
        absolute: the backward pass also sums absolute values over pixels (AbsGS).
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
    """Sums over pixels of |dL/du| and |dL/dv|, [N, 2], after the backward pass of `blend(absolute=True)`.

    A copy: after 1.5.3 a second backward pass overwrites them in place.
    """
    return batch.absgrad[0].clone()  # type: ignore[attr-defined]  # gsplat stores it on its argument
