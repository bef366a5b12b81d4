"""The `render` call on an NVIDIA GPU, through gsplat (extra `[cuda]`).

gsplat differs from our conventions in one constant of its release 1.5.3: alpha is clamped at 0.999 there,
at 0.99 here and on gsplat's main branch. The version is written into every run's env.json.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.extras import install_command
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import Gradients

NEAR = 0.01  # world units, as on the CPU
BLUR = 0.3  # px^2, as on the CPU


def _gsplat() -> Any:
    try:
        import gsplat
    except ImportError:
        raise AwError(
            f"the Gaussians are on a GPU and gsplat is not installed: {install_command('cuda')}, "
            "or run with --device cpu"
        ) from None
    return gsplat


class RenderedCuda:
    """Pictures and gsplat's graph; `backward` may be called once."""

    def __init__(
        self, leaves: dict[str, Tensor], colours: Tensor, alphas: Tensor, meta: dict[str, Any]
    ) -> None:
        self._leaves, self._colours, self._alphas = leaves, colours, alphas
        self._means2d = meta["means2d"]
        radii = meta["radii"][0]
        # 1.5.3 gives a radius per axis; a row is visible where both are positive.
        radii = radii if radii.dim() == 2 else radii[:, None]
        self.image = colours[0, ..., :3].detach()
        self.depth = colours[0, ..., 3].detach()
        self.alpha = alphas[0, ..., 0].detach()
        self.visible = (radii > 0).all(dim=1)
        self.radii = torch.where(self.visible, radii.amax(dim=1), 0).float()

    def backward(
        self,
        d_image: Tensor,
        *,
        d_image_extra: Tensor | None = None,
        d_alpha: Tensor | None = None,
        d_depth: Tensor | None = None,
        absolute: bool = False,
    ) -> Gradients:
        """As `Rendered.backward`; a second cotangent is a second traversal of gsplat's graph."""
        depth = torch.zeros_like(self.depth) if d_depth is None else d_depth
        colours = torch.cat([d_image, depth[..., None]], dim=-1)[None]
        alphas = None if d_alpha is None else d_alpha[None, ..., None]
        extra = None
        screen_abs = None
        first = self._pull(colours, alphas, keep_graph=d_image_extra is not None)
        if absolute:
            screen_abs = self._means2d.absgrad[0].clone()
        if d_image_extra is not None:
            zeros = torch.zeros_like(depth)[..., None]
            extra = self._pull(torch.cat([d_image_extra, zeros], dim=-1)[None], None, keep_graph=False)
        total = {
            name: g if extra is None else g + extra[name] for name, g in first.items() if name != "screen"
        }
        return Gradients(
            **total,
            screen=first["screen"],
            screen_extra=None if extra is None else extra["screen"],
            screen_abs=screen_abs,
        )

    def _pull(self, colours: Tensor, alphas: Tensor | None, *, keep_graph: bool) -> dict[str, Tensor]:
        outputs, cotangents = [self._colours], [colours]
        if alphas is not None:
            outputs.append(self._alphas)
            cotangents.append(alphas)
        inputs = [*self._leaves.values(), self._means2d]
        found = torch.autograd.grad(
            outputs, inputs, cotangents, retain_graph=keep_graph, allow_unused=True, materialize_grads=True
        )
        gradients = dict(zip(self._leaves, found[:-1]))
        return gradients | {"screen": found[-1][0]}


def render_cuda(
    gaussians: Gaussians,
    camera: Camera,
    *,
    sh_degree: int,
    background: tuple[float, float, float],
    antialias: bool,
) -> RenderedCuda:
    """Render on the GPU; see `render.render`.

    Raises:
        AwError: gsplat is missing; says the command that installs it.
    """
    gsplat = _gsplat()
    device = gaussians.device
    leaves = {name: tensor.detach().requires_grad_(True) for name, tensor in gaussians.items()}
    with torch.enable_grad():
        colours, alphas, meta = gsplat.rasterization(
            means=leaves["means"],
            quats=leaves["quats"],
            scales=leaves["log_scales"].exp(),
            opacities=torch.sigmoid(leaves["opacity_logits"]),
            colors=torch.cat([leaves["sh0"][:, None], leaves["sh_rest"]], dim=1),
            viewmats=torch.as_tensor(camera.cam_from_world.copy(), dtype=torch.float32, device=device)[None],
            Ks=torch.as_tensor(camera.intrinsics, dtype=torch.float32, device=device)[None],
            width=camera.width,
            height=camera.height,
            near_plane=NEAR,
            eps2d=BLUR,
            sh_degree=sh_degree,
            packed=False,
            backgrounds=torch.tensor([background], dtype=torch.float32, device=device),
            render_mode="RGB+D",
            absgrad=True,
            rasterize_mode="antialiased" if antialias else "classic",
        )
    return RenderedCuda(leaves, colours, alphas, meta)
