"""Where a command computes: CPU or GPU, and the kernels made ready."""

from __future__ import annotations

import click

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.extras import install_command


def choose_device(device: str) -> str:
    """ "auto" is the GPU where torch and gsplat can both use one.

    Raises:
        AwError: cuda was asked for and is not usable; says what is missing.
    """
    if device == "cpu":
        return "cpu"
    import importlib.util

    import torch

    has_gpu = torch.cuda.is_available()
    has_gsplat = importlib.util.find_spec("gsplat") is not None
    if has_gpu and has_gsplat:
        return "cuda"
    if device == "auto":
        return "cpu"
    what = "torch sees no GPU" if not has_gpu else f"gsplat is not installed: {install_command('cuda')}"
    raise AwError(f"--device cuda: {what}; 'aw doctor' tells more, --device cpu runs without")


def prepare_cpu(threads: int | None) -> None:
    """Set the threads of the kernels and compile them, once per machine."""
    from ambiguous_wild.splat.cpu import set_threads
    from ambiguous_wild.splat.cpu.warmup import warm_up

    if threads is not None:
        set_threads(threads)
    warm_up(lambda text: click.echo(text, err=True))
