"""A progress bar for slow stages, shown only on a terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

Bar: TypeAlias = Callable[[Sequence[Any]], Iterable[Any]]


def no_bar(items: Sequence[Any]) -> Iterable[Any]:
    """The items, without a bar."""
    return items


def terminal_bar(what: str, unit: str = "photo") -> Bar:
    """A function that wraps a list so that a terminal shows a bar during iteration.

    Args:
        what: name of the stage, e.g. ``"instance masks"``.
        unit: name of one item.
    """

    def wrap(items: Sequence[Any]) -> Iterable[Any]:
        from tqdm import tqdm

        return tqdm(items, desc=what, unit=unit, disable=None, leave=False)  # None: only on a terminal

    return wrap
