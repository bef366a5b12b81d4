"""A plain gsplat training loop, the baseline of `gpu.py`: rasterization, autograd, torch's fused Adam.

As in gsplat's example trainer with its defaults: one photo a step, L1 and D-SSIM, one Adam for every
parameter, spherical harmonics up to degree 3. The loss is our fused one, so that SSIM takes the same time in
both loops. There is no density control, so that the number of Gaussians is equal.

`rasterization` calls `torch.inverse` on the poses, for which the host waits. A loop that prepares cameras
beforehand would not; `waits=False` measures that loop, with the same inverse made without the wait.
"""

from __future__ import annotations

from typing import Any
from unittest import mock

import torch
from torch import Tensor

from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu.fused_loss import photometric_fused
from ambiguous_wild.splat.gpu.gsplat_seam import gsplat
from ambiguous_wild.splat.step import TrainData


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, photo: Tensor) -> Tensor:
        l1, dssim, gradient = photometric_fused(image, photo, None, 0.2, "map")
        ctx.save_for_backward(gradient)
        return 0.8 * l1 + 0.2 * dssim

    @staticmethod
    def backward(ctx: Any, d_loss: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return d_loss * gradient, None


class PlainLoop:
    """Trains copies of these Gaussians; every call of `step` is one iteration."""

    def __init__(
        self, gaussians: Gaussians, data: TrainData, rates: dict[str, float], *, waits: bool = True
    ) -> None:
        self.data, self.waits = data, waits
        self.parameters = {name: torch.nn.Parameter(t.clone()) for name, t in gaussians.items()}
        device = data.device
        self.optimisers = [
            torch.optim.Adam([p], lr=rates[name], eps=1e-15, fused=True)
            for name, p in self.parameters.items()
        ]
        poses = [torch.from_numpy(c.cam_from_world.astype("float32"))[None] for c in data.cameras]
        intrinsics = [torch.from_numpy(c.intrinsics.astype("float32"))[None] for c in data.cameras]
        self.poses = [pose.to(device) for pose in poses]
        self.intrinsics = [k.to(device) for k in intrinsics]
        self.iteration = 0

    def step(self) -> Tensor:
        """One iteration; returns the loss, on the device."""
        if self.waits:
            return self._step()
        with mock.patch.object(torch, "inverse", lambda matrix: torch.linalg.inv_ex(matrix).inverse):
            return self._step()

    def _step(self) -> Tensor:
        view = self.iteration % len(self.data.photos)
        self.iteration += 1
        p, camera = self.parameters, self.data.cameras[view]
        picture, _, meta = gsplat().rasterization(
            means=p["means"],
            quats=p["quats"],
            scales=torch.exp(p["log_scales"]),
            opacities=torch.sigmoid(p["opacity_logits"]),
            colors=torch.cat([p["sh0"][:, None], p["sh_rest"]], dim=1),
            viewmats=self.poses[view],
            Ks=self.intrinsics[view],
            width=camera.width,
            height=camera.height,
            sh_degree=3,
            packed=False,
        )
        meta["means2d"].retain_grad()  # its density control reads it
        loss: Tensor = _Loss.apply(picture[0], self.data.photos[view])
        loss.backward()
        for optimiser in self.optimisers:
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)
        return loss.detach()
