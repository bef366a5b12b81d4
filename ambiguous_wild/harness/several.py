"""One output for several lengths and several choices of effects: each has a folder of its own in it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from ambiguous_wild.harness.cell import Cell


def grouped(planned: Mapping[str, Sequence[Cell]], budgets_s: Sequence[float] = ()) -> list[Cell]:
    """Every cell with every budget, the shortest budget first, under a folder that says what it is.

    What there is but one of names no folder: a command with one budget writes where it always did.

    Args:
        planned: cells by the effects they were asked for.
        budgets_s: seconds of training; empty = as the cells have it.
    """
    cells = []
    lengths: list[float | None] = [*sorted(set(budgets_s))]
    for seconds in lengths or [None]:
        for effects, members in planned.items():
            group = [f"budget-{seconds:g}s"] if len(lengths) > 1 else []
            group += [f"effects-{effects.replace(' ', '').replace(',', '+')}"] if len(planned) > 1 else []
            cells += [_moved(cell, seconds, "/".join(group)) for cell in members]
    return cells


def _moved(cell: Cell, seconds: float | None, group: str) -> Cell:
    train = cell.train if seconds is None else dataclasses.replace(cell.train, budget_s=seconds)
    return dataclasses.replace(cell, train=train, group=group)
