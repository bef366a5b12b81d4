"""How long work shows its progress: a function that wraps its items, as tqdm does; `iter` shows none."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

Progress: TypeAlias = Callable[[Sequence[Any]], Iterable[Any]]


def terminal_bar(what: str) -> Progress:
    """Return a function that wraps a list of photos, so that a terminal shows a bar during iteration.

    `what` is the name of the stage, e.g. ``"instance masks"``.
    """

    def wrap(items: Sequence[Any]) -> Iterable[Any]:
        from tqdm import tqdm

        return tqdm(items, desc=what, unit="photo", disable=None, leave=False)  # None: only on a terminal

    return wrap
