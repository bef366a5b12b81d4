"""Laid-out tables as text, Markdown and CSV. Names stay text in each."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence

from ambiguous_wild.harness.tables.layouts.grid import TIE, Layout, LayoutCell, Line
from ambiguous_wild.harness.tables.render import COLORS, csv_text, display_width, markdown_text, plain

RANKS = "(1) (2) (3): first, second and third of the column"


def to_text(layouts: Sequence[Layout], *, color: bool = False) -> str:
    """Aligned for a terminal; with `color`, the three best are coloured."""
    parts = []
    for layout in layouts:
        parts += [plain(layout.title), *_aligned(layout, color), "", *_below(layout), ""]
    return "\n".join(parts).rstrip("\n") + "\n"


def _aligned(layout: Layout, color: bool) -> list[str]:
    head = ["method", *(column.label for column in layout.columns)]
    body = [
        [row_name(line), *(marked(e, c.measure) for c, e in zip(layout.columns, line.entries))]
        for line in layout.lines
    ]
    widths = [max(display_width(line[i]) for line in [head, *body]) for i in range(len(head))]
    top, at = [" " * widths[0]], 1
    for title, count in layout.groups:
        room = sum(widths[at : at + count]) + 2 * (count - 1)
        name = plain(title)
        if display_width(name) > room:  # a long name makes room for itself
            widths[at] += display_width(name) - room
            room = display_width(name)
        top.append(name + " " * (room - display_width(name)))
        at += count
    lines = ["  ".join(top).rstrip()] if any(title for title, _ in layout.groups) else []
    lines += [_row(head, widths), "  ".join("─" * w for w in widths)]
    for line, cells in zip(layout.lines, body):
        if line.kind == "reported" and not any("reported:" in text for text in lines):
            lines.append("reported:")
        lines.append(_row(cells, widths, [e.rank for e in line.entries] if color else None))
    return lines


def _row(cells: Sequence[str], widths: Sequence[int], ranks: Sequence[int | None] | None = None) -> str:
    out = [cells[0] + " " * (widths[0] - display_width(cells[0]))]
    for i, (cell, width) in enumerate(zip(cells[1:], widths[1:])):
        gap = " " * (width - display_width(cell))
        if ranks is not None and ranks[i]:
            import click

            cell = click.style(cell, fg=COLORS[ranks[i] or 1], bold=ranks[i] == 1)
        out.append(gap + cell)
    return "  ".join(out).rstrip()


def marked(entry: LayoutCell, measure: object) -> str:
    """The cell with its rank and whether it is told apart from the best."""
    text = entry.text(measure)  # type: ignore[arg-type]
    return text + (f" ({entry.rank})" if entry.rank else "") + (f" {TIE}" if entry.tie else "")


def row_name(line: Line) -> str:
    """What stands in front of a row of text."""
    return plain(f"  {line.name}" if line.kind == "reported" else line.name)


def _below(layout: Layout) -> list[str]:
    ranks = [RANKS] if any(e.rank for line in layout.lines for e in line.entries) else []
    return [*ranks, *layout.legend, *(plain(note) for note in layout.notes)]


def to_markdown(layouts: Sequence[Layout]) -> str:
    """GitHub tables; the best of a column is bold, the three best are numbered."""
    parts = []
    for layout in layouts:
        parts += [f"**{markdown_text(layout.title)}**", ""]
        head = [f"{markdown_text(c.group)} {c.label}".strip() for c in layout.columns]
        parts += ["| " + " | ".join(["method", *head]) + " |", "|---|" + "---:|" * len(head)]
        for line in layout.lines:
            name = markdown_text(line.name) + (" (reported)" if line.kind == "reported" else "")
            cells = [_bold(marked(e, c.measure), e) for c, e in zip(layout.columns, line.entries)]
            parts.append("| " + " | ".join([name, *cells]) + " |")
        parts += ["", *(f"- {markdown_text(text)}" for text in _below(layout)), ""]
    return "\n".join(parts).rstrip("\n") + "\n"


def _bold(text: str, entry: LayoutCell) -> str:
    if entry.rank != 1:
        return text
    value, _, mark = text.rpartition(" (")
    return f"**{value}** ({mark}"


HEAD = ("table", "kind", "method", "dataset", "column", "scene", "metric", "value", "std", "rank",
        "not_significant", "status", "printed")  # fmt: skip


def to_csv(layouts: Sequence[Layout]) -> str:
    """One number a row. What was measured has a value, what a paper prints is under `printed` alone."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(HEAD)
    for layout in layouts:
        for line in layout.lines:
            for column, entry in zip(layout.columns, line.entries):
                if entry.state == "blank":
                    continue
                words = (layout.title, line.kind, line.name, column.dataset, column.group, column.scene)
                status = "" if entry.printed else entry.state
                writer.writerow([
                    *map(csv_text, (*words, column.measure.key)), _number(entry.value), _number(entry.spread),
                    entry.rank or "", "yes" if entry.tie else "", status, csv_text(entry.printed),
                ])  # fmt: skip
    return out.getvalue()


def _number(value: float) -> str:
    return "" if math.isnan(value) else repr(float(value))
