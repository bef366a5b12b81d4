"""A `Table` as text, Markdown, CSV or LaTeX.

Names of methods and scenes come from others' files: in every format they stay text. Control characters
and invisible direction marks are written out, so that a name cannot steer a terminal either.
"""

from __future__ import annotations

import csv
import io
import math
import re
import unicodedata
from collections.abc import Callable, Sequence

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.running.timing import seconds_range
from ambiguous_wild.harness.tables.comparison import Block, Row, Table, TableCell

STATES = {"missing": "—", "failed": "failed", "absent": "no run"}
ARROWS = {"higher": "↑", "lower": "↓", None: ""}
LEGEND = "(1) (2) (3): first, second and third in the column"
MARK_WIDTH = len(" (1)")
COLORS = {1: "green", 2: "cyan", 3: "yellow"}  # of the terminal
LATEX_COLORS = (("awfirst", "1,0.75,0.75"), ("awsecond", "1,0.87,0.72"), ("awthird", "1,0.98,0.72"))


def plain(text: str) -> str:
    """The text on one line, with control and format characters written as escapes."""
    hidden = ("Cc", "Cf", "Zl", "Zp", "Cs")
    return "".join(
        c.encode("unicode_escape").decode() if unicodedata.category(c) in hidden else c for c in str(text)
    )


def number(column: Measure, cell: TableCell, *, mark: bool = True) -> str:
    """What the cell shows: value, deviation over seeds, rank; or its state."""
    if cell.state != "ok":
        return STATES[cell.state]
    if cell.ranged:
        return seconds_range([cell.low, cell.high], column.digits)
    text = f"{cell.value:.{column.digits}f}"
    if not math.isnan(cell.spread) and column.quality:
        text += f" ± {cell.spread:.{column.digits}f}"
    return f"{text} ({cell.rank})" if mark and cell.rank else text


def heading(table: Table, block: Block) -> str:
    """Name of the block: the scene, or what the mean is over."""
    return table.title if block.scene is None else block.scene


def to_text(table: Table, *, color: bool = False) -> str:
    """Aligned columns for a terminal, one block a scene; with `color`, the three best are coloured."""
    parts = []
    for block in table.blocks:
        head = ["method", *(f"{c.label}{ARROWS[c.better]}" for c in table.columns)]
        lines = [
            [plain(r.method), *(number(c, cell) for c, cell in zip(table.columns, r.cells))]
            for r in block.rows
        ]
        widths = [max(display_width(line[i]) for line in [head, *lines]) for i in range(len(head))]
        parts.append(plain(heading(table, block)))
        parts.append(_aligned(head, widths))
        parts.append("  ".join("─" * w for w in widths))
        for row, line in zip(block.rows, lines):
            ranks = [None, *(cell.rank for cell in row.cells)]
            parts.append(_aligned(line, widths, ranks if color else None))
        parts.append("")
    return "\n".join([*parts, *_below(table)]) + "\n"


def to_markdown(table: Table) -> str:
    """GitHub tables, one a block; the best of a column is bold, the three best are numbered."""
    parts = []
    for block in table.blocks:
        parts += [f"**{markdown_text(heading(table, block))}**", ""]
        parts.append(
            _markdown_row(["method", *(f"{c.label} {ARROWS[c.better]}".strip() for c in table.columns)])
        )
        parts.append("|---|" + "---:|" * len(table.columns))
        for row in block.rows:
            cells = [_bold(number(c, cell), cell) for c, cell in zip(table.columns, row.cells)]
            parts.append(_markdown_row([markdown_text(row.method), *cells]))
        parts.append("")
    return "\n".join([*parts, *(f"- {markdown_text(line)}" for line in _below(table))]) + "\n"


def to_csv(table: Table) -> str:
    """One row a scene and method, plain numbers, empty = missing; the mean has an empty scene.

    For every column: the mean, `_std` over seeds, and for image metrics of one scene `_low` and `_high`,
    the 95 % bootstrap interval over its test images.
    """
    head = ["scene", "method", "status", "runs"]
    for column in table.columns:
        head += [column.key, f"{column.key}_std"]
        head += [f"{column.key}_low", f"{column.key}_high"] if column.per_image else []
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([csv_text(name) for name in head])
    for block in table.blocks:
        for row in block.rows:
            cells = [csv_text(block.scene or ""), csv_text(row.method), _status(row), str(row.runs)]
            for column, cell in zip(table.columns, row.cells):
                values = [cell.value, cell.spread, *([cell.low, cell.high] if column.per_image else [])]
                cells += [_csv_number(v) for v in values]
            writer.writerow(cells)
    return out.getvalue()


