"""Compile every kernel once per machine, and say so while it takes its seconds."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from ambiguous_wild.core import Camera
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.rendered import Cotangents

COLD_S = 35  # measured, one core at 2.6 GHz


def _tiny_scene() -> tuple[Gaussians, Camera]:
    rng = np.random.default_rng(0)
    xyz = rng.uniform(-1, 1, (8, 3)) + np.array([0.0, 0.0, 4.0])
    gaussians = Gaussians.from_points(xyz, rng.integers(0, 255, (8, 3)).astype(np.uint8))
    return gaussians, Camera(20, 18, 20.0, 20.0, 10.0, 9.0, np.eye(4))


def _cached() -> bool:
    """Whether the last kernel that `warm_up` compiles is on disk for this machine and this source."""
    from ambiguous_wild.splat.cpu import adam

    # The dispatcher's index file lists the signatures compiled from this very source for this machine.
    return bool(adam.catch_up_all.compiled._cache._cache_file._load_index())


def warm_up(announce: Callable[[str], None] = lambda text: None) -> float:
    """Run every kernel that all methods need on eight Gaussians; returns the seconds it took.

    Args:
        announce: told once, before, if the compiled kernels are not on disk yet.
    """
    from ambiguous_wild.splat.cpu.finite import all_finite
    from ambiguous_wild.splat.cpu.render import render_cpu
    from ambiguous_wild.splat.losses import photometric, ssim_map
    from ambiguous_wild.splat.optim import SplatAdam

    begin = time.perf_counter()
    if not _cached():
        announce(f"compiling CPU kernels (about {COLD_S} s, once per machine)...")
    gaussians, camera = _tiny_scene()
    optimiser = SplatAdam(gaussians, {name: 1e-9 for name, _ in gaussians.items()})
    rendered = render_cpu(gaussians, camera)
    photo = torch.zeros_like(rendered.image)
    loss = photometric(rendered.image, photo)
    keep = torch.ones(camera.height, camera.width)
    photometric(rendered.image, photo, keep)
    photometric(rendered.image, photo, keep, weighting="images")
    ssim_map(rendered.image, photo)
    gradients = rendered.backward(loss.d_image)
    rendered.backward(Cotangents(loss.d_image, extra=loss.d_image))
    rendered.backward(loss.d_image, frozenset({"absolute"}))
    # as many tensors as the watchdog gives: of gradients, of parameters
    all_finite([tensor for name, tensor in gaussians.items() if name != "sh_rest"])
    all_finite([tensor for _, tensor in gaussians.items()])
    optimiser.step(gradients, rendered.visible)
    render_cpu(gaussians, camera)
    optimiser.flush()
    optimiser.step(gradients, rendered.visible)
    return time.perf_counter() - begin


def prepare_cpu(threads: int | None, say: Callable[[str], None] = lambda text: None) -> None:
    """Set the threads of the kernels and compile them, once per machine.

    Args:
        threads: of the kernels; None = as many as there are.
        say: told when something is compiled.
    """
    from ambiguous_wild.splat.cpu import set_threads

    if threads is not None:
        set_threads(threads)
    warm_up(say)
