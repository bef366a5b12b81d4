"""Laid-out tables as LaTeX: booktabs, colours for the three best, ready to `\\input`."""

from __future__ import annotations

from collections.abc import Sequence

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.tables.layouts.grid import Layout, LayoutCell, Line
from ambiguous_wild.harness.tables.render import LATEX_COLORS, plain
from ambiguous_wild.harness.tables.render import latex_text as escaped

NEEDS = "% needs \\usepackage{booktabs,graphicx} and \\usepackage[table]{xcolor}"
WIDE = 3  # a table of more columns spans both columns of text
FIT = (
    "\\resizebox{\\ifdim\\width>\\linewidth\\linewidth\\else\\width\\fi}{!}{%"  # shrunk only where it must be
)
DASHES = {"–": "--", "—": "---"}


def latex_text(text: str) -> str:
    """Escaped; what pdflatex's own fonts lack is written out, so that any name compiles."""
    return "".join(DASHES.get(c) or (c if _has(c) else f"(U+{ord(c):04X})") for c in escaped(text))


def _has(c: str) -> bool:
    return c.isascii() or c == "±" or ("À" <= c <= "ÿ" and c not in "ÐðÞþ×÷")


def to_latex(layouts: Sequence[Layout]) -> str:
    """One float a table, with a caption; the notes and the command that made it stand below as comments."""
    parts = [NEEDS, *(f"\\providecolor{{{name}}}{{rgb}}{{{rgb}}}" for name, rgb in LATEX_COLORS)]
    for layout in layouts:
        parts += ["", *_float(layout)]
    return "\n".join(parts) + "\n"


def _float(layout: Layout) -> list[str]:
    star = "*" if len(layout.columns) > WIDE else ""
    lines = [f"\\begin{{table{star}}}[t]", "\\centering", f"\\caption{{{_caption(layout)}}}\\vspace{{4pt}}"]
    lines += [
        FIT,
        f"\\begin{{tabular}}{{l{'c' * len(layout.columns)}}}",
        "\\toprule",
        *_head(layout),
        "\\midrule",
    ]
    before = "measured"
    for line in layout.lines:
        if line.kind != before:
            span = len(layout.columns) + 1
            lines += [
                "\\midrule",
                f"\\multicolumn{{{span}}}{{l}}{{\\emph{{reported, not measured here}}}} \\\\",
            ]
            before = line.kind
        lines.append(_row(layout, line))
    lines += ["\\bottomrule", "\\end{tabular}}", f"\\end{{table{star}}}"]
    return [*lines, *(f"% {plain(note)}" for note in layout.notes)]


def _caption(layout: Layout) -> str:
    text = latex_text(layout.title) + "."
    entries = [entry for line in layout.lines for entry in line.entries]
    if any(entry.rank for entry in entries):
        names = ("first", "second", "third")
        shown = [f"\\colorbox{{{colour}}}{{{name}}}" for (colour, _), name in zip(LATEX_COLORS, names)]
        text += " " + ", ".join(shown[:2]) + " and " + shown[2] + " of each column."
    if any(entry.tie for entry in entries):
        text += " $\\approx$: not significantly different from the best (paired bootstrap, 95\\,\\%)."
    if any("\u00b1" in rest for rest in layout.legend):
        text += f" $\\pm$: sample standard deviation over {layout.spread_over}."
    if any(" / " in entry.printed for entry in entries):
        text += " a / b: tables that contradict each other."
    return text


def _head(layout: Layout) -> list[str]:
    top, rules, begin = [""], [], 2
    for title, count in layout.groups:
        top.append(f"\\multicolumn{{{count}}}{{c}}{{{latex_text(title)}}}")
        rules.append(f"\\cmidrule(lr){{{begin}-{begin + count - 1}}}")
        begin += count
    labels = " & ".join(["Method", *(_label(column.measure) for column in layout.columns)]) + r" \\"
    if not any(title for title, _ in layout.groups):
        return [labels]
    return [" & ".join(top) + r" \\", " ".join(rules), labels]


def _label(measure: Measure) -> str:
    arrow = {"higher": r"$\uparrow$", "lower": r"$\downarrow$", None: ""}[measure.better]
    return latex_text(measure.label) + arrow


def _row(layout: Layout, line: Line) -> str:
    cells = [_cell(entry, column.measure) for column, entry in zip(layout.columns, line.entries)]
    return " & ".join([latex_text(line.name), *cells]) + r" \\"


def _cell(entry: LayoutCell, measure: Measure) -> str:
    if entry.state == "missing":
        return "--"
    text = latex_text(entry.text(measure)).replace("±", r"$\pm$").replace("inf", r"$\infty$")
    text += r"$^{\approx}$" if entry.tie else ""
    return text if entry.rank is None else f"\\cellcolor{{{LATEX_COLORS[entry.rank - 1][0]}}}{text}"
