"""The `render` call on an NVIDIA GPU, through gsplat (extra `[cuda]`).

A picture is made in two stages: Gaussians to splats, then splats to pixels. Each stage has its own graph;
the splats lie at the cut between the two. Every cotangent goes back through the pixels separately; their sum
at the cut goes back to the Gaussians once. A shading function makes a second cut, between the harmonics and
the colours of the splats.
Nothing here reads a tensor's values: the host waits once a picture, in gsplat, for the number of tiles.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.splat import gsplat_calls, readiness
from ambiguous_wild.splat.effects.device_cameras import on_device
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.gpu_kernels import visible
from ambiguous_wild.splat.rendered import (
    GSPLAT_SUMS,
    NO_STATISTICS,
    Cotangents,
    Gradients,
    Shade,
    ShadeVjp,
    as_cotangents,
    check_needs,
    scatter_gradients,
)


@dataclass(frozen=True)
class Shaded:
    """State of a render whose colours came from a shading function."""

    gaussians: Gaussians
    base: Tensor  # [N, 3] SH + 0.5, part of the graph of the parameters
    colours: Tensor  # [N, 3] from the function, not clamped
    vjp: ShadeVjp


class RenderedCuda:
    """Pictures of one camera and the backward pass to the parameters; see `rendered.Rendered`.

    Under `torch.no_grad` there is no backward pass and no graph is kept.
    """

    def __init__(
        self,
        leaves: dict[str, Tensor],
        splats: gsplat_calls.ProjectedGaussians,
        colours: Tensor,
        tiles: gsplat_calls.Tiles,
        background: Tensor,
        size: tuple[int, int],
        shaded: Shaded | None = None,
    ) -> None:
        """
        Args:
            leaves: raw parameters that gradients are asked for.
            splats, colours: made of `leaves`.
            tiles: splats by tile.
            background: [1, 3].
            size: width and height in px.
            shaded: given if the colours came from a shading function.
        """
        self._leaves, self._splats, self._colours = leaves, splats, colours
        self._tiles, self._background, self._size = tiles, background, size
        self._shaded = shaded
        self._graph, self._done = torch.is_grad_enabled(), False
        self._cut = self._leaves_of_the_cut()
        self._image, self._alpha, _ = self._blend(self._cut)
        self._depth: Tensor | None = None
        self.image, self.alpha = self._image.detach(), self._alpha.detach()
        size_px = gsplat_calls.size_on(*size, splats.radii.device)
        self.visible = visible(splats.radii, splats.means2d, splats.conics, splats.opacities, size_px)
        self._shown = splats.radii

    @property
    def radii(self) -> Tensor:
        """[N] float32 px; computed only on demand, as no training step reads it."""
        return torch.where(self.visible, self._shown.amax(dim=1), 0).to(torch.float32)

    @property
    def depth(self) -> Tensor:
        """[H, W], sum of weight times z; blended at the first access."""
        if self._depth is None:
            with torch.no_grad():
                s = self._splats
                picture, _, _ = gsplat_calls.blend(
                    s.means2d, s.conics, s.depths[:, None], s.opacities, self._tiles, *self._size
                )
            self._depth = picture[..., 0]
        return self._depth

    @torch.no_grad()
    def backward(self, cotangents: Cotangents | Tensor, needs: frozenset[str] = NO_STATISTICS) -> Gradients:
        """Do as `Rendered.backward`, but only once for a picture, because torch frees its graph.

        Absolute sums do not contain depth, which gsplat blends separately.

        Raises:
            AwError: a statistic is unknown, or gsplat does not offer it.
            RuntimeError: the picture was drawn under `torch.no_grad`, or this is its second backward pass.
        """
        check_needs(needs, GSPLAT_SUMS)
        if not self._graph:
            raise RuntimeError("drawn under torch.no_grad: there is no backward pass")
        if self._done:
            raise RuntimeError("this picture had its backward pass: on an accelerator draw it again first")
        self._done = True
        cotangent = as_cotangents(cotangents)
        d_image, d_extra = cotangent.image, cotangent.extra
        cut, image, alpha, batch = self._cut, self._image, self._alpha, None
        if "absolute" in needs:
            # gsplat must be told before it draws, so methods that need the sums pay for a second drawing
            with torch.enable_grad():
                cut = self._leaves_of_the_cut()
                image, alpha, batch = self._blend(cut, absolute=True)
            if d_image is None and cotangent.alpha is None:
                d_image = torch.zeros_like(self.image)
        at_cut = _vjp(image, alpha, cut, d_image, cotangent.alpha, keep=d_extra is not None)
        screen = at_cut[0]
        screen_abs = None if batch is None else gsplat_calls.absolute_gradient(batch)
        depths = None
        if cotangent.depth is not None:
            *through, depths = self._depth_gradients(cotangent.depth)
            at_cut = _add(at_cut, [through[0], through[1], None, through[2]])
            screen = at_cut[0]
        screen_extra = None
        if d_extra is not None:
            second = _vjp(image, alpha, cut, d_extra, None, keep=False)
            screen_extra = second[0]
            at_cut = _add(at_cut, second)
        return self._gradients(
            at_cut, depths, cotangent, screen=screen, screen_extra=screen_extra, screen_abs=screen_abs
        )

    def _gradients(
        self, at_cut: list[Tensor], depths: Tensor | None, given: Cotangents, **screens: Any
    ) -> Gradients:
        """Pull gradients from the cut back to the parameters."""
        s, shaded = self._splats, self._shaded
        colours, through = self._colours, None
        if shaded is not None:  # 0 where colours were clamped at 0, then through the function
            d_colours = torch.where(shaded.colours > 0, at_cut[2], 0.0)
            through = shaded.vjp(d_colours)
            colours, at_cut = shaded.base, [at_cut[0], at_cut[1], through.base, at_cut[3]]
        outputs, cotangents = [s.means2d, s.conics, colours, s.opacities], list(at_cut)
        if depths is not None:
            outputs.append(s.depths)
            cotangents.append(depths)
        values = torch.autograd.grad(
            outputs, list(self._leaves.values()), cotangents, allow_unused=True, materialize_grads=True
        )
        gradients = Gradients(*values, **screens, visible=self.visible, effect_grads=given.effect_grads)
        if shaded is not None and through is not None:
            gradients = scatter_gradients(gradients, through, slice(None), shaded.gaussians)
        return gradients

    def _leaves_of_the_cut(self) -> list[Tensor]:
        s = self._splats
        values = (s.means2d, s.conics, self._colours, s.opacities)
        return [value.detach().requires_grad_(self._graph) for value in values]

    def _blend(self, cut: list[Tensor], *, absolute: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        means2d, conics, colours, opacities = cut
        return gsplat_calls.blend(
            means2d, conics, colours, opacities, self._tiles, *self._size,
            background=self._background, absolute=absolute,
        )  # fmt: skip

    def _depth_gradients(self, d_depth: Tensor) -> tuple[Tensor, ...]:
        """Return dL/d of means2d, conics, opacities and depths."""
        s = self._splats
        leaves = [v.detach().requires_grad_(True) for v in (s.means2d, s.conics, s.opacities, s.depths)]
        with torch.enable_grad():
            picture, _, _ = gsplat_calls.blend(
                leaves[0], leaves[1], leaves[3][:, None], leaves[2], self._tiles, *self._size
            )
        return torch.autograd.grad(picture, leaves, d_depth[..., None])


def render_cuda(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int,
    background: tuple[float, float, float],
    antialias: bool,
    blur: float = gsplat_calls.BLUR,
    shade: Shade | None = None,
) -> RenderedCuda:
    """Render on the GPU; see `render.render`. `shade` gets all rows; those that are not visible are 0.

    Raises:
        AwError: gsplat is missing or cannot be used; the message holds the command that mends it.
    """
    gsplat_calls.gsplat()
    if gaussians.device.type == "cuda":
        _check_gpu()
    cam = on_device(camera, gaussians.device)
    graph = torch.is_grad_enabled()
    leaves = {name: tensor.detach().requires_grad_(graph) for name, tensor in gaussians.items()}
    splats = gsplat_calls.project(
        leaves["means"],
        leaves["quats"],
        leaves["log_scales"].exp(),
        torch.sigmoid(leaves["opacity_logits"]),
        cam.viewmat,
        cam.intrinsics,
        camera.width,
        camera.height,
        antialias=antialias,
        blur=blur,
    )
    base = _base_colours(leaves, splats, cam.centre, min(sh_degree, gaussians.sh_degree))
    shaded = None if shade is None else _shaded(shade, gaussians, base, splats)
    colours = (base if shaded is None else shaded.colours).clamp(min=0.0)
    size = (camera.width, camera.height)
    tiles = gsplat_calls.sort(splats, *size)
    behind = _background_on(background, gaussians.device)
    return RenderedCuda(leaves, splats, colours, tiles, behind, size, shaded)


@functools.cache
def _check_gpu() -> None:
    readiness.require_gpu(readiness.gpu_facts())


def _base_colours(
    leaves: dict[str, Tensor], splats: gsplat_calls.ProjectedGaussians, centre: Tensor, degree: int
) -> Tensor:
    """Return SH + 0.5 [N, 3], not clamped; rows that are not visible may hold any value."""
    if degree == 0:
        return leaves["sh0"] * SH_C0 + 0.5
    active = leaves["sh_rest"][:, : (degree + 1) ** 2 - 1]
    coefficients = torch.cat([leaves["sh0"][:, None], active], dim=1)
    drawn = (splats.radii > 0).all(dim=1)
    return gsplat_calls.shade(degree, leaves["means"], centre, coefficients, drawn) + 0.5


def _shaded(
    shade: Shade, gaussians: Gaussians, base: Tensor, splats: gsplat_calls.ProjectedGaussians
) -> Shaded:
    """Call the shading function.

    Raises:
        AwError: it does not return one colour for each row.
    """
    visible = (splats.radii > 0).all(dim=1)
    # a net must not see what gsplat left in rows that it did not compute: 0 times NaN is NaN in its gradients
    base = torch.where(visible[:, None], base, 0.0)
    colours, vjp = shade(base.detach(), slice(None))
    if colours.shape != base.shape:
        raise AwError(f"a shading function must give colours {list(base.shape)}, got {list(colours.shape)}")
    return Shaded(gaussians, base, colours.detach(), vjp)


@functools.cache
def _background_on(background: tuple[float, float, float], device: torch.device) -> Tensor:
    """Return the background [1, 3] on the device; it is copied once."""
    return torch.tensor([background], dtype=torch.float32).to(device)


def _vjp(
    image: Tensor,
    alpha: Tensor,
    cut: list[Tensor],
    d_image: Tensor | None,
    d_alpha: Tensor | None,
    *,
    keep: bool,
) -> list[Tensor]:
    """Return the gradients at the cut; `keep`: the graph is needed once more."""
    pairs = [(picture, d) for picture, d in ((image, d_image), (alpha, d_alpha)) if d is not None]
    if not pairs:
        return [torch.zeros_like(value) for value in cut]
    pictures, cotangents = zip(*pairs, strict=True)
    return list(
        torch.autograd.grad(
            pictures, cut, cotangents, retain_graph=keep, allow_unused=True, materialize_grads=True
        )
    )


def _add(a: list[Tensor], b: list[Tensor | None] | list[Tensor]) -> list[Tensor]:
    return [x if y is None else x + y for x, y in zip(a, b, strict=True)]
