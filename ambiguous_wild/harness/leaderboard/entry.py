"""One measured run as a row of the leaderboard."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.harness.leaderboard.sheet import CsvValue, number, to_count, to_number, unguard
from ambiguous_wild.harness.measures import MEASURES

FIRST = ("dataset", "scene", "method", "setting", "options", "seed", "images")
LAST = (
    "missing", "device", "hardware", "version", "source", "code_hash", "config_hash", "scene_hash",
    "result_hash", "checked", "reproduce", "row_hash",
)  # fmt: skip
NO_TEXT = ("seed", "images", "missing", "checked", "row_hash")  # columns of others than plain text
COST = "cost_"  # begins the column of a cost; every other column of numbers is a quality
ALONE = "alone"  # the cost that says whether the run had the machine alone: 1 or 0
TIDY = (
    "dataset", "scene", "method", "setting", "options", "seed", "kind", "metric", "value", "device",
    "version", "source", "config_hash", "scene_hash", "checked",
)  # fmt: skip
# What was computed again from renders and photos: every metric of pictures, PSNR alone, or nothing.
Checked = Literal["photos", "psnr", "files"]
CHECKED: tuple[Checked, ...] = ("files", "psnr", "photos")  # the stronger last
Key = tuple[str, str, str, str, str, int]


@dataclass(frozen=True)
class Entry:
    """A run on the board; its values are means over the test images."""

    dataset: str
    scene: str
    method: str
    setting: str  # what sets it apart, for people: "2000 iterations, effects exposure"
    options: str  # first 8 hex digits of the hash of the method's options; empty where it has none
    seed: int
    images: int  # test images behind the values
    quality: Mapping[str, float]  # metric variant -> value
    cost: Mapping[str, float]  # as in the result file, numbers only
    missing: tuple[str, ...]  # metrics that were asked for and are not there
    device: str
    hardware: str  # what times depend on
    version: str  # of this package
    source: str  # sha256 of the method's own file; empty for the methods of this package
    code_hash: str  # sha256 over this package's files; empty in results of before it was kept
    config_hash: str
    scene_hash: str
    result_hash: str  # sha256 of metrics.json
    checked: Checked
    reproduce: str  # the command

    @property
    def key(self) -> Key:
        """The cell it fills."""
        return (self.dataset, self.scene, self.method, self.setting, self.options, self.seed)

    @property
    def name(self) -> str:
        return f"{self.method} on {self.scene} with seed {self.seed} ({self.setting})"

    @property
    def row_hash(self) -> str:
        """sha256 over the cells of its row: what a hand or a spreadsheet changes there shows."""
        plain = {k: getattr(self, k) for k in (*FIRST, *LAST) if k != "row_hash"}
        values = {k: {m: number(v) for m, v in getattr(self, k).items()} for k in ("quality", "cost")}
        return config_hash(plain | values)


def in_order(names: Iterable[str]) -> list[str]:
    """Metrics in the order tables have them, then by name."""
    known = list(MEASURES)
    return sorted(names, key=lambda n: (known.index(n) if n in known else len(known), n))


def wide(entries: Sequence[Entry]) -> tuple[list[str], list[list[CsvValue]]]:
    """Head and rows, one row a run."""
    quality = in_order({k for e in entries for k in e.quality})
    cost = in_order({k for e in entries for k in e.cost})
    head = [*FIRST, *quality, *(COST + k for k in cost), *LAST]
    rows: list[list[CsvValue]] = []
    for e in sorted(entries, key=lambda e: e.key):
        row: list[CsvValue] = [*e.key, e.images]
        row += [e.quality.get(k) for k in quality]
        row += [e.cost.get(k) for k in cost]
        row += [" ".join(e.missing), e.device, e.hardware, e.version, e.source, e.code_hash]
        rows.append([*row, e.config_hash, e.scene_hash, e.result_hash, e.checked, e.reproduce, e.row_hash])
    return head, rows


def from_wide(head: Sequence[str], row: Mapping[str, str], where: str) -> Entry:
    """The entry of a row.

    Raises:
        AwError: a cell that cannot be.
    """
    text = {k: unguard(row[k]) for k in (*FIRST, *LAST)}
    numbers = {
        k: value
        for k in head
        if k not in FIRST and k not in LAST and not math.isnan(value := to_number(row[k], f"{where}, {k}"))
    }
    counts = {column: to_count(text[column], f"{where}: {column}") for column in ("seed", "images")}
    checked = next((c for c in CHECKED if c == text["checked"]), None)
    if checked is None:
        raise AwError(
            f"{where}: checked is {text['checked'][:40]!a}, none of {', '.join(CHECKED)}; restore it"
        )
    names = {k: text[k] for k in (*FIRST, *LAST) if k not in NO_TEXT}
    return Entry(
        **names,
        seed=counts["seed"],
        images=counts["images"],
        quality={k: v for k, v in numbers.items() if not k.startswith(COST)},
        cost={k.removeprefix(COST): v for k, v in numbers.items() if k.startswith(COST)},
        missing=tuple(text["missing"].split()),
        checked=checked,
    )


def tidy(entries: Iterable[Entry]) -> Iterator[list[CsvValue]]:
    """Rows under `TIDY`, one a run and metric; what is missing has a row without a value."""
    for e in sorted(entries, key=lambda e: e.key):
        last = [e.device, e.version, e.source, e.config_hash, e.scene_hash, e.checked]
        qualities = {**dict.fromkeys(e.missing, math.nan), **e.quality}
        for kind, values in (("quality", qualities), ("cost", e.cost)):
            for metric in in_order(values):
                yield [*e.key, kind, metric, values[metric], *last]
