"""Options of `aw bench` that say where cells run, and how many at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from ambiguous_wild.harness.running.engines.session import Engine

_OPTIONS = (
    click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True, help="ray: a cluster, see docs/cluster.md."),
    click.option("--jobs", type=click.IntRange(1), help="Cells at a time on this machine; cores and GPUs are divided.  [default: 1; on cuda one a GPU]"),
    click.option("--address", help="Ray: auto, HOST:PORT or ray://HOST:10001.  [default: $RAY_ADDRESS, else this machine]"),
    click.option("--cpus-per-cell", type=click.FloatRange(min=0, min_open=True), help="Ray: CPUs, also the threads.  [default: --threads, else 1]"),
    click.option("--gpus-per-cell", type=click.FloatRange(min=0), help="Ray: GPUs; 0.5 lets two cells share one.  [default: 1 on cuda]"),
    click.option("--memory-per-cell", type=click.FloatRange(min=0), metavar="GB", help="Ray: memory in GB."),
    click.option("--retries", type=click.IntRange(0), default=3, show_default=True, help="How often a cell is run again whose process or node was lost."),
    click.option("--transfer", type=click.Choice(["shared", "store"]), default="shared", show_default=True, help="Ray: -o and scenes lie on shared storage, or travel through Ray's object store."),
    click.option("--transfer-limit", type=click.FloatRange(min=0, min_open=True), default=4000.0, show_default=True, metavar="MB", help="Ray: largest scene or run that travels."),
)  # fmt: skip


def engine_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add them to a click command, as one argument `engine`: an `Engine`."""

    def with_engine(**values: Any) -> Any:
        names = [f for f in Engine.__dataclass_fields__ if f in values]
        return command(engine=Engine(**{name: values.pop(name) for name in names}), **values)

    with_engine.__doc__, with_engine.__name__ = command.__doc__, command.__name__
    # Options added below this one are on the function already.
    with_engine.__dict__.update(command.__dict__)
    wrapped: Callable[..., Any] = with_engine
    for option in reversed(_OPTIONS):
        wrapped = option(wrapped)
    return wrapped
