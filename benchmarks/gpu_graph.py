"""A step of `3dgs` as one CUDA graph, to see what launches cost: a loop for `gpu.py --stages cost`.

The number of Gaussians is fixed and tile lists have one length for all cameras (splat/gpu/tiles.py), so that
every step launches the same kernels on the same memory. Camera and photo are copied into place, then the
graph runs. The step is ours (projection, colours, blending, loss, Adam), without checks and statistics.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.gpu import gsplat_seam as seam
from ambiguous_wild.splat.gpu.fused_loss import photometric_fused
from ambiguous_wild.splat.gpu.render import OnDevice, background_on, base_colours, on_device
from ambiguous_wild.splat.gpu.tiles import MARGIN, STEP, list_within
from ambiguous_wild.splat.step import TrainData


class GraphLoop:
    """Trains copies of these Gaussians; every call of `step` is one iteration."""

    def __init__(
        self, gaussians: Gaussians, data: TrainData, rates: dict[str, float], *, capture: bool = True
    ) -> None:
        """
        Args:
            gaussians: to start from.
            data: photos of one size.
            rates: learning rates, by tensor.
            capture: False runs the same step without a graph.

        Raises:
            AwError: photos of several sizes.
        """
        sizes = {(c.width, c.height) for c in data.cameras}
        if len(sizes) != 1:
            raise AwError(f"a graph needs photos of one size, the scene has {len(sizes)}")
        self.size, self.data, device = sizes.pop(), data, data.device
        self.values = {name: tensor.clone() for name, tensor in gaussians.items()}
        self.moments = {n: (torch.zeros_like(t), torch.zeros_like(t)) for n, t in self.values.items()}
        # numbers would be baked into the graph
        self.rates = {name: torch.full((), rate, device=device) for name, rate in rates.items()}
        self.count = torch.zeros((), device=device)
        self.photo = data.photos[0].clone()
        first = on_device(data.cameras[0], device)
        self.camera = OnDevice(first.viewmat.clone(), first.intrinsics.clone(), first.centre.clone())
        self.loss, self.over = torch.zeros((), device=device), torch.zeros(1, device=device)
        self.capacity, self.iteration = self._room(), 0
        self.graph = self._captured() if capture else None

    @torch.no_grad()
    def _room(self) -> int:
        """For the fullest of all cameras."""
        most = 1
        for camera in self.data.cameras:
            splats = self._project(self.values, on_device(camera, self.data.device))
            most = max(most, len(seam.sort(splats, *self.size).flatten_ids))
        return STEP * math.ceil(MARGIN * most / STEP)

    def _captured(self) -> torch.cuda.CUDAGraph:
        kept = {name: tensor.clone() for name, tensor in self.values.items()}
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):  # what is allocated or compiled once, is
            for _ in range(3):
                self._body()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self._body()
        for name, tensor in kept.items():  # as if nothing had been trained
            self.values[name].copy_(tensor)
            for moment in self.moments[name]:
                moment.zero_()
        self.count.zero_()
        return graph

    def step(self) -> Tensor:
        """One iteration; returns the loss, on the device."""
        view = self.iteration % len(self.data.photos)
        self.iteration += 1
        camera = on_device(self.data.cameras[view], self.data.device)
        for here, there in zip(
            (self.camera.viewmat, self.camera.intrinsics, self.camera.centre, self.photo),
            (camera.viewmat, camera.intrinsics, camera.centre, self.data.photos[view]),
            strict=True,
        ):
            here.copy_(there)
        if self.graph is None:
            self._body()
        else:
            self.graph.replay()
        return self.loss

    def _project(self, leaves: dict[str, Tensor], camera: OnDevice) -> seam.Splats:
        return seam.project(
            leaves["means"], leaves["quats"], leaves["log_scales"].exp(),
            torch.sigmoid(leaves["opacity_logits"]), camera.viewmat, camera.intrinsics, *self.size,
            antialias=False,
        )  # fmt: skip

    def _body(self) -> None:
        leaves = {name: tensor.detach().requires_grad_(True) for name, tensor in self.values.items()}
        splats = self._project(leaves, self.camera)
        colours = base_colours(leaves, splats, self.camera, 3).clamp(min=0.0)
        listed = list_within(
            splats.means2d.detach(), splats.radii, splats.depths.detach(), *self.size, self.capacity
        )
        picture, _, _ = seam.blend(
            splats.means2d, splats.conics, colours, splats.opacities,
            seam.Tiles(listed.offsets, listed.flatten_ids), *self.size,
            background=background_on((0.0, 0.0, 0.0), self.data.device),
        )  # fmt: skip
        l1, dssim, d_image = photometric_fused(picture, self.photo, None, 0.2, "map")
        found = torch.autograd.grad(picture, list(leaves.values()), d_image)
        with torch.no_grad():
            self.loss.copy_(0.8 * l1 + 0.2 * dssim)
            self.over.copy_(torch.maximum(self.over, listed.over))
            self.count += 1
            for (name, tensor), gradient in zip(self.values.items(), found, strict=True):
                mean, square = self.moments[name]
                torch._fused_adam_(
                    [tensor], [gradient.contiguous()], [mean], [square], [], [self.count],
                    lr=self.rates[name], beta1=0.9, beta2=0.999, weight_decay=0.0, eps=1e-15,
                    amsgrad=False, maximize=False,
                )  # fmt: skip
