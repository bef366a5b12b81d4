"""Numbers that others printed: read to be shown beside measured ones, never to be mixed with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ambiguous_wild.harness.audit.table import read_tables
from ambiguous_wild.harness.leaderboard.sheet import CsvValue, to_csv

SOURCE = "reported"
COLUMNS = (
    "source",
    "method",
    "setting",
    "dataset",
    "scene",
    "metric",
    "variant",
    "value",
    "printed",
    "table",
)


@dataclass(frozen=True)
class Printed:
    """One number of a paper's table."""

    method: str
    setting: str
    dataset: str
    scene: str
    metric: str
    variant: str  # "unknown" where the paper does not say
    value: float
    printed: str  # with the digits it has there
    table: str

    def plain(self) -> dict[str, Any]:
        return asdict(self)


def read_reported(folder: Path) -> list[Printed]:
    """Every number of FOLDER/*.csv that says method and scene, in order; none without the folder.

    Raises:
        AwError: a file that is unreadable or malformed.
    """
    if not folder.is_dir() or not any(folder.glob("*.csv")):
        return []
    found = [
        Printed(n.method, n.setting, n.dataset, n.scene, n.metric, n.variant, n.value, n.text, n.table)
        for n in read_tables([folder])
        if n.known and n.method != "dataset"  # of no method: what the text says of the photos
    ]
    return sorted(
        found, key=lambda n: (n.dataset, n.method, n.setting, n.scene, n.table, n.metric, n.variant)
    )


def reported_csv(numbers: Sequence[Printed]) -> str:
    """One number a row, each marked as reported; beside the value how it is printed."""
    rows: Iterator[list[CsvValue]] = (
        [SOURCE, n.method, n.setting, n.dataset, n.scene, n.metric, n.variant, n.value, n.printed, n.table]
        for n in numbers
    )
    return to_csv(COLUMNS, rows)
