"""A laid-out table as data: groups of columns, sections of rows, what each cell shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.running.timing import seconds_range
from ambiguous_wild.harness.tables.comparison import TableCell

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

    @property
    def label(self) -> str:
        return f"{self.measure.label}{ARROWS[self.measure.better]}"


@dataclass(frozen=True)
class LayoutCell:
    """What a cell shows."""

    value: float = math.nan
    spread: float = math.nan  # sample deviation over seeds
    rank: int | None = None  # 1, 2, 3
    tie: bool = False  # not the best, and not significantly different from it
    state: State = "ok"
    printed: str = ""  # as a paper prints it; empty for what was measured
    ranged: tuple[float, float] | None = None  # least and most of a time that cannot be compared

    @staticmethod
    def of(cell: TableCell, *, tie: bool = False) -> LayoutCell:
        """The entry of a measured cell."""
        return LayoutCell(cell.value, cell.spread, cell.rank, tie, cell.state, ranged=_ends(cell))

    def text(self, measure: Measure) -> str:
        """The number with its spread, or its state; neither rank nor tie."""
        if self.printed:
            return self.printed
        if self.state != "ok":
            return SHOWN[self.state]
        if self.ranged is not None:
            return seconds_range(self.ranged, measure.digits)
        text = f"{self.value:.{measure.digits}f}"
        spread = measure.quality and not math.isnan(self.spread)
        return f"{text} ± {self.spread:.{measure.digits}f}" if spread else text


def _ends(cell: TableCell) -> tuple[float, float] | None:
    return (cell.low, cell.high) if cell.ranged else None


@dataclass(frozen=True)
class Line:
    """A row."""

    name: str
    entries: tuple[LayoutCell, ...]  # one a column
    kind: Kind = "measured"
    note: str = ""  # what the row is, where its name does not say it


@dataclass(frozen=True)
class Layout:
    """One table as it is to be seen."""

    title: str
    columns: tuple[Column, ...]
    lines: tuple[Line, ...]  # measured first, then reported
    notes: tuple[str, ...] = ()
    spread_over: str = "seeds"  # what the deviations are over

    def with_notes(self, *notes: str) -> Layout:
        return replace(self, notes=(*self.notes, *notes))

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
        """What the marks that occur in it mean."""
        entries = [entry for line in self.lines for entry in line.entries]
        lines = []
        if any(entry.tie for entry in entries):
            lines.append(
                f"{TIE}: not significantly different from the best (paired bootstrap over the test images, "
                "95 %)"
            )
        shown = [e for line in self.lines for c, e in zip(self.columns, line.entries) if c.measure.quality]
        if any(not math.isnan(entry.spread) for entry in shown):
            lines.append(f"±: sample standard deviation over {self.spread_over}")
        if any(line.kind == "reported" for line in self.lines):
            lines.append(
                "reported: printed in a paper, not measured here; neither ranked nor part of any mean; of "
                "SSIM and LPIPS the variant is often unknown"
            )
        if any(" / " in entry.printed for entry in entries):
            lines.append("a / b: tables that contradict each other")
        return lines


def ranked(values: list[float], measure: Measure) -> list[int | None]:
    """First, second and third of a column; equal in print = equal rank; NaN has none."""
    shown = [math.nan if math.isnan(v) else round(v, measure.digits) for v in values]
    known = [v for v in shown if not math.isnan(v)]
    if measure.better is None or len(set(known)) < 2:
        return [None] * len(values)
    ranks: list[int | None] = []
    for value in shown:
        ahead = sum(v > value if measure.better == "higher" else v < value for v in known)
        ranks.append(None if math.isnan(value) or ahead > 2 else ahead + 1)
    return ranks
