"""Write tables as text for a terminal, as Markdown and as CSV.

Names of methods and scenes come from other people's files. In every format they remain text: control
characters and invisible direction marks are escaped, so that a name cannot control a terminal either.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.names import csv_text, plain
from ambiguous_wild.harness.chosen_effects import MIXED
from ambiguous_wild.harness.measures import MEASURES, Measure
from ambiguous_wild.io.terminal import display_width, wrapped
from ambiguous_wild.report.table_layout import ARROWS, TIE, Column, Row, Table, TableCell

RANKS = "(1) (2) (3): first, second and third in the column"
COLORS = {1: "green", 2: "cyan", 3: "yellow"}  # of the terminal
LONG_HEAD = ("table", "kind", "method", "dataset", "column", "scene", "metric", "value", "std", "rank",
             "not_significant", "status", "printed", "note")  # fmt: skip
UNEQUAL = "not comparable"  # begins a note that every format with ranks shows
WIDTH = 100
# The most important columns; others follow in the order of the table.
FIRST = (
    "psnr", "psnr_consistent", "effects", "lpips_alex", "ssim", "mask_iou", "train_s", "psnr_covered",
    "gaussians", "lpips_vgg", "flip", "fps", "model_mb",
)  # fmt: skip
UNFITTED = "colours of test photos are not fitted"  # begins a note, with which PSNR affine comes second


def marked(cell: TableCell, measure: Measure) -> str:
    """Return the cell's text with its rank and the mark of a tie with the best."""
    text = plain(cell.text(measure))
    return text + (f" ({cell.rank})" if cell.rank else "") + (f" {TIE}" if cell.tie else "")


def row_name(row: Row) -> str:
    """Return the name of a row; reported rows are indented."""
    return plain(f"  {row.name}" if row.kind == "reported" else row.name)


def to_text(tables: Sequence[Table], *, color: bool = False, width: int | None = None) -> str:
    """Return tables as aligned text.

    Args:
        tables: the tables.
        color: colour the three best.
        width: columns at which titles and the lines below a table are broken; None: each stays one line.
    """
    parts = []
    for table, below in _with_below(tables):
        parts += [wrapped(plain(table.title), width), *_aligned(table, color), ""]
        parts += [*(wrapped(plain(line), width) for line in below), ""] if below else []
    return "\n".join(parts).rstrip("\n") + "\n"


def _with_below(tables: Sequence[Table]) -> Iterator[tuple[Table, list[str]]]:
    """Yield every table with the lines below it: the meaning of its marks, and notes."""
    before: list[Table] = []
    for table in tables:
        before.append(table)
        if table.continued:
            yield table, []
            continue
        ranks = [RANKS] if any(cell.rank for one in before for cell in one.cells) else []
        legend = dict.fromkeys(line for one in before for line in one.legend)
        yield table, [*ranks, *legend, *(note for one in before for note in one.notes)]
        before = []


def _aligned(table: Table, color: bool) -> list[str]:
    head = [table.head, *(plain(column.label) for column in table.columns)]
    body = [
        [row_name(row), *(marked(e, c.measure) for c, e in zip(table.columns, row.cells))]
        for row in table.rows
    ]
    widths = [max(display_width(line[i]) for line in [head, *body]) for i in range(len(head))]
    top, at = [" " * widths[0]], 1
    for title, count in table.groups:
        room = sum(widths[at : at + count]) + 2 * (count - 1)
        name = plain(title)
        missing = max(display_width(name) - room, 0)
        widths[at] += missing  # a long name widens its first column
        top.append(name + " " * (room + missing - display_width(name)))
        at += count
    lines = ["  ".join(top).rstrip()] if any(title for title, _ in table.groups) else []
    lines += [_text_row(head, widths), "  ".join("─" * w for w in widths)]
    before = "measured"
    for row, cells in zip(table.rows, body):
        lines += ["reported:"] if row.kind != before else []
        before = row.kind
        lines.append(_text_row(cells, widths, [cell.rank for cell in row.cells] if color else None))
    return lines


def _text_row(cells: Sequence[str], widths: Sequence[int], ranks: Sequence[int | None] | None = None) -> str:
    out = [cells[0] + " " * (widths[0] - display_width(cells[0]))]
    for i, (cell, width) in enumerate(zip(cells[1:], widths[1:])):
        gap = " " * (width - display_width(cell))
        if ranks is not None and ranks[i]:
            import click

            cell = click.style(cell, fg=COLORS[ranks[i] or 1], bold=ranks[i] == 1)
        out.append(gap + cell)
    return "  ".join(out).rstrip()


