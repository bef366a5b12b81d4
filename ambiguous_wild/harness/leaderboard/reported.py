"""Numbers that others printed: read to be shown beside measured ones, never to be mixed with them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.audit.finding import Finding
from ambiguous_wild.harness.audit.run import audit
from ambiguous_wild.harness.audit.table import read_tables
from ambiguous_wild.harness.leaderboard.sheet import CsvValue, board_csv

SOURCE = "reported"
SOURCES = "sources.json"
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
    where: str = ""  # file and line

    def plain(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class Reported:
    """What papers print, where it stands, and what `aw audit` found in it."""

    numbers: tuple[Printed, ...] = ()
    findings: tuple[Finding, ...] = ()
    sources: dict[str, dict[str, str]] = field(default_factory=dict)  # table -> title, venue, url, caption

    def plain(self) -> dict[str, Any]:
        """For the page: findings are looked up by the place of a number."""
        return {
            "reported": [n.plain() for n in self.numbers],
            "findings": [{"kind": f.kind, "text": f.text, "where": list(f.where)} for f in self.findings],
            "sources": self.sources,
        }


def read_reported(folder: Path) -> Reported:
    """Every number of FOLDER/*.csv that says method and scene, in order; none without the folder.

    Raises:
        AwError: a file that is unreadable or malformed.
    """
    if not folder.is_dir() or not any(folder.glob("*.csv")):
        return Reported()
    numbers = read_tables([folder])
    found = [
        Printed(
            n.method, n.setting, n.dataset, n.scene, n.metric, n.variant, n.value, n.text, n.table, n.where
        )
        for n in numbers
        if n.known and n.method != "dataset"  # of no method: what the text says of the photos
    ]
    found.sort(key=lambda n: (n.dataset, n.method, n.setting, n.scene, n.table, n.metric, n.variant))
    return Reported(tuple(found), tuple(audit(numbers)), read_sources(folder / SOURCES))


def read_sources(path: Path) -> dict[str, dict[str, str]]:
    """Table -> title of its paper, link and caption, from the sources.json beside reported tables.

    Raises:
        AwError: it is there and not of that form.
    """
    if not path.is_file():
        return {}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        papers, tables = found["papers"], found["tables"]
        return {
            str(name): {
                "caption": str(about.get("caption", "")),
                "title": str(papers[about["paper"]].get("title", "")),
                "venue": str(papers[about["paper"]].get("venue", "")),
                "url": _link(papers[about["paper"]].get("url", "")),
            }
            for name, about in tables.items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise AwError(
            f'{path} is malformed: write {{"papers": {{ID: {{"title", "venue", "url"}}}}, '
            '"tables": {TABLE: {"paper": ID, "caption"}}}'
        ) from None


def _link(url: object) -> str:
    """An address that a page may link to; empty for anything else, such as javascript:."""
    text = str(url or "")
    return text if re.fullmatch(r"https?://[^\s\"'<>]+", text) else ""


def reported_csv(numbers: Sequence[Printed]) -> str:
    """One number a row, each marked as reported; beside the value how it is printed."""
    rows: Iterator[list[CsvValue]] = (
        [SOURCE, n.method, n.setting, n.dataset, n.scene, n.metric, n.variant, n.value, n.printed, n.table]
        for n in numbers
    )
    return board_csv(COLUMNS, rows)