def to_latex(table: Table) -> str:
    """A booktabs tabular laid out as in the field's papers: scenes side by side, cost at the end.

    Needs booktabs, graphicx and xcolor with the option `table`.
    """
    quality = [i for i, c in enumerate(table.columns) if c.quality]
    cost = [i for i in range(len(table.columns)) if i not in quality]
    # The mean goes last, as a paper has it.
    blocks = [*table.blocks[1:], table.blocks[0]] if len(table.blocks) > 1 else list(table.blocks)
    groups = [(heading(table, b), b, quality) for b in blocks if quality]
    groups += [("cost" if quality else heading(table, blocks[-1]), blocks[-1], cost)] if cost else []
    lines = ["% needs \\usepackage{booktabs,graphicx} and \\usepackage[table]{xcolor}"]
    lines += [f"\\providecolor{{{name}}}{{rgb}}{{{rgb}}}" for name, rgb in LATEX_COLORS]
    width = sum(len(g[2]) for g in groups)
    lines += ["\\resizebox{\\linewidth}{!}{%", f"\\begin{{tabular}}{{l{'r' * width}}}", "\\toprule"]
    top, rules, begin = [""], [], 2
    for title, _, chosen in groups:
        top.append(f"\\multicolumn{{{len(chosen)}}}{{c}}{{{latex_text(title)}}}")
        rules.append(f"\\cmidrule(lr){{{begin}-{begin + len(chosen) - 1}}}")
        begin += len(chosen)
    lines += [" & ".join(top) + r" \\", " ".join(rules)]
    head = [_latex_head(table.columns[i]) for g in groups for i in g[2]]
    lines += [" & ".join(["Method", *head]) + r" \\", "\\midrule"]
    for k, row in enumerate(blocks[0].rows):
        cells = [_latex_cell(table.columns[i], b.rows[k].cells[i]) for _, b, chosen in groups for i in chosen]
        lines.append(" & ".join([latex_text(row.method), *cells]) + r" \\")
    lines += ["\\bottomrule", "\\end{tabular}}"]
    return "\n".join([*lines, *(f"% {plain(line)}" for line in _below(table, marks=False))]) + "\n"


RENDERERS: dict[str, Callable[[Table], str]] = {
    "text": to_text,
    "markdown": to_markdown,
    "csv": to_csv,
    "latex": to_latex,
}


def _below(table: Table, *, marks: bool = True) -> list[str]:
    ranked = any(cell.rank for block in table.blocks for row in block.rows for cell in row.cells)
    spread = any(not math.isnan(c.spread) for b in table.blocks for row in b.rows for c in row.cells)
    return [
        *([LEGEND] if ranked and marks else []),
        *(["±: sample standard deviation over seeds"] if spread else []),
        *(plain(note) for note in table.notes),
    ]


def display_width(text: str) -> int:
    """Columns of a terminal: wide characters take two, combining ones none."""
    wide = sum(unicodedata.east_asian_width(c) in "WF" for c in text)
    return len(text) + wide - sum(unicodedata.combining(c) > 0 for c in text)


def _aligned(line: Sequence[str], widths: Sequence[int], ranks: Sequence[int | None] | None = None) -> str:
    import click

    cells = []
    for i, (text, width) in enumerate(zip(line, widths)):
        gap = " " * (width - display_width(text))
        if ranks and ranks[i]:
            text = click.style(text, fg=COLORS[ranks[i] or 1], bold=ranks[i] == 1)
        cells.append(text + gap if i == 0 else gap + text)
    return "  ".join(cells).rstrip()


def markdown_text(text: str) -> str:
    """Escaped for a GitHub table: neither HTML, nor a link, nor a new column."""
    text = plain(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([\\`*_\[\]|~#$])", r"\\\1", text)
    # A scheme makes a link without any bracket.
    return re.sub(r"(?i)\b(https?|ftp|www)(:|\.)", r"\1&#8203;\2", text)


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _bold(text: str, cell: TableCell) -> str:
    if cell.rank != 1:
        return text
    value, _, mark = text.rpartition(" (")
    return f"**{value}** ({mark}"


def csv_text(text: str) -> str:
    """A cell that a spreadsheet takes for text: a leading formula character gets an apostrophe."""
    text = plain(text) if not str(text).startswith("\t") else "'" + plain(text)
    return "'" + text if text.lstrip()[:1] in ("=", "+", "-", "@") else text


def _csv_number(value: float) -> str:
    if math.isnan(value):
        return ""
    return str(int(value)) if math.isfinite(value) and value == int(value) else repr(float(value))


def _status(row: Row) -> str:
    states = {cell.state for cell in row.cells}
    return next((s for s in ("failed", "absent", "ok") if s in states), "missing")


def latex_text(text: str) -> str:
    """Escaped for LaTeX: a name prints as it is, whatever it holds."""
    special = {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        # \textquotedbl needs fontenc T1, which not every class loads.
        '"': "{''}",
        # A row end takes these two for its own options when a name begins with them.
        "[": "{[}",
        "*": "{*}",
    }
    return "".join(special.get(c, f"\\{c}" if c in "&%$#_{}" else c) for c in plain(text))


def _latex_head(column: Measure) -> str:
    arrow = {"higher": r"$\uparrow$", "lower": r"$\downarrow$", None: ""}[column.better]
    return latex_text(column.label) + arrow


def _latex_cell(column: Measure, cell: TableCell) -> str:
    if cell.state != "ok":
        return {"missing": "--", "failed": "failed", "absent": "no run"}[cell.state]
    text = number(column, cell, mark=False).replace("±", r"$\pm$").replace("inf", r"$\infty$")
    if cell.rank is None:
        return text
    return f"\\cellcolor{{{LATEX_COLORS[cell.rank - 1][0]}}}{text}"
