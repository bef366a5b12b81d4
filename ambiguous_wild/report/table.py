"""The one table of this package: groups of columns, rows, and what each cell shows.

`plain_formats.py` writes tables for a terminal, as Markdown and as CSV, `latex.py` and `html_page.py` in
their formats.
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
SHOWN = {"missing": "—", "failed": "failed", "absent": "no run", "blank": ""}  # blank: nothing belongs there
ARROWS = {"higher": "↑", "lower": "↓", None: ""}
TIE = "≈"


@dataclass(frozen=True)
class Column:
    """A column; neighbours of the same group stand under one heading."""

    group: str  # heading: a scene, a mean, or ""
    measure: Measure
    scene: str = ""  # empty: a mean over scenes
    dataset: str = ""  # that the scene, or all scenes of the mean, belong to
    words: bool = False  # text from the left, not numbers from the right, where the format can show it

    @property
    def label(self) -> str:
        return f"{self.measure.label}{ARROWS[self.measure.better]}"


@dataclass(frozen=True)
class Cell:
    """One number of a table, or a text."""

    value: float = math.nan
    spread: float = math.nan  # sample deviation over seeds; NaN for one seed
    low: float = math.nan  # 95 % bootstrap interval over the images of one scene
    high: float = math.nan
    rank: int | None = None  # 1, 2, 3 or None
    ranged: bool = False  # a time that cannot be compared: shown from `low` to `high`, its least and its most
    tie: bool = False  # not the best, and not significantly different from it
    state: State = "ok"
    printed: str = ""  # a text, or a number as a paper prints it; empty for what was measured
    markdown: str = ""  # `printed` as Markdown, where it is more than escaped text

    def text(self, measure: Measure) -> str:
        """The number with its spread, or its state; neither rank nor tie."""
        if self.printed:
            return self.printed
        if self.state != "ok":
            return SHOWN[self.state]
        if self.ranged:
            return seconds_range([self.low, self.high], measure.digits)
        text = f"{self.value:.{measure.digits}f}"
        spread = measure.quality and not math.isnan(self.spread)
        return f"{text} ± {self.spread:.{measure.digits}f}" if spread else text


BLANK = Cell(state="blank")


@dataclass(frozen=True)
class Row:
    """A row: a method, a variant, or a method that a paper reports."""

    name: str
    cells: tuple[Cell, ...]  # one a column
    kind: Kind = "measured"
    note: str = ""  # what the row is, where its name does not say it
    runs: int = 0  # finished runs behind it
    ranked: bool = True  # False: a run behind it is unfinished, or the method knows the truth


@dataclass(frozen=True)
class Table:
    """One table as it is to be seen."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]  # measured first, then reported
    notes: tuple[str, ...] = ()  # what is missing, failed or not comparable
    spread_over: str = "seeds"  # what the deviations are over
    head: str = "method"  # above the names of the rows
    continued: bool = False  # legend and notes stand below the next table

    def with_notes(self, *notes: str) -> Table:
        """The same table with more lines below."""
        return replace(self, notes=(*self.notes, *notes))

    def picked(self, indices: Sequence[int]) -> Table:
        """The table with the columns of these indices alone, in this order."""
        rows = tuple(replace(row, cells=tuple(row.cells[i] for i in indices)) for row in self.rows)
        return replace(self, columns=tuple(self.columns[i] for i in indices), rows=rows)

    @property
    def cells(self) -> list[Cell]:
        return [cell for row in self.rows for cell in row.cells]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """(heading, columns under it), from the left."""
        found: list[tuple[str, int]] = []
        for column in self.columns:
            if found and found[-1][0] == column.group:
                found[-1] = (column.group, found[-1][1] + 1)
            else:
                found.append((column.group, 1))
        return found

    @property
    def legend(self) -> list[str]:
        """What the marks that occur in it mean, but for the ranks."""
        lines = []
        if any(cell.tie for cell in self.cells):
            lines.append(
                f"{TIE}: not significantly different from the best (paired bootstrap over the test images, "
                "95 %)"
            )
        shown = [e for row in self.rows for c, e in zip(self.columns, row.cells) if c.measure.quality]
        if any(not math.isnan(cell.spread) for cell in shown):
            lines.append(f"±: sample standard deviation over {self.spread_over}")
        if any(row.kind == "reported" for row in self.rows):
            lines.append(
                "reported: printed in a paper, not measured here; neither ranked nor part of any mean; of "
                "SSIM and LPIPS the variant is often unknown"
            )
        if self.contradicts:
            lines.append("a / b: tables that contradict each other")
        return lines

    @property
    def contradicts(self) -> bool:
        """Whether a cell shows several values that papers print for the same thing."""
        reported = [cell for row in self.rows if row.kind == "reported" for cell in row.cells]
        return any(" / " in cell.printed for cell in reported)


def text_table(
    title: str, head: Sequence[str], rows: Iterable[Sequence[str | Cell]], *, words: Sequence[str] = ()
) -> Table:
    """A table of texts.

    Args:
        title: above it.
        head: of every column; the first column names the rows.
        rows: texts, or cells of them, one a column.
        words: columns that hold words and no numbers.
    """
    columns = tuple(Column("", Measure(text, text, None, 0), words=text in words) for text in head[1:])
    made = [
        Row(str(first), tuple(c if isinstance(c, Cell) else Cell(printed=c) if c else BLANK for c in rest))
        for first, *rest in rows
    ]
    return Table(title, columns, tuple(made), head=head[0])


def ranks(values: Sequence[float], measure: Measure) -> list[int | None]:
    """First, second and third of a column; equal in print = equal rank; what is not finite has none."""
    shown = [round(v, measure.digits) if math.isfinite(v) else math.nan for v in values]
    known = [v for v in shown if not math.isnan(v)]
    if measure.better is None or len(set(known)) < 2:
        return [None] * len(values)
    found: list[int | None] = []
    for value in shown:
        ahead = sum(v > value if measure.better == "higher" else v < value for v in known)
        found.append(None if math.isnan(value) or ahead > 2 else ahead + 1)
    return found
