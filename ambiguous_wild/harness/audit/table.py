"""Tables of reported numbers: one number a line, in CSV."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.tables.plain_formats import read_csv

REQUIRED = ("method", "scene", "metric", "value")
OPTIONAL = ("table", "setting", "dataset", "variant", "mark", "printed")
UNKNOWN = "unknown"
MEAN, ALL = "mean", "all"  # of scenes, and of datasets
LARGEST = 50_000_000  # bytes
REPORTED = Path(__file__).parent / "reported"  # the RefineSplat paper's tables, see docs/audit.md


@dataclass(frozen=True)
class Number:
    """One number as printed."""

    table: str  # which table it stands in
    method: str
    setting: str  # how it differs from the method as published; empty: as published
    dataset: str
    scene: str  # MEAN for a mean over the dataset's scenes, UNKNOWN where the table does not say
    metric: str
    variant: str  # of the metric, or its unit; UNKNOWN where the table does not say
    value: float
    digits: int  # behind the point
    mark: int | None  # rank the table marks it as: 1, 2, 3
    where: str  # file and line

    @property
    def identity(self) -> tuple[str, str, str, str]:
        return (self.method, self.setting, self.dataset, self.scene)

    @property
    def place(self) -> tuple[str, str]:
        return (self.dataset, self.scene)

    @property
    def half(self) -> float:
        """Half a unit of the last printed digit."""
        return 0.5 * 10.0**-self.digits

    @property
    def text(self) -> str:
        return f"{self.value:.{self.digits}f}"

    @property
    def known(self) -> bool:
        """Whether it is said what it was measured on."""
        return UNKNOWN not in self.place


def read_tables(paths: Sequence[Path]) -> list[Number]:
    """Read CSV files; a folder stands for the *.csv in it. Cells without a value are left out.

    Raises:
        AwError: no file, or one that is unreadable, lacks a column or holds what is no number.
    """
    files: list[Path] = []
    for path in paths:
        inside = sorted(path.glob("*.csv")) if path.is_dir() else [path]
        if not inside:
            raise AwError(f"no *.csv in {path}: give tables as docs/audit.md describes them")
        files += inside
    found = [n for path in dict.fromkeys(files) for n in _read(path)]
    if not found:
        raise AwError(f"no number in {shortlist(map(str, files))}: nothing to audit")
    return found


def _read(path: Path) -> list[Number]:
    advice = f"a table of results has {', '.join(REQUIRED)} and may have {', '.join(OPTIONAL)}"
    rows = read_csv(path, REQUIRED, LARGEST, advice)[1]
    return [n for line, row in rows if (n := _number(path, line, row)) is not None]


def _number(path: Path, line: int, row: dict[str, str]) -> Number | None:
    where = f"{path.name}:{line}"
    cell = {k: row.get(k, "").strip() for k in (*REQUIRED, *OPTIONAL)}
    if not cell["value"]:
        return None
    for column in ("method", "scene", "metric"):
        if not cell[column]:
            raise AwError(f"{path} line {line} has no {column}")
    if not re.fullmatch(r"-?\d+(\.\d+)?([eE][+-]?\d+)?", cell["value"]) or math.isinf(float(cell["value"])):
        raise AwError(
            f"{path} line {line}: {cell['value'][:40]!a} is no number; leave the cell empty for none"
        )
    if cell["mark"] not in ("", "1", "2", "3"):
        raise AwError(f"{path} line {line}: mark {cell['mark'][:40]!a} is none of 1, 2, 3")
    return Number(
        cell["table"] or path.stem,
        cell["method"],
        cell["setting"],
        cell["dataset"] or UNKNOWN if "dataset" in row else path.stem,
        cell["scene"],
        cell["metric"],
        cell["variant"] or UNKNOWN,
        float(cell["value"]),
        _digits(cell["value"]),
        int(cell["mark"]) if cell["mark"] else None,
        where,
    )


def _digits(text: str) -> int:
    if "e" in text.lower():
        return 6
    return len(text.partition(".")[2])


# kind -> what it means, in the order they are listed
KINDS = {
    "repeated": "numbers equal to the digit where they must not be",
    "contradiction": "the same thing with another number elsewhere",
    "swapped": "numbers or columns that look exchanged",
    "mean": "a mean that does not follow from what it is the mean of",
    "out of place": "a number its metric, or its neighbours, do not allow",
    "rank": "a marked rank that the numbers do not give",
    "digits": "another number of digits than the rest of its column",
    "unit": "it is not said what was counted",
}


@dataclass(frozen=True)
class Finding:
    kind: str  # of `KINDS`
    text: str  # one line
    tables: tuple[str, ...]
    where: tuple[str, ...]  # file:line of every number involved


def finding(kind: str, text: str, numbers: Iterable[Number]) -> Finding:
    """A finding about these numbers."""
    involved = list(numbers)
    return Finding(
        kind,
        text,
        tuple(dict.fromkeys(n.table for n in involved)),
        tuple(dict.fromkeys(n.where for n in involved)),
    )


def place_name(number: Number) -> str:
    """Where it was measured, for people."""
    if number.scene == "mean":
        return f"the mean of {number.dataset}"
    if number.scene == "all":
        return f"all of {number.dataset}"
    return number.scene if number.scene != "unknown" else "a scene not named"


def method_name(number: Number) -> str:
    return f"{number.method} ({number.setting})" if number.setting else number.method
