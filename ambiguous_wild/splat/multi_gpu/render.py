"""The render call of several GPUs: every rank at once, each for a camera of its own.

Every rank projects and shades its own Gaussians for every camera; the splats travel to the rank whose camera
it is, and that rank sorts and blends all of them. Gradients of the splats travel back the same way.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu import gsplat_seam as seam
from ambiguous_wild.splat.gpu.render import RenderedCuda, background_on, base_colours, on_device, seen
from ambiguous_wild.splat.multi_gpu.exchange import exchange
from ambiguous_wild.splat.multi_gpu.ranks import Ranks
from ambiguous_wild.splat.rendered import NOTHING, Cotangents, Gradients, as_cotangents

# Columns of a splat on its way: u v, conic, colour, opacity, depth; and the two radii as their bits.
_WIDTHS = (2, 3, 3, 1, 1, 2)


class SharedRendered(RenderedCuda):
    """The picture of this rank's camera, and which of this rank's Gaussians each camera saw.

    `visible`, `radii` and the gradients are of the rank's own Gaussians; `backward` is called by all at once.
    """

    def __init__(
        self,
        leaves: dict[str, Tensor],
        sent: Tensor,  # [C * n, 12]
        received: Tensor,  # [sum of all counts, 12]
        radii: Tensor,  # [C, n, 2] int32 px
        visible: Tensor,  # [C, n] bool
        camera: Camera,
        background: tuple[float, float, float],
        rank: int,
    ) -> None:
        """
        Args:
            leaves: raw parameters of this rank's n Gaussians.
            sent: their splats in each of C cameras.
            received: splats of all ranks in this rank's camera.
            radii, visible: of what was sent.
            camera: this rank's.
            background: colour.
            rank: this rank, and the place of its camera.
        """
        splats, colours = _unpacked(received)
        size = (camera.width, camera.height)
        tiles = seam.sort(splats, *size)
        super().__init__(leaves, splats, colours, tiles, background_on(background, received.device), size)
        self._rank, self._cameras, self._radii = rank, len(radii), radii
        self._seen = visible
        # Not a method of this object: graph and object would hold each other, and their memory, for ever.
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

    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NOTHING) -> Gradients:
        """Sums over all cameras; each rank gives the cotangents of its own, and `screen` is of its own.

        Raises:
            RuntimeError: asked for a statistic that the ranks do not exchange.
        """
        given = as_cotangents(cotangents)
        if given.extra is not None or needs:
            raise RuntimeError("ranks exchange no statistics of a second cotangent or of absolute values")
        return replace(super().backward(given), screen=self.screens[self._rank])

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
    blur: float = seam.BLUR,
) -> SharedRendered:
    """Render on every rank at once.

    Args:
        gaussians: this rank's.
        cameras: one a rank, the same on all; sizes may differ.
        ranks: that take part.
        counts: Gaussians of each rank.
        sh_degree, background, antialias, blur: as `render.render`, the same on all.

    Source: `rasterization(distributed=True)` of gsplat, unpacked: culled splats travel too, so that
    no rank has to ask how many there are.
    """
    seam.ready(gaussians.device.type)
    graph = torch.is_grad_enabled()
    leaves = {name: tensor.detach().requires_grad_(graph) for name, tensor in gaussians.items()}
    scales, opacities = leaves["log_scales"].exp(), torch.sigmoid(leaves["opacity_logits"])
    degree = min(sh_degree, gaussians.sh_degree)
    packed, radii, visible = [], [], []
    for camera in cameras:
        cam = on_device(camera, gaussians.device)
        splats = seam.project(
            leaves["means"], leaves["quats"], scales, opacities, cam.viewmat, cam.intrinsics,
            camera.width, camera.height, antialias=antialias, blur=blur,
        )  # fmt: skip
        colours = base_colours(leaves, splats, cam, degree).clamp(min=0.0)
        packed.append(_packed(splats, colours))
        radii.append(splats.radii)
        visible.append(seen(splats, (camera.width, camera.height)))
    sent = torch.cat(packed)
    received = exchange(sent, [len(gaussians)] * ranks.size, counts)
    camera = cameras[ranks.rank]
    shown = torch.stack(radii), torch.stack(visible)
    return SharedRendered(leaves, sent, received, *shown, camera, background, ranks.rank)


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
