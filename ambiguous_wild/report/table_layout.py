"""The table that all reports use: groups of columns, rows, and what each cell shows.

`plain_formats.py` writes tables as text, Markdown and CSV, `typeset.py` as LaTeX and HTML.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.timing import seconds_range

Kind = Literal["measured", "reported"]
State = Literal["ok", "missing", "failed", "absent", "blank"]
SHOWN = {"missing": "—", "failed": "failed", "absent": "no run", "blank": ""}  # blank: no value is expected
ARROWS = {"higher": "↑", "lower": "↓", None: ""}
TIE = "≈"
DOUBTFUL = "†"


@dataclass(frozen=True)
class Column:
    """A column; neighbours with the same group share one heading."""

    group: str  # heading: a scene, a mean, or ""
    measure: Measure
    scene: str = ""  # empty: a mean over scenes
    dataset: str = ""  # dataset of the scene, or of all scenes of the mean
    words: bool = False  # text, aligned left, not numbers, aligned right, if the format can do so
    doubtful: bool = False  # distractors in test photos count as truth: marked, and not ranked

    @property
    def label(self) -> str:
        return f"{self.name}{ARROWS[self.measure.better]}"

    @property
    def name(self) -> str:
        """The label without its arrow."""
        return self.measure.label + (DOUBTFUL if self.doubtful else "")


@dataclass(frozen=True)
class TableCell:
    """One number of a table, or a text."""

    value: float = math.nan
    spread: float = math.nan  # sample deviation over seeds; NaN for one seed
    low: float = math.nan  # 95 % interval over the images of one scene
    high: float = math.nan
    rank: int | None = None  # 1, 2, 3 or None
    ranged: bool = False  # a time that cannot be compared: the range from `low` to `high` is shown
    tie: bool = False  # not the best, and not significantly different from it
    state: State = "ok"
    printed: str = ""  # a text, or a number as a paper prints it; empty for measured numbers
    markdown: str = ""  # `printed` as Markdown, if that is more than escaped text

    def text(self, measure: Measure) -> str:
        """Return the number with its spread, or the state; without rank and tie."""
        if self.printed:
            return self.printed
        if self.state != "ok":
            return SHOWN[self.state]
        if self.ranged:
            return seconds_range([self.low, self.high], measure.digits)
        text = f"{self.value:.{measure.digits}f}"
        spread = measure.quality and not math.isnan(self.spread)
        return f"{text} ± {self.spread:.{measure.digits}f}" if spread else text


BLANK = TableCell(state="blank")


@dataclass(frozen=True)
class Row:
    """A row: a method, a variant, or a method that a paper reports."""

    name: str
    cells: tuple[TableCell, ...]  # one a column
    kind: Kind = "measured"
    note: str = ""  # the meaning of the row, if its name does not say it
    runs: int = 0  # finished runs behind it
    cite: str = ""  # key of the paper, cited in LaTeX
    ranked: bool = True  # False: a run behind it is unfinished, or the method knows the truth


@dataclass(frozen=True)
class Table:
    """One table as it is shown."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]  # measured first, then reported
    notes: tuple[str, ...] = ()  # lines on missing, failed and incomparable numbers
    spread_over: str = "seeds"  # the deviations are over these
    head: str = "method"  # heading of the rows' names
    continued: bool = False  # legend and notes are below the next table

    def with_notes(self, *notes: str) -> Table:
        """Return the table with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def picked(self, indices: Sequence[int]) -> Table:
        """Return the table with only the columns of these indices, in this order."""
        rows = tuple(replace(row, cells=tuple(row.cells[i] for i in indices)) for row in self.rows)
        return replace(self, columns=tuple(self.columns[i] for i in indices), rows=rows)

    @property
    def cells(self) -> list[TableCell]:
        return [cell for row in self.rows for cell in row.cells]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """Return (heading, number of columns under it), from left to right."""
        groups: list[tuple[str, int]] = []
        for column in self.columns:
            if groups and groups[-1][0] == column.group:
                groups[-1] = (column.group, groups[-1][1] + 1)
            else:
                groups.append((column.group, 1))
        return groups

    @property
    def legend(self) -> list[str]:
        """Return a line for each kind of mark in the table, except ranks."""
        lines = []
        if any(cell.tie for cell in self.cells):
            lines.append(
                f"{TIE}: not significantly different from the best (paired t interval over test images, 95 %)"
            )
        shown = [e for row in self.rows for c, e in zip(self.columns, row.cells) if c.measure.quality]
        if any(not math.isnan(cell.spread) for cell in shown):
            lines.append(f"±: sample standard deviation over {self.spread_over}")
        if any(row.kind == "reported" for row in self.rows):
            lines.append(
                "reported: printed in a paper, not measured here; neither ranked nor part of any mean; the "
                "variant of SSIM and LPIPS is often unknown"
            )
        if self.contradicts:
            lines.append("a / b: values from tables that contradict each other")
        return lines

    @property
    def contradicts(self) -> bool:
        """True if a cell shows several values, because papers print different numbers for the same cell."""
        reported = [cell for row in self.rows if row.kind == "reported" for cell in row.cells]
        return any(" / " in cell.printed for cell in reported)


def text_table(
    title: str, head: Sequence[str], rows: Iterable[Sequence[str | TableCell]], *, words: Sequence[str] = ()
) -> Table:
    """Make a table of texts.

    Args:
        title: title of the table.
        head: headings of the columns; the first column names the rows.
        rows: texts or cells, one for each column.
        words: headings of the columns that hold words.
    """
    columns = tuple(Column("", Measure(text, text, None, 0), words=text in words) for text in head[1:])
    text_rows = tuple(
        Row(
            str(first),
            tuple(c if isinstance(c, TableCell) else TableCell(printed=c) if c else BLANK for c in rest),
        )
        for first, *rest in rows
    )
    return Table(title, columns, text_rows, head=head[0])


def ranks(values: Sequence[float], measure: Measure) -> list[int | None]:
    """Return the ranks 1 to 3 of a column, None for the rest; values that print alike share a rank."""
    shown = [round(v, measure.digits) if math.isfinite(v) else math.nan for v in values]
    finite = [v for v in shown if not math.isnan(v)]
    if measure.better is None or len(set(finite)) < 2:
        return [None] * len(values)
    places: list[int | None] = []
    for value in shown:
        ahead = sum(v > value if measure.better == "higher" else v < value for v in finite)
        places.append(None if math.isnan(value) or ahead > 2 else ahead + 1)
    return places
