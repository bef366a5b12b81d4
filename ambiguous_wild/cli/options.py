"""Options shared by all commands that train."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from ambiguous_wild.cli.paths import PathName

_OPTIONS = (
    click.option(
        "--seed",
        "seeds",
        multiple=True,
        type=click.IntRange(0),
        default=(0,),
        show_default=True,
        help="Random seed; repeatable.",
    ),
    click.option("--iterations", type=click.IntRange(1), help="Training iterations.  [default: 30000]"),
    click.option(
        "--device",
        type=click.Choice(["auto", "cpu", "cuda"]),
        default="auto",
        show_default=True,
        help="auto: the GPU if torch and gsplat can use one, else the CPU.",
    ),
    click.option("--threads", type=click.IntRange(1), help="CPU threads; they do not change the result."),
    click.option(
        "--factor",
        type=click.IntRange(1),
        help="Train on the photos in images_N, 1/N of their size.  [default: as the scene was built]",
    ),
    click.option(
        "--max-gaussians",
        type=click.IntRange(4),
        help="Growth stops at this number of Gaussians.  [default: the method's]",
    ),
    click.option(
        "--plugin",
        "plugins",
        multiple=True,
        type=PathName(),
        help="Python file that registers your methods; repeatable.",
    ),
    click.option(
        "--overwrite",
        type=click.Choice(["never", "missing", "always"]),
        default="missing",
        show_default=True,
        help="missing: train what is not finished; never: skip existing folders; always: train again.",
    ),
    click.option(
        "--cache",
        type=PathName(),
        help="Folder for features and instance masks.  [default: OUTPUT/.cache]",
    ),
)


def training_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add these options to a click command: seeds, iterations, device, threads, factor, max_gaussians,
    plugins, overwrite, cache."""
    for option in reversed(_OPTIONS):
        command = option(command)
    return command
