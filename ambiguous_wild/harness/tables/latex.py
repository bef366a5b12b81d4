"""Tables as LaTeX: booktabs, colours for the three best, ready to `\\input`."""

from __future__ import annotations

from collections.abc import Sequence

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.tables.plain_formats import plain
from ambiguous_wild.harness.tables.table import Cell, Row, Table

NEEDS = "% needs \\usepackage{booktabs,graphicx} and \\usepackage[table]{xcolor}"
COLORS = (("awfirst", "1,0.75,0.75"), ("awsecond", "1,0.87,0.72"), ("awthird", "1,0.98,0.72"))
WIDE = 3  # a table of more columns spans both columns of text
FIT = (
    "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%"  # shrunk only where it must be
)
SPECIAL = {
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
    "–": "--",
    "—": "---",
}


def latex_text(text: str) -> str:
    """Escaped; what pdflatex's own fonts lack is written out, so that any name compiles."""
    return "".join(map(_latex_character, plain(text)))


def _latex_character(c: str) -> str:
    if c in SPECIAL:
        return SPECIAL[c]
    if c in "&%$#_{}":
        return f"\\{c}"
    in_fonts = c.isascii() or c == "±" or ("À" <= c <= "ÿ" and c not in "ÐðÞþ×÷")
    return c if in_fonts else f"(U+{ord(c):04X})"


def to_latex(tables: Sequence[Table]) -> str:
    """One float a table, with a caption; a table without a title is a bare tabular, for a float of its own.

    The notes and the command that made it stand below as comments.
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
    lines = [FIT, f"\\begin{{tabular}}{{l{'c' * len(table.columns)}}}", "\\toprule", *_head(table)]
    lines.append("\\midrule")
    before = "measured"
    for row in table.rows:
        if row.kind != before:
            span = len(table.columns) + 1
            lines += [
                "\\midrule",
                f"\\multicolumn{{{span}}}{{l}}{{\\emph{{reported, not measured here}}}} \\\\",
            ]
            before = row.kind
        lines.append(_row(table, row))
    return [*lines, "\\bottomrule", "\\end{tabular}}"]


def _caption(table: Table) -> str:
    text = latex_text(table.title) + "."
    if any(cell.rank for cell in table.cells):
        names = ("first", "second", "third")
        shown = [f"\\colorbox{{{colour}}}{{{name}}}" for (colour, _), name in zip(COLORS, names)]
        text += " " + ", ".join(shown[:2]) + " and " + shown[2] + " of each column."
    if any(cell.tie for cell in table.cells):
        text += " $\\approx$: not significantly different from the best (paired bootstrap, 95\\,\\%)."
    if any("\u00b1" in rest for rest in table.legend):
        text += f" $\\pm$: sample standard deviation over {table.spread_over}."
    if table.contradicts:
        text += " a / b: tables that contradict each other."
    return text


def _head(table: Table) -> list[str]:
    top, rules, begin = [""], [], 2
    for title, count in table.groups:
        top.append(f"\\multicolumn{{{count}}}{{c}}{{{latex_text(title)}}}")
        rules.append(f"\\cmidrule(lr){{{begin}-{begin + count - 1}}}")
        begin += count
    head = table.head[:1].upper() + table.head[1:]
    labels = " & ".join([latex_text(head), *(_label(column.measure) for column in table.columns)]) + r" \\"
    if not any(title for title, _ in table.groups):
        return [labels]
    return [" & ".join(top) + r" \\", " ".join(rules), labels]


def _label(measure: Measure) -> str:
    arrow = {"higher": r"$\uparrow$", "lower": r"$\downarrow$", None: ""}[measure.better]
    return latex_text(measure.label) + arrow


def _row(table: Table, row: Row) -> str:
    cells = [_cell(cell, column.measure) for column, cell in zip(table.columns, row.cells)]
    return " & ".join([latex_text(row.name), *cells]) + r" \\"


def _cell(cell: Cell, measure: Measure) -> str:
    if cell.state == "missing":
        return "--"
    text = latex_text(cell.text(measure)).replace("±", r"$\pm$").replace("inf", r"$\infty$")
    text += r"$^{\approx}$" if cell.tie else ""
    return text if cell.rank is None else f"\\cellcolor{{{COLORS[cell.rank - 1][0]}}}{text}"