def to_markdown(tables: Sequence[Table]) -> str:
    """Return tables as GitHub Markdown; the best of a column is bold, the three best are numbered."""
    parts = []
    for table, below in _with_below(tables):
        parts += [f"**{markdown_text(table.title)}**", ""] if table.title else []
        head = [
            f"{markdown_text(c.group)} {markdown_text(c.name)} {ARROWS[c.measure.better]}".strip()
            for c in table.columns
        ]
        parts.append(_markdown_row([table.head, *head]))
        parts.append("|---|" + "".join("---|" if c.words else "---:|" for c in table.columns))
        for row in table.rows:
            name = markdown_text(row.name) + (" (reported)" if row.kind == "reported" else "")
            cells = [_markdown(cell, column) for column, cell in zip(table.columns, row.cells)]
            parts.append(_markdown_row([name, *cells]))
        parts += ["", *(f"- {markdown_text(text)}" for text in below), *([""] if below else [])]
    return "\n".join(parts).rstrip("\n") + "\n"


def markdown_text(text: str) -> str:
    """Return the text escaped for a GitHub table: it cannot make HTML, a link or a new column."""
    text = plain(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([\\`*_\[\]|~#$])", r"\\\1", text)
    # GitHub makes links of addresses without any brackets
    return re.sub(r"(?i)\b(https?|ftp|www)(:|\.)", r"\1&#8203;\2", text)


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _markdown(cell: TableCell, column: Column) -> str:
    if cell.markdown:
        return cell.markdown.replace("|", "\\|")
    text = marked(cell, column.measure)
    if not re.fullmatch(r"[-\d.,%\[\]{}— ]*", text):  # numbers and intervals stay as they are
        text = markdown_text(text)
    if cell.rank != 1:
        return text
    value, _, mark = text.rpartition(" (")
    return f"**{value}** ({mark}"


def exact(value: float) -> str:
    """Return digits that read back as the same number: 3.0 for 3.0."""
    return repr(float(value))


def shortest(value: float) -> str:
    """Return the fewest digits that read back as the same number: 3 for 3.0."""
    whole = math.isfinite(value) and value == int(value) and abs(value) < 2**53
    return str(int(value)) if whole else exact(value)


def to_csv(
    head: Sequence[str],
    rows: Iterable[Iterable[Any]],
    *,
    text: Callable[[str], str] = csv_text,
    number: Callable[[float], str] = exact,
) -> str:
    """Return CSV of texts, numbers, yes and no; None and NaN become empty cells.

    Args:
        head: names of the columns.
        rows: values, one for each column.
        text: escapes a text that a spreadsheet would calculate.
        number: formats a float.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([text(name) for name in head])
    for row in rows:
        writer.writerow([_csv_cell(value, text, number) for value in row])
    return out.getvalue()


def _csv_cell(value: Any, text: Callable[[str], str], number: Callable[[float], str]) -> str:
    if value is None or value == "":
        return ""
    if isinstance(value, str):
        return text(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "" if math.isnan(value) else number(value)
    return str(value)


def read_csv(
    path: Path, required: Sequence[str], most_bytes: int, advice: str
) -> tuple[list[str], list[tuple[int, dict[str, str]]]]:
    """Read a CSV file; return its columns, and (line, cells by column) of each row, cells unchanged.

    Args:
        path: the file.
        required: columns that it must have.
        most_bytes: a larger file is not read.
        advice: end of every error message.

    Raises:
        AwError: the file is unreadable or malformed, or lacks a required column.
    """
    try:
        if path.stat().st_size > most_bytes:
            raise AwError(f"{path} is larger than {most_bytes // 1_000_000} MB; {advice}")
        with open(path, newline="", encoding="utf-8-sig") as f:
            reader = csv.reader(f, strict=True)
            head = next(reader, [])
            rows = [(reader.line_num, cells) for cells in reader if cells]
    except UnicodeDecodeError:
        raise AwError(f"{path} is no text in UTF-8: save it as CSV in UTF-8; {advice}") from None
    except csv.Error as error:
        raise AwError(f"{path} is malformed CSV ({error}); {advice}") from None
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror}") from None
    missing = [column for column in required if column not in head]
    named = [column for column in head if column]  # spreadsheets add columns without a name at the end
    if missing or len(set(named)) != len(named):
        what = f"lacks the column {shortlist(missing)}" if missing else "names a column twice"
        raise AwError(f"{path} {what}; {advice}")
    for line, cells in rows:
        if len(cells) != len(head):
            raise AwError(f"{path} line {line} has too few or too many cells; {advice}")
    return head, [(line, dict(zip(head, cells))) for line, cells in rows]


def to_long_csv(tables: Sequence[Table]) -> str:
    """Return CSV with one number per row; measured numbers have a value, reported ones only `printed`.

    `note` says why ranks of the table may not be due to the methods; it is empty if runs differ in nothing.
    """
    rows = (
        (
            table.title, row.kind, row.name, column.dataset, column.group, column.scene, column.measure.key,
            cell.value, cell.spread, cell.rank, "yes" if cell.tie else "",
            "" if cell.printed else cell.state, cell.printed, _limits(table),
        )
        for table in tables
        for row in table.rows
        for column, cell in zip(table.columns, row.cells)
        if cell.state != "blank"
    )  # fmt: skip
    return to_csv(LONG_HEAD, rows)


def _limits(table: Table) -> str:
    return "; ".join(note for note in table.notes if note.startswith((UNEQUAL, MIXED)))


def to_wide_csv(tables: Sequence[Table]) -> str:
    """Return CSV with one row per scene and method, for tables with the same columns; means have no scene.

    Every column has the mean, `_std` over seeds, and for image metrics `_low` and `_high`, the 95 %
    interval over the test images of one scene, and `_tied`, "yes" if not significantly below the best. The
    last column is `note`, as in `to_long_csv`.
    """
    head = ["scene", "method", "status", "runs"]
    for column in tables[0].columns:
        key = column.measure.key
        head += [key] if column.words else [key, f"{key}_std"]
        head += [f"{key}_low", f"{key}_high", f"{key}_tied"] if column.measure.per_image else []
    note = _limits(tables[-1])
    rows = (
        [table.columns[0].scene, row.name, _status(row), row.runs, *_wide_values(table, row), note]
        for table in tables
        for row in table.rows
    )
    return to_csv([*head, "note"], rows, number=shortest)


def _wide_values(table: Table, row: Row) -> Iterator[float | str]:
    for column, cell in zip(table.columns, row.cells):
        yield from (cell.printed,) if column.words else (cell.value, cell.spread)
        yield from (cell.low, cell.high, "yes" if cell.tie else "") if column.measure.per_image else ()


def _status(row: Row) -> str:
    states = {cell.state for cell in row.cells}
    return next((s for s in ("failed", "absent", "ok") if s in states), "missing")


def fitted(tables: Sequence[Table], width: int = WIDTH) -> list[Table]:
    """Reduce tables with the same columns to the most important ones that fit, in their order.

    A note below the last table names the others. At least one column is kept, however long the names are.
    """
    columns = tables[0].columns
    names = [tables[0].head, *(row_name(row) for table in tables for row in table.rows)]  # with their head
    left = width - max(map(display_width, names))
    unfitted = any(note.startswith(UNFITTED) for note in tables[-1].notes)
    first = (FIRST[0], "psnr_affine", *FIRST[1:]) if unfitted else FIRST
    ranged = [any(row.cells[i].ranged for table in tables for row in table.rows) for i in range(len(columns))]
    # a time that is not ranked tells less than any other column
    order = sorted(range(len(columns)), key=lambda i: (ranged[i], _importance(columns[i].measure, first), i))
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
    note = f"not shown, to fit {width} columns: {', '.join(out)}; --metric all shows them"
    return [*shown[:-1], shown[-1].with_notes(note)]


def _importance(column: Measure, first: Sequence[str]) -> int:
    if column.per_image and column.key not in MEASURES:
        return 0  # a user's own metric comes first
    return first.index(column.key) if column.key in first else len(first)


def divided(table: Table, width: int) -> list[Table]:
    """Divide the table into tables that fit; columns with one heading stay together if possible."""
    room = width - max(map(display_width, [table.head, *map(row_name, table.rows)]))
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
    """Return part `k` of a table; only the last part has notes."""
    title = f"{table.title}, part {k + 1} of {count}" if count > 1 else table.title
    return replace(table.picked(columns), title=title, notes=table.notes if k == count - 1 else ())


def _column_width(table: Table, i: int) -> int:
    column = table.columns[i]
    cells = [marked(row.cells[i], column.measure) for row in table.rows]
    return 2 + max(display_width(text) for text in (column.label, *cells))
