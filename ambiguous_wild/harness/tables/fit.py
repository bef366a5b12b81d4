"""Tables for a terminal: the columns that fit its width; wide layouts become several tables."""

from __future__ import annotations

from dataclasses import replace

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.tables.comparison import Table, selected
from ambiguous_wild.harness.tables.layouts.grid import Layout
from ambiguous_wild.harness.tables.layouts.plain_formats import marked, row_name
from ambiguous_wild.harness.tables.render import ARROWS, display_width, number, plain

WIDTH = 100
# What is shown first; what is not listed comes after, in the order of the table.
FIRST = (
    "psnr", "lpips_alex", "train_s", "ssim", "mask_iou", "psnr_covered", "gaussians", "lpips_vgg", "flip",
    "fps", "model_mb",
)  # fmt: skip


def fitted(table: Table, width: int = WIDTH) -> Table:
    """The table with the most important columns that fit, in their order; a note names the others.

    At least one column is kept, however long the names are.
    """
    left = width - max(display_width(plain(r.method)) for b in table.blocks for r in b.rows)
    order = sorted(range(len(table.columns)), key=lambda i: (_importance(table.columns[i]), i))
    kept: list[int] = []
    for i in order:
        need = 2 + _width(table, i)
        if kept and need > left:
            continue
        kept.append(i)
        left -= need
    out = [c.label for i, c in enumerate(table.columns) if i not in kept]
    if not out:
        return table
    columns, blocks = selected(table.columns, table.blocks, sorted(kept))
    note = f"not shown, to fit {width} columns: {', '.join(out)}; --all shows them"
    return replace(table, columns=columns, blocks=tuple(blocks), notes=(*table.notes, note))


def _importance(column: Measure) -> int:
    return FIRST.index(column.key) if column.key in FIRST else len(FIRST)


def _width(table: Table, i: int) -> int:
    column = table.columns[i]
    cells = [number(column, row.cells[i]) for block in table.blocks for row in block.rows]
    return max(display_width(t) for t in (f"{column.label}{ARROWS[column.better]}", *cells))


def divided(layout: Layout, width: int = WIDTH) -> list[Layout]:
    """The layout as tables that fit: columns of one heading stay together where they can."""
    room = width - max((display_width(row_name(line)) for line in layout.lines), default=0)
    parts: list[list[int]] = [[]]
    left, at = room, 0
    for title, count in layout.groups:
        group = list(range(at, at + count))
        at += count
        needs = [_layout_width(layout, i) for i in group]
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
    return [_part(layout, columns, k, len(parts)) for k, columns in enumerate(parts)]


def _part(layout: Layout, columns: list[int], k: int, count: int) -> Layout:
    """Notes stand below the last part."""
    title = f"{layout.title}, part {k + 1} of {count}" if count > 1 else layout.title
    lines = tuple(replace(line, entries=tuple(line.entries[i] for i in columns)) for line in layout.lines)
    notes = layout.notes if k == count - 1 else ()
    return replace(
        layout, title=title, columns=tuple(layout.columns[i] for i in columns), lines=lines, notes=notes
    )


def _layout_width(layout: Layout, i: int) -> int:
    column = layout.columns[i]
    cells = [marked(line.entries[i], column.measure) for line in layout.lines]
    return 2 + max(display_width(text) for text in (column.label, *cells))
