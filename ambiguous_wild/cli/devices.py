"""Where a command computes: CPU or GPU, and the kernels made ready."""

from __future__ import annotations

import click


def choose_device(device: str) -> str:
    """ "auto" is the GPU where torch and gsplat can both use one; one that lies idle is said on stderr.

    Compiles gsplat's kernels where they are not yet.

    Raises:
        AwError: cuda was asked for and is not usable; says what is missing.
    """
    if device == "cpu":
        return "cpu"
    from ambiguous_wild.splat.cuda_ready import choose

    return choose(device, lambda text: click.echo(text, err=True))


def prepare_cpu(threads: int | None) -> None:
    """Set the threads of the kernels and compile them, once per machine."""
    from ambiguous_wild.splat.cpu import set_threads
    from ambiguous_wild.splat.cpu.warmup import warm_up

    if threads is not None:
        set_threads(threads)
    warm_up(lambda text: click.echo(text, err=True))
