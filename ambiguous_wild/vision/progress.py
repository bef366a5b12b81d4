"""A bar for stages that take minutes a photo: on a terminal, and nowhere else."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

Bar: TypeAlias = Callable[[Sequence[Any]], Iterable[Any]]


def no_bar(items: Sequence[Any]) -> Iterable[Any]:
    """The items as they are."""
    return items


def terminal_bar(what: str, unit: str = "photo") -> Bar:
    """Wraps a list so that a terminal shows a bar while it is gone through.

    Args:
        what: is done, e.g. ``"instance masks"``.
        unit: one item.
    """

    def wrap(items: Sequence[Any]) -> Iterable[Any]:
        try:
            from tqdm import tqdm
        except ImportError:  # a machine that only trains has little installed
            return items
        return tqdm(items, desc=what, unit=unit, disable=None, leave=False)  # None: only on a terminal

    return wrap
