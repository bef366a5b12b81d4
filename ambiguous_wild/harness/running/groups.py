"""Groups of cells in one output: a folder for each length and choice of effects."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from ambiguous_wild.harness.running.cell import Cell


def grouped(planned: Mapping[str, Sequence[Cell]], budgets_s: Sequence[float] = ()) -> list[Cell]:
    """Every cell with every budget, the shortest budget first, with the name of its group.

    A single budget or choice of effects gets no folder of its own.

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
