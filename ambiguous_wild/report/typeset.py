"""Write tables as LaTeX (booktabs, ready to `\\input`) and as one HTML page that needs no other file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from pathlib import Path

from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.chosen_effects import MIXED
from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.report.plain_formats import UNEQUAL
from ambiguous_wild.report.table_layout import DOUBTFUL, TIE, Row, Table, TableCell

NEEDS = "% needs \\usepackage{booktabs,graphicx} and \\usepackage[table]{xcolor}"
COLORS = (("awfirst", "1,0.75,0.75"), ("awsecond", "1,0.87,0.72"), ("awthird", "1,0.98,0.72"))
WIDE = 3  # a table of more columns spans both columns of text
FIT = "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%"  # shrunk only if too wide
SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    # \textquotedbl needs fontenc T1, which not every class loads.
    '"': "{''}",
    # after the end of a row, LaTeX would read these two as options of the row end
    "[": "{[}",
    "*": "{*}",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    TIE: r"$\approx$",
    DOUBTFUL: r"\dag{}",
    "–": "--",
    "—": "---",
}
RANKS = ("first", "second", "third")


def latex_text(text: str) -> str:
    """Return the text escaped; characters that pdflatex's fonts lack are written as code points."""
    return "".join(map(_latex_character, plain(text)))


def _latex_character(c: str) -> str:
    if c in SPECIAL:
        return SPECIAL[c]
    if c in "&%$#_{}":
        return f"\\{c}"
    in_fonts = c.isascii() or c == "±" or ("À" <= c <= "ÿ" and c not in "ÐðÞþ×÷")
    return c if in_fonts else f"(U+{ord(c):04X})"


def to_latex(tables: Sequence[Table]) -> str:
    """Return a float with a caption for each table; a table without a title becomes a bare tabular.

    Notes, with the command that made the runs, follow as comments.
    """
    parts = [NEEDS, *(f"\\providecolor{{{name}}}{{rgb}}{{{rgb}}}" for name, rgb in COLORS)]
    for table in tables:
        parts += ["", *_float(table)] if table.title else _tabular(table)
        legend = [] if table.title else table.legend
        parts += [f"% {plain(line)}" for line in (*legend, *table.notes)]
    return "\n".join(parts) + "\n"


def _float(table: Table) -> list[str]:
    star = "*" if len(table.columns) > WIDE else ""
    begin = [f"\\begin{{table{star}}}[t]", "\\centering", f"\\caption{{{_caption(table)}}}\\vspace{{4pt}}"]
    return [*begin, *_tabular(table), f"\\end{{table{star}}}"]


def _tabular(table: Table) -> list[str]:
    lines = [FIT, f"\\begin{{tabular}}{{l{'c' * len(table.columns)}}}", "\\toprule", *_latex_head(table)]
    lines.append("\\midrule")
    before = "measured"
    for row in table.rows:
        if row.kind != before:
            head = f"\\multicolumn{{{len(table.columns) + 1}}}{{l}}"
            lines += ["\\midrule", f"{head}{{\\emph{{reported, not measured here}}}} \\\\"]
            before = row.kind
        cells = [_latex_cell(cell, column.measure) for column, cell in zip(table.columns, row.cells)]
        cited = f"~\\cite{{{row.cite}}}" if row.cite else ""
        lines.append(" & ".join([latex_text(row.name) + cited, *cells]) + r" \\")
    # these notes are printed, as they limit what a rank means; the others are comments
    below = [note for note in table.notes if note.startswith((UNEQUAL, MIXED))]
    if not table.title and any(cell.tie for cell in table.cells):  # a bare tabular has no caption
        below.append(f"{TIE}: not significantly different from the best (paired t interval, 95 %).")
    width = f"\\multicolumn{{{len(table.columns) + 1}}}{{p{{\\linewidth}}}}"
    printed = [f"{width}{{\\footnotesize {latex_text(note)}}} \\\\" for note in below]
    return [*lines, "\\bottomrule", *printed, "\\end{tabular}}"]


def _caption(table: Table) -> str:
    text = latex_text(table.title) + "."
    if any(cell.rank for cell in table.cells):
        first, second, third = (f"\\colorbox{{{c}}}{{{rank}}}" for (c, _), rank in zip(COLORS, RANKS))
        text += f" {first}, {second} and {third} of each column."
    if any(cell.tie for cell in table.cells):
        text += " $\\approx$: not significantly different from the best (paired t interval, 95\\,\\%)."
    if any("\u00b1" in rest for rest in table.legend):
        text += f" $\\pm$: sample standard deviation over {table.spread_over}."
    if table.contradicts:
        text += " a / b: tables that contradict each other."
    return text


