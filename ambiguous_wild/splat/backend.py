"""Where a run computes: Numba's kernels on the CPU, or torch and gsplat on a GPU.

A run holds one of the two (`TrainData.backend`); `backend_of` gives the one of a tensor's device. Whatever
differs between them is a call here, so that effects and methods are written once. Tests run the GPU's calls
without a GPU: with numbers, by letting `accelerated` say yes to the CPU; and without numbers, on torch's
`meta` device, where everything that would make the host wait raises an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, ClassVar

import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import GSPLAT_SUMS, NEEDS, Rendered


def accelerated(device: torch.device | str) -> bool:
    """Whether torch and gsplat compute on this device; reading a value back makes the host wait."""
    return torch.device(device).type != "cpu"


def wait(device: torch.device | str) -> None:
    """Wait until a GPU has done what was launched on it; for other devices return at once."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


Photometric = tuple[float | Tensor, float | Tensor, Tensor]  # L1, 1 - SSIM, gradient [H, W, 3] of their mix
_LANES = 64  # partial sums of each label while a GPU adds up


class Backend:
    """The calls that differ between back ends, as the CPU answers them: by Numba's kernels, or torch."""

    statistics: ClassVar[Sequence[str]] = NEEDS  # what a backward pass can sum beside gradients
    kernels: ClassVar[bool] = True  # Numba's kernels can read its tensors
    reads_at_once: ClassVar[bool] = True  # False: to read a value, the host waits for all queued work
    same_bits: ClassVar[bool] = True  # whether one seed gives the same bits

    # -- a step of training -----------------------------------------------------------------------

    def render(self, gaussians: Gaussians, camera: Camera, **options: Any) -> Rendered:
        """Draw a picture that has a backward pass: `render.render` with every option given."""
        from ambiguous_wild.splat.cpu.cpu_render import render_cpu

        return render_cpu(gaussians, camera, **options)

    def photometric(
        self, render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, weighting: str
    ) -> Photometric:
        """Return the parts of `losses.photometric`, for arguments that were checked."""
        from ambiguous_wild.splat.cpu.photometric import photometric_cpu

        return photometric_cpu(render, photo, keep, lambda_dssim, weighting)

    def ssim_map(self, a: Tensor, b: Tensor) -> Tensor:
        """Return SSIM of every pixel and channel, [H, W, 3]."""
        from ambiguous_wild.splat.cpu.photometric import ssim_map_cpu

        return ssim_map_cpu(a, b)

    def prepare_loss(
        self, device: torch.device, sizes: frozenset[tuple[int, int]], lambda_dssim: float, weighting: str
    ) -> None:
        """Compile the loss for photos of these heights and widths, before the clock starts.

        Nothing to do on the CPU: its kernels are compiled for all sizes, before any run.
        """

    def adam_step(
        self,
        parameter: Tensor,
        gradient: Tensor,
        moments: tuple[Tensor, Tensor],
        rate: float,
        steps: int | Tensor,
        skip_step: Tensor | None,
    ) -> None:
        """One step of Adam (0.9, 0.999, 1e-15) on a tensor and its moments, float32, contiguous, in place.

        Args:
            parameter, gradient: tensors of one shape.
            moments: mean and mean square.
            rate: learning rate.
            steps: number of steps, this one included; on a GPU a 0-d tensor.
            skip_step: on a GPU a tensor [1] float32: 1 = change nothing.
        """
        from ambiguous_wild.splat.cpu import adam

        assert isinstance(steps, int)
        adam.dense_step(parameter, gradient, moments, rate, steps)

    def all_finite(self, tensors: Sequence[Tensor]) -> bool:
        """Whether every value is finite; a GPU may say no where a sum of finite values overflows."""
        from ambiguous_wild.splat.cpu.adam import all_finite

        return all_finite(tensors)

    def max_alpha(self, device: torch.device | str) -> float:
        """Return the value at which alpha is clamped."""
        return 0.99

    def use_threads(self, n: int) -> None:
        """Use n threads for torch's own work on the CPU: its sums, and so the bits of a run, depend on n."""
        from ambiguous_wild.splat.cpu.compile import threads

        threads()  # starts Numba's pool, which sets the number of OpenMP's threads, torch's with it
        torch.set_num_threads(n)

    def all_threads(self) -> AbstractContextManager[None]:
        """Let torch use all threads inside of the context, for what has the same bits with any number.

        That is everything element by element or row by row, but not sums over many rows or products of large
        matrices.
        """
        from ambiguous_wild.splat.cpu.compile import torch_threads

        return torch_threads()

    # -- what effects and methods need ------------------------------------------------------------

    def number(self, value: Tensor) -> float | Tensor:
        """Return the number in a 0-d tensor; on a GPU a float64 tensor that `float(...)` reads later."""
        return float(value.detach())

    def visible_rows(self, visible: Callable[[], Tensor]) -> Tensor | slice:
        """Return rows [M] int64 where `visible()` [N] bool holds; on a GPU all, or the host would wait."""
        return torch.nonzero(visible()).squeeze(1)

    def mean_of_rows(self, values: Tensor, visible: Callable[[], Tensor]) -> Tensor:
        """Average values [M, ...] of `rows`; on a GPU those of the rows [N, ...] where `visible()` holds."""
        return values.mean()

    def neighbours(self, points: Tensor, count: int) -> Tensor:
        """Return the rows of the points nearest to each point [M, 3], itself first, [M, count] int64."""
        from scipy.spatial import cKDTree

        xyz = points.detach().double().numpy()
        # many centres coincide after cloning: the tree needs leaves that split on ties
        tree = cKDTree(xyz, balanced_tree=False)
        return torch.from_numpy(tree.query(xyz, k=list(range(1, count + 1)))[1])

    def label_sums(self, labels: Tensor, count: int, values: Tensor | None = None) -> Tensor:
        """Sum values [P] by their labels [P] int64 below `count`, [count] float64; None counts the labels."""
        return torch.bincount(labels, weights=values, minlength=count).double()

    def pose(self, camera: Camera, like: Tensor) -> Tensor:
        """Return `cam_from_world` [4, 4] on the device of `like`."""
        return torch.tensor(camera.cam_from_world.tolist(), dtype=like.dtype)

    def adam(self, parameters: Iterable[torch.nn.Parameter], lr: float) -> torch.optim.Adam:
        """Return Adam for a net's parameters; on a GPU it is one kernel, and the step count lies there."""
        return torch.optim.Adam(parameters, lr=lr)


