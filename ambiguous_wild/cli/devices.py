"""Choice of CPU or GPU, and compilation of the kernels."""

from __future__ import annotations

import click


def choose_device(device: str) -> str:
    """The device for "cpu", "cuda" or "auto": auto is the GPU if torch and gsplat can use one.

    Compiles gsplat's kernels if needed; reports a GPU that cannot be used on stderr.

    Raises:
        AwError: cuda was requested but is not usable; names what is missing.
    """
    if device == "cpu":
        return "cpu"
    from ambiguous_wild.splat.readiness import choose

    return choose(device, lambda text: click.echo(text, err=True))


def prepare_cpu(threads: int | None) -> None:
    """Set the number of threads and compile the CPU kernels, once per machine."""
    from ambiguous_wild.splat.calibration import warm_up
    from ambiguous_wild.splat.cpu import set_threads

    if threads is not None:
        set_threads(threads)
    warm_up(lambda text: click.echo(text, err=True))