def _latex_head(table: Table) -> list[str]:
    top, rules, begin = [""], [], 2
    for title, count in table.groups:
        top.append(f"\\multicolumn{{{count}}}{{c}}{{{latex_text(title)}}}")
        rules.append(f"\\cmidrule(lr){{{begin}-{begin + count - 1}}}")
        begin += count
    head = table.head[:1].upper() + table.head[1:]
    labels = " & ".join([latex_text(head), *(latex_text(column.label) for column in table.columns)]) + r" \\"
    if not any(title for title, _ in table.groups):
        return [labels]
    return [" & ".join(top) + r" \\", " ".join(rules), labels]


def _latex_cell(cell: TableCell, measure: Measure) -> str:
    if cell.state == "missing":
        return "--"
    text = latex_text(cell.text(measure)).replace("±", r"$\pm$").replace("inf", r"$\infty$")
    text = re.sub(r"(?<!\w)-(?=\d)", "$-$", text)  # a minus, not a hyphen
    text += r"$^{\approx}$" if cell.tie else ""
    return text if cell.rank is None else f"\\cellcolor{{{COLORS[cell.rank - 1][0]}}}{text}"


def to_html(tables: Sequence[Table]) -> str:
    """Return the tables as one HTML page; names are escaped."""
    title = escape(plain(tables[0].title)) if len(tables) == 1 else "Results"
    style = (Path(__file__).parent / "page" / "table.css").read_text(encoding="utf-8")
    head = (
        '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>\n{style}</style>"
    )
    body = "\n".join(_section(table) for table in tables)
    return f'<!doctype html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{body}\n</body>\n</html>\n'


def _section(table: Table) -> str:
    parts = [f"<h2>{_text(table.title)}</h2>", '<div class="scroll">', html_table(table), "</div>"]
    return "\n".join([*parts, _below(table)])


def html_table(table: Table) -> str:
    """Return only the table element, for a page with its own style; names are escaped."""
    parts = ["<table>", "<thead>"]
    begins = _begins(table)
    if any(title for title, _ in table.groups):
        groups = "".join(
            f'<th class="group" colspan="{count}" scope="colgroup">{_text(title)}</th>'
            for title, count in table.groups
        )
        parts.append(f"<tr><th></th>{groups}</tr>")
    labels = "".join(f"<th{_class([b])}>{_text(c.label)}</th>" for c, b in zip(table.columns, begins))
    parts += [f'<tr><th class="name">{_text(table.head)}</th>{labels}</tr>', "</thead>", "<tbody>"]
    before = "measured"
    for row in table.rows:
        if row.kind != before:
            span = len(table.columns) + 1
            parts.append(
                f'<tr class="divider"><th colspan="{span}">reported by papers, not measured here</th></tr>'
            )
            before = row.kind
        parts.append(_row(table, row, begins))
    return "\n".join([*parts, "</tbody>", "</table>"])


def _begins(table: Table) -> list[str]:
    """Return a CSS class for the first column of every group except the first."""
    return [
        "begins" if i and c.group != table.columns[i - 1].group else "" for i, c in enumerate(table.columns)
    ]


def _row(table: Table, row: Row, begins: Sequence[str]) -> str:
    cells = "".join(_cell(e, c.measure, b) for c, e, b in zip(table.columns, row.cells, begins))
    title = f' title="{_text(row.note)}"' if row.note else ""
    return f'<tr{_class([row.kind])}><th class="name" scope="row"{title}>{_text(row.name)}</th>{cells}</tr>'


def _cell(cell: TableCell, measure: Measure, begins: str) -> str:
    value, sign, spread = cell.text(measure).partition(" ± ")
    text = _text(value) + (f' <span class="spread">{_text(sign + spread).strip()}</span>' if sign else "")
    if cell.tie:
        text += f' <span title="not significantly different from the best">{TIE}</span>'
    rank = RANKS[cell.rank - 1] if cell.rank else ""
    return f"<td{_class([rank, begins])}>{text}</td>"


def _below(table: Table) -> str:
    items = [f"<li>{_text(line)}</li>" for line in (*table.legend, *table.notes)]
    if any(cell.rank for cell in table.cells):
        key = " ".join(f'<span class="{rank}">{rank}</span>' for rank in RANKS)
        items.insert(0, f'<li class="key">{key} of each column</li>')
    return f"<ul>{''.join(items)}</ul>" if items else ""


def _class(names: Sequence[str]) -> str:
    used = " ".join(name for name in names if name)
    return f' class="{used}"' if used else ""


def _text(text: str) -> str:
    return escape(plain(text), quote=True)