class GpuBackend(Backend):
    """The calls as torch and gsplat answer them; the host waits once for each picture, in gsplat."""

    statistics = GSPLAT_SUMS
    kernels = reads_at_once = same_bits = False

    def render(self, gaussians: Gaussians, camera: Camera, **options: Any) -> Rendered:
        from ambiguous_wild.splat.gpu_render import render_cuda

        return render_cuda(gaussians, camera, **options)

    def photometric(
        self, render: Tensor, photo: Tensor, keep: Tensor | None, lambda_dssim: float, weighting: str
    ) -> Photometric:
        from ambiguous_wild.splat.gpu_kernels import photometric_fused

        return photometric_fused(render, photo, keep, lambda_dssim, weighting)

    def ssim_map(self, a: Tensor, b: Tensor) -> Tensor:
        from ambiguous_wild.splat.gpu_kernels import ssim_map_fused

        return ssim_map_fused(a, b)

    def prepare_loss(
        self, device: torch.device, sizes: frozenset[tuple[int, int]], lambda_dssim: float, weighting: str
    ) -> None:
        from ambiguous_wild.splat.gpu_kernels import prepare

        prepare(device, sizes, lambda_dssim, weighting)

    def adam_step(
        self,
        parameter: Tensor,
        gradient: Tensor,
        moments: tuple[Tensor, Tensor],
        rate: float,
        steps: int | Tensor,
        skip_step: Tensor | None,
    ) -> None:
        assert isinstance(steps, Tensor)
        torch._fused_adam_(
            [parameter], [gradient], [moments[0]], [moments[1]], [], [steps],
            lr=rate, beta1=0.9, beta2=0.999, weight_decay=0.0, eps=1e-15,
            amsgrad=False, maximize=False, grad_scale=None, found_inf=skip_step,
        )  # fmt: skip

    def all_finite(self, tensors: Sequence[Tensor]) -> bool:
        # one sum for each tensor: several times as fast as isfinite().all(), which writes a tensor of its own
        return bool(torch.isfinite(torch.stack([tensor.sum() for tensor in tensors])).all())

    def max_alpha(self, device: torch.device | str) -> float:
        from ambiguous_wild.splat.gsplat_calls import max_alpha

        return max_alpha(str(device))

    def use_threads(self, n: int) -> None:
        torch.set_num_threads(n)

    def all_threads(self) -> AbstractContextManager[None]:
        return nullcontext()

    def number(self, value: Tensor) -> float | Tensor:
        return value.detach().double()

    def visible_rows(self, visible: Callable[[], Tensor]) -> Tensor | slice:
        return slice(None)

    def mean_of_rows(self, values: Tensor, visible: Callable[[], Tensor]) -> Tensor:
        inside = visible().to(values)
        seen = inside.sum() * (values.numel() // max(len(values), 1))
        return (values * inside.reshape(-1, *[1] * (values.dim() - 1))).sum() / seen.clamp(min=1.0)

    def neighbours(self, points: Tensor, count: int) -> Tensor:
        from ambiguous_wild.splat.gpu_kernels import nearest

        return nearest(points, count)

    def label_sums(self, labels: Tensor, count: int, values: Tensor | None = None) -> Tensor:
        # `bincount` reads the largest label on the host. Neighbouring pixels mostly share a label and would
        # wait for one address: each label has several.
        values = torch.ones_like(labels, dtype=torch.float64) if values is None else values
        lane = torch.arange(len(labels), device=labels.device) % _LANES
        sums = values.new_zeros(count * _LANES).scatter_add_(0, labels * _LANES + lane, values)
        return sums.reshape(count, _LANES).sum(dim=1)

    def pose(self, camera: Camera, like: Tensor) -> Tensor:
        from ambiguous_wild.splat.gpu_render import on_device

        return on_device(camera, like.device).viewmat[0]

    def adam(self, parameters: Iterable[torch.nn.Parameter], lr: float) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=lr, fused=True)


_CPU, _GPU = Backend(), GpuBackend()


def backend_of(device: torch.device | str) -> Backend:
    """Return the back end that computes with tensors on this device."""
    return _GPU if accelerated(device) else _CPU
