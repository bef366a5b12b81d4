"""Compile kernels before a run, once per machine, and time a fixed piece of training.

The timed kernel, blending and Adam, tells how fast the machine is now. It runs the trainer's own code with
the trainer's threads, so that other programs slow it down as they slow down a training. Its scene never
changes: learning rates are 0. If its work is changed, its name in `KERNELS` must change too, because seconds
of different kernels cannot be compared.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.core.processes import python_meanwhile
from ambiguous_wild.io.numba_cache import cache_in_use, lifetime
from ambiguous_wild.io.terminal import clock
from ambiguous_wild.splat import backend
from ambiguous_wild.splat.cpu.compile import one_thread
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.rendered import Cotangents

# time to compile all kernels, in those of `_compile_sample`: 19.1 s of 0.36 s on two idle cores
COLD_IN_SAMPLES = 53


@dataclass(frozen=True)
class KernelSize:
    """The work of a calibration kernel."""

    name: str  # name in the record of a run
    reference_s: float  # seconds on the reference machine
    gaussians: int
    width: int
    height: int
    steps: int
    serial_steps: int = 0  # further steps on one thread; 0 = none, as on a GPU
    serial_reference_s: float = 1.0


# Reference machine of the CPU: 2 threads of an AMD EPYC virtual machine, nothing else running. That of a GPU
# is nominal: the kernel takes a twentieth of a second there.
KERNELS = {
    "cpu": KernelSize("cpu-3", 0.040, 12_000, 240, 136, 3, 2, 0.050),
    "cuda": KernelSize("gpu-3", 0.05, 100_000, 960, 544, 12),
}


@dataclass(frozen=True)
class CalibrationResult:
    """The result of one calibration.

    Load slows work on one thread less than work on several, so a training is compared with both.
    """

    seconds: float  # wall time of the kernel
    processors: float = 1.0  # processor seconds that it got in a second
    serial_s: float | None = None  # wall time of the steps on one thread
    serial_processors: float = 1.0


class Calibration:
    """The calibration kernel on one device."""

    def __init__(self, device: torch.device, size: KernelSize) -> None:
        self.device, self.size = device, size
        rng = np.random.default_rng(7)
        xyz = rng.uniform([-4.0, -2.4, 4.0], [4.0, 2.4, 8.0], (size.gaussians, 3))
        colours = rng.integers(0, 255, (size.gaussians, 3)).astype(np.uint8)
        self.gaussians = Gaussians.from_points(xyz, colours).to(device)
        focal = 0.9 * size.width
        lens = (size.width, size.height, focal, focal, size.width / 2, size.height / 2)
        self.cameras = [Camera(*lens, _moved(shift)) for shift in (-0.4, 0.0, 0.4)]
        self.photo = torch.full((size.height, size.width, 3), 0.5, device=device)
        self.optimiser = SplatAdam(self.gaussians, {name: 0.0 for name, _ in self.gaussians.items()})
        self._steps(1)  # the first use allocates memory

    def seconds(self) -> float:
        """Run the kernel once; returns its wall seconds, on a GPU the seconds between two GPU events."""
        if self.device.type != "cuda":
            begin = time.perf_counter()
            self._steps(self.size.steps)
            backend.wait(self.device)
            return time.perf_counter() - begin
        first, last = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        first.record()
        self._steps(self.size.steps)
        last.record()
        last.synchronize()
        return first.elapsed_time(last) / 1e3

    def read(self) -> CalibrationResult:
        """Run the kernel with the threads of the training, and on a CPU on one thread too."""
        if self.device.type == "cuda":
            return CalibrationResult(self.seconds())
        spent = time.process_time()
        seconds = self.seconds()
        processors = (time.process_time() - spent) / seconds
        if not self.size.serial_steps:
            return CalibrationResult(seconds, processors)
        begin, spent = time.perf_counter(), time.process_time()
        with one_thread():
            self._steps(self.size.serial_steps)
        serial_s = time.perf_counter() - begin
        return CalibrationResult(seconds, processors, serial_s, (time.process_time() - spent) / serial_s)

    def _steps(self, count: int) -> None:
        for k in range(count):
            rendered = render(self.gaussians, self.cameras[k % len(self.cameras)])
            cotangent = photometric(rendered.image, self.photo).d_image
            self.optimiser.step(rendered.backward(cotangent), rendered.visible)


@lru_cache(maxsize=1)
def calibration(device: torch.device) -> Calibration:
    """Return the kernel of a device, made once a process."""
    return Calibration(device, KERNELS["cuda" if device.type == "cuda" else "cpu"])


def _moved(shift: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = shift
    return pose


def _tiny_scene() -> tuple[Gaussians, Camera]:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (8, 3)) + np.array([0.0, 0.0, 4.0])
    gaussians = Gaussians.from_points(xyz, rng.integers(0, 255, (8, 3)).astype(np.uint8))
    return gaussians, Camera(20, 18, 20.0, 20.0, 10.0, 9.0, np.eye(4))


def _cached() -> bool:
    """Whether the last kernel that `warm_up` compiles is on disk for this machine and this source."""
    from ambiguous_wild.splat.cpu import adam

    # The dispatcher's index file lists the signatures compiled from this very source for this processor.
    try:
        return bool(adam.catch_up.compiled._cache._cache_file._load_index())
    except Exception:  # pickle raises any exception on a damaged file, which is written anew
        return False


def _compile_sample() -> float:
    """Compile a small kernel, and keep it nowhere; returns the seconds, a measure of this machine."""
    import numba

    def sample(values, out):
        for i in numba.prange(len(values)):
            total = 0.0
            for j in range(len(values)):
                total += np.exp(-values[i] * values[j])
            out[i] = np.sqrt(total)

    for _ in range(2):  # the first compilation of a process also sets up the compiler
        begin = time.perf_counter()
        numba.njit("void(float32[::1], float32[::1])", parallel=True)(sample)
    return time.perf_counter() - begin


def warm_up(announce: Callable[[str], None] | None = None, helper: bool = False) -> float:
    """Run every kernel that most methods need on eight Gaussians; returns the seconds it took.

    Args:
        announce: gets a message before the compilation, if the compiled kernels are not on disk yet.
        helper: compile half of them in another process meanwhile.
    """
    from ambiguous_wild.splat.cpu.cpu_render import render_cpu

    begin = time.perf_counter()
    with ExitStack() as stack:
        if not _cached():
            if announce is not None:
                expected_s = COLD_IN_SAMPLES * _compile_sample()
                announce(f"compiling CPU kernels (about {expected_s:.0f} s, {lifetime(cache_in_use())})...")
                stack.enter_context(clock("compiling", expected_s))
            if helper:
                code = f"from {__name__} import warm_losses; warm_losses()"
                stack.enter_context(python_meanwhile(code, finish=True))
        gaussians, camera = _tiny_scene()
        optimiser = SplatAdam(gaussians, {name: 1e-9 for name, _ in gaussians.items()})
        rendered = render_cpu(gaussians, camera)
        gradients = rendered.backward(torch.zeros_like(rendered.image))
        optimiser.step(gradients, rendered.visible)
    warm_losses()
    render_cpu(gaussians, camera)
    optimiser.flush()
    optimiser.step(gradients, rendered.visible)
    return time.perf_counter() - begin


def warm_backward(pictures: Collection[str], needs: frozenset[str]) -> None:
    """Run the backward pass with cotangents of these pictures, and these statistics."""
    from ambiguous_wild.splat.cpu.cpu_render import render_cpu

    gaussians, camera = _tiny_scene()
    rendered = render_cpu(gaussians, camera)
    image, flat = torch.zeros_like(rendered.image), torch.zeros_like(rendered.alpha)
    zeros = (("image", image), ("extra", image), ("alpha", flat), ("depth", flat))
    rendered.backward(Cotangents(*(zero if name in pictures else None for name, zero in zeros)), needs)


def warm_losses() -> None:
    """Run the kernels of losses and of the watchdog."""
    from ambiguous_wild.splat.cpu.adam import all_finite
    from ambiguous_wild.splat.losses import ssim_map

    gaussians, camera = _tiny_scene()
    photo, keep = torch.zeros(camera.height, camera.width, 3), torch.ones(camera.height, camera.width)
    photometric(photo, photo)
    photometric(photo, photo, keep)
    photometric(photo, photo, keep, weighting="images")
    ssim_map(photo, photo)
    # the watchdog passes as many tensors of gradients and of parameters
    all_finite([tensor for name, tensor in gaussians.items() if name != "sh_rest"])
    all_finite([tensor for _, tensor in gaussians.items()])


def prepare_cpu(threads: int | None, say: Callable[[str], None] | None = None) -> None:
    """Set the threads of the kernels and compile them, once per machine.

    Args:
        threads: number of threads; None = all that the machine has.
        say: gets a message when kernels are compiled.
    """
    from ambiguous_wild.splat.cpu import set_threads

    if threads is not None:
        set_threads(threads)
    warm_up(say, helper=threads != 1)
