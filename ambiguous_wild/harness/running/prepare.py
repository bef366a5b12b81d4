"""Make the CPU kernels ready before a run."""

from __future__ import annotations

from collections.abc import Callable


def prepare_cpu(threads: int | None, say: Callable[[str], None] = lambda text: None) -> None:
    """Set the threads of the kernels and compile them, once per machine.

    Args:
        threads: of the kernels; None = as many as there are.
        say: told when something is compiled.
    """
    from ambiguous_wild.splat.cpu import set_threads
    from ambiguous_wild.splat.cpu.warmup import warm_up

    if threads is not None:
        set_threads(threads)
    warm_up(say)
