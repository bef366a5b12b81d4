"""The length of a run as text, and the `aw bench` command that makes a run. Imports no torch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any


def length_text(iterations: int | None, budget_s: float | None) -> str:
    """Return the length that was asked for, "60 s" or "2000 iterations"; empty if it is not known."""
    if budget_s is not None:
        return f"{budget_s:g} s"
    return "" if iterations is None else f"{iterations} iterations"


def length_options(iterations: int | None, budget_s: float | None) -> list[str]:
    """Return the length as options of a command, --iterations or --budget; to the microsecond."""
    if budget_s is None:
        return ["--iterations", str(iterations)]
    return ["--budget", f"{budget_s:.6f}".rstrip("0").rstrip(".") + "s"]


def option_text(value: Any) -> str:
    """Return the value of an option as `--set` reads it."""
    if isinstance(value, (list, tuple)):
        return ",".join(map(option_text, value))
    return "none" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def bench_command(
    method: Sequence[str], scene: str, seed: int, length: Sequence[str], options: Iterable[tuple[str, object]]
) -> list[str]:
    """Return the words of the `aw bench` command of one run.

    Args:
        method: options that name the method, ("--method", NAME).
        scene: its folder or name.
        seed: seed of the training.
        length: from `length_options`.
        options: further options with their values; those with None are left out.
    """
    words = ["aw", "bench", *method, "--scene", scene, "--seed", str(seed), *length]
    return words + [word for option, value in options if value is not None for word in (option, str(value))]
