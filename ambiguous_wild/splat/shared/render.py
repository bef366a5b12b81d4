"""The render call of several GPUs: every rank at once, each for a camera of its own.

Every rank projects and shades its own Gaussians for every camera; the splats travel to the rank whose camera
it is, which sorts and blends all of them. Gradients of the splats travel back the same way.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat import gsplat_seam as seam
from ambiguous_wild.splat.cuda import RenderedCuda, background_on, colours_of, on_device
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.shared.exchange import exchange
from ambiguous_wild.splat.shared.ranks import Ranks

# Columns of a splat on its way: u v, conic, colour, opacity, depth; and the two radii as their bits.
_WIDTHS = (2, 3, 3, 1, 1, 2)


class SharedRendered(RenderedCuda):
    """The picture of this rank's camera, and what all cameras saw of this rank's Gaussians.

    `visible`, `radii` and the gradients are of the rank's own Gaussians; `backward` is called by all at once.
    """

    def __init__(
        self,
        leaves: dict[str, Tensor],
        sent: Tensor,  # [C * n, 12]
        received: Tensor,  # [sum of all counts, 12]
        radii: Tensor,  # [C, n, 2] int32 px
        camera: Camera,
        background: tuple[float, float, float],
        rank: int,
    ) -> None:
        """
        Args:
            leaves: raw parameters of this rank's n Gaussians.
            sent: their splats in each of C cameras.
            received: splats of all ranks in this rank's camera.
            radii: of what was sent.
            camera: this rank's.
            background: colour.
            rank: this rank, and the place of its camera.
        """
        splats, colours = _unpacked(received)
        size = (camera.width, camera.height)
        tiles = seam.sort(splats, *size)
        super().__init__(leaves, splats, colours, tiles, background_on(background, received.device), size)
        self._rank, self._cameras, self._radii = rank, len(radii), radii
        self._seen = (radii > 0).all(dim=2)
        # Not a method of this object: graph and object would hold each other, and what they hold, for ever.
        self._came_back: list[Tensor] = []
        if sent.requires_grad:
            sent.register_hook(self._came_back.append)
        self._show(rank)

    @property
    def screens(self) -> Tensor:
        """[C, n, 2] dL/d(u, v) in 1/px of this rank's Gaussians in each camera; after `backward`."""
        return self._came_back[0][:, :2].reshape(self._cameras, -1, 2)

    def seen_by(self, camera: int) -> SharedRendered:
        """The same with `visible` and `radii` of that camera."""
        other = copy.copy(self)
        other._show(camera)
        return other

    def backward(
        self,
        d_image: Tensor,
        *,
        d_image_extra: Tensor | None = None,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        absolute: bool = False,
    ) -> Gradients:
        """Sums over all cameras, of which each rank gives the cotangent of its own; `screen` is of its own.

        Raises:
            RuntimeError: asked for a statistic that stays with whose camera it is.
        """
        if d_image_extra is not None or absolute:
            raise RuntimeError("a second cotangent or absolute values: their statistics do not travel")
        gradients = super().backward(d_image, d_alpha=d_alpha, d_depth=d_depth)
        return replace(gradients, screen=self.screens[self._rank])

    def _show(self, camera: int) -> None:
        self.visible, self._shown = self._seen[camera], self._radii[camera]


def render_shared(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    ranks: Ranks,
    counts: list[int],
    *,
    sh_degree: int,
    background: tuple[float, float, float],
    antialias: bool,
) -> SharedRendered:
    """Render on every rank at once.

    Args:
        gaussians: this rank's.
        cameras: one a rank, the same on all; sizes may differ.
        ranks: that take part.
        counts: Gaussians of each rank.
        sh_degree, background, antialias: as `render.render`, the same on all.

    Source: `rasterization(distributed=True)` of gsplat, unpacked: culled splats travel too, so that nobody
    need ask how many there are.
    """
    seam.gsplat()
    graph = torch.is_grad_enabled()
    leaves = {name: tensor.detach().requires_grad_(graph) for name, tensor in gaussians.items()}
    scales, opacities = leaves["log_scales"].exp(), torch.sigmoid(leaves["opacity_logits"])
    degree = min(sh_degree, gaussians.sh_degree)
    packed, radii = [], []
    for camera in cameras:
        cam = on_device(camera, gaussians.device)
        splats = seam.project(
            leaves["means"], leaves["quats"], scales, opacities, cam.viewmat, cam.intrinsics,
            camera.width, camera.height, antialias=antialias,
        )  # fmt: skip
        packed.append(_packed(splats, colours_of(leaves, splats, cam.centre, degree)))
        radii.append(splats.radii)
    sent = torch.cat(packed)
    received = exchange(sent, [len(gaussians)] * ranks.size, counts)
    camera = cameras[ranks.rank]
    return SharedRendered(leaves, sent, received, torch.stack(radii), camera, background, ranks.rank)


def _packed(splats: seam.Splats, colours: Tensor) -> Tensor:
    """[n, 12]; see `_WIDTHS`."""
    radii = splats.radii.contiguous().view(torch.float32)
    columns = [splats.means2d, splats.conics, colours, splats.opacities[:, None], splats.depths[:, None]]
    return torch.cat([*columns, radii], dim=1)


def _unpacked(rows: Tensor) -> tuple[seam.Splats, Tensor]:
    """Splats and their colours [N, 3]."""
    columns = [part.contiguous() for part in rows.split(_WIDTHS, dim=1)]
    means2d, conics, colours, opacities, depths, radii = columns
    splats = seam.Splats(
        radii=radii.detach().view(torch.int32),
        means2d=means2d,
        depths=depths[:, 0],
        conics=conics,
        opacities=opacities[:, 0],
    )
    return splats, colours
