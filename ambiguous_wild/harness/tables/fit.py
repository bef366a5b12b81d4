"""Tables for a terminal: the columns that fit its width, or several tables for all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.tables.plain_formats import display_width, marked, plain, row_name
from ambiguous_wild.harness.tables.table import Table

WIDTH = 100
# What is shown first; what is not listed comes after, in the order of the table.
FIRST = (
    "psnr", "lpips_alex", "train_s", "ssim", "mask_iou", "psnr_covered", "gaussians", "lpips_vgg", "flip",
    "fps", "model_mb",
)  # fmt: skip


def fitted(tables: Sequence[Table], width: int = WIDTH) -> list[Table]:
    """Tables of the same columns with the most important ones that fit, in their order.

    A note below the last table names the others. At least one column is kept, however long the names are.
    """
    columns = tables[0].columns
    left = width - max(display_width(row_name(row)) for table in tables for row in table.rows)
    order = sorted(range(len(columns)), key=lambda i: (_importance(columns[i].measure), i))
    kept: list[int] = []
    for i in order:
        need = max(_column_width(table, i) for table in tables)
        if kept and need > left:
            continue
        kept.append(i)
        left -= need
    out = [column.measure.label for i, column in enumerate(columns) if i not in kept]
    if not out:
        return list(tables)
    shown = [table.picked(sorted(kept)) for table in tables]
    note = f"not shown, to fit {width} columns: {', '.join(out)}; --all shows them"
    return [*shown[:-1], shown[-1].with_notes(note)]


def _importance(column: Measure) -> int:
    return FIRST.index(column.key) if column.key in FIRST else len(FIRST)


def divided(table: Table, width: int = WIDTH) -> list[Table]:
    """The table as tables that fit: columns of one heading stay together where they can."""
    room = width - max((display_width(row_name(row)) for row in table.rows), default=0)
    parts: list[list[int]] = [[]]
    left, at = room, 0
    for title, count in table.groups:
        group = list(range(at, at + count))
        at += count
        needs = [_column_width(table, i) for i in group]
        needs[0] += max(0, display_width(plain(title)) + 2 - sum(needs))
        if parts[-1] and sum(needs) > left:
            parts.append([])
            left = room
        for i, need in zip(group, needs):
            if parts[-1] and need > left:
                parts.append([])
                left = room
            parts[-1].append(i)
            left -= need
    return [_part(table, columns, k, len(parts)) for k, columns in enumerate(parts)]


def _part(table: Table, columns: list[int], k: int, count: int) -> Table:
    """Notes stand below the last part."""
    title = f"{table.title}, part {k + 1} of {count}" if count > 1 else table.title
    return replace(table.picked(columns), title=title, notes=table.notes if k == count - 1 else ())


def _column_width(table: Table, i: int) -> int:
    column = table.columns[i]
    cells = [marked(row.cells[i], column.measure) for row in table.rows]
    return 2 + max(display_width(text) for text in (column.label, *cells))
