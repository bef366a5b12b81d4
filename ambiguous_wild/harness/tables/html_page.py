"""Tables as one HTML page that needs nothing else: no script, no font, no request."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.tables.plain_formats import plain
from ambiguous_wild.harness.tables.table import TIE, Cell, Row, Table

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; background: #fff; margin: 1.5rem auto;
  max-width: 96rem; padding: 0 1rem; }
h2 { font-size: 1.05rem; margin: 2rem 0 .5rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; border-top: 2px solid #1a1a1a; border-bottom: 2px solid #1a1a1a; }
th, td { padding: .25rem .6rem; text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
th { font-weight: 600; }
thead tr:last-child th { border-bottom: 1px solid #1a1a1a; }
th.group { text-align: center; border-bottom: 1px solid #bbb; }
th.name { text-align: left; font-weight: normal; position: sticky; left: 0; background: #fff; }
.first { background: #ffbfbf; font-weight: 600; }
.second { background: #ffdeb8; }
.third { background: #fffab8; }
.begins { border-left: 1px solid #ddd; }
.spread { color: #666; font-size: .85em; }
tr.reported td, tr.reported th { color: #666; font-style: italic; }
tr.divider th { text-align: left; color: #666; font-size: .85em; border-top: 1px solid #1a1a1a; }
ul { padding-left: 1.1rem; color: #555; font-size: .85rem; overflow-wrap: anywhere; }
.key span { padding: 0 .4rem; }
"""
RANKS = ("first", "second", "third")


def to_html(tables: Sequence[Table]) -> str:
    """The tables on one page; names are text, whatever they hold."""
    title = escape(plain(tables[0].title)) if len(tables) == 1 else "Results"
    head = (
        '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{STYLE}</style>"
    )
    body = "\n".join(_section(table) for table in tables)
    return f'<!doctype html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{body}\n</body>\n</html>\n'


def _section(table: Table) -> str:
    parts = [f"<h2>{_text(table.title)}</h2>", '<div class="scroll">', html_table(table), "</div>"]
    return "\n".join([*parts, _below(table)])


def html_table(table: Table) -> str:
    """The element alone, for a page with a style of its own; names are text."""
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
    """A class for the first column of every group but the first."""
    return [
        "begins" if i and c.group != table.columns[i - 1].group else "" for i, c in enumerate(table.columns)
    ]


def _row(table: Table, row: Row, begins: Sequence[str]) -> str:
    cells = "".join(_cell(e, c.measure, b) for c, e, b in zip(table.columns, row.cells, begins))
    title = f' title="{_text(row.note)}"' if row.note else ""
    return f'<tr{_class([row.kind])}><th class="name" scope="row"{title}>{_text(row.name)}</th>{cells}</tr>'


def _cell(cell: Cell, measure: Measure, begins: str) -> str:
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
