"""Options of `aw bench` that say where cells run, and how many at a time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from ambiguous_wild.harness.running.engines.session import Engine

_OPTIONS = (
    click.option("--engine", type=click.Choice(["local", "ray"]), default="local", show_default=True,
                 help="local: this machine; ray: Ray, also on a cluster (docs/cluster.md)."),
    click.option("--jobs", type=click.IntRange(1),
                 help="Runs at a time on this machine; they share cores.  [default: 1; on cuda one per GPU]"),
    click.option("--address",
                 help="Ray: auto, HOST:PORT, ray://HOST:10001.  [default: $RAY_ADDRESS, else this machine]"),
    click.option("--cpus-per-cell", type=click.FloatRange(min=0, min_open=True),
                 help="Ray: CPUs per run, also its threads.  [default: --threads, else 1]"),
    click.option("--gpus-per-cell", type=click.FloatRange(min=0),
                 help="Ray: GPUs per run; with 0.5 two runs share one.  [default: 1 on cuda]"),
    click.option("--memory-per-cell", type=click.FloatRange(min=0), metavar="GB",
                 help="Ray: memory per run."),
    click.option("--retries", type=click.IntRange(0), default=3, show_default=True,
                 help="How often to repeat a run whose process or node was lost."),
    click.option("--transfer", type=click.Choice(["shared", "store"]), default="shared", show_default=True,
                 help="Ray: shared: -o and scenes are on shared storage; store: they are sent through Ray."),
    click.option("--transfer-limit", type=click.FloatRange(min=0, min_open=True), default=4000.0,
                 show_default=True, metavar="MB", help="Ray: largest scene or run that is sent through Ray."),
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
