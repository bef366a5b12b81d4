"""Numbers that papers print, beside measured ones: rows of their own, never ranked, never averaged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.audit.table import MEAN, REPORTED, Number, read_tables
from ambiguous_wild.harness.tables.table import BLANK, Cell, Column, Row, Table

FAMILIES = ("psnr", "ssim", "lpips")
NAMES = {"model_mb": "memory"}  # a measure -> how papers call it


def read_reported(folder: Path | None = None) -> list[Number]:
    """The transcribed tables.

    Raises:
        AwError: there are none, or one cannot be read.
    """
    folder = folder or REPORTED
    if not folder.exists():
        raise AwError(f"no reported numbers in {folder}: say where they are with --reported-from")
    return read_tables([folder])


def datasets_of(numbers: Sequence[Number], scenes: Sequence[str]) -> dict[str, list[str]]:
    """Our scenes by the dataset that a reported table has a scene of this name in."""
    of = {_plain(n.scene): n.dataset for n in numbers if n.known}
    found: dict[str, list[str]] = {}
    for scene in scenes:
        if _plain(scene) in of:
            found.setdefault(of[_plain(scene)], []).append(scene)
    return found


def with_reported(table: Table, numbers: Sequence[Number]) -> Table:
    """The table with a row for every method that some paper reports on what it shows.

    Only methods as published: a row of an ablation has no place here. Where tables contradict each other,
    all their values are shown. A paper's mean over a dataset stands under ours, over the same scenes or not.

    Args:
        table: a table of `papers`.
        numbers: from `read_reported`.
    """
    texts: dict[tuple[str, str, str], dict[str, list[str]]] = {}  # (method, scene, metric) -> by dataset
    for n in numbers:
        if n.known and not n.setting:
            texts.setdefault((n.method, _plain(n.scene), n.metric), {}).setdefault(n.dataset, []).append(
                n.text
            )
    rows = []
    for method in dict.fromkeys(key[0] for key in texts):
        cells = tuple(_cell(texts, method, column) for column in table.columns)
        if any(cell.printed for cell in cells):
            rows.append(Row(method, cells, kind="reported"))
    if not rows:
        return table.with_notes("reported: no table has these scenes")
    return replace(table, rows=(*table.rows, *rows))


def _cell(texts: Mapping[tuple[str, str, str], Mapping[str, list[str]]], method: str, column: Column) -> Cell:
    family = column.measure.key.partition("_")[0]
    metric = NAMES.get(column.measure.key, family if family in FAMILIES else "")
    by_dataset = texts.get((method, _plain(column.scene or MEAN), metric), {})
    if column.dataset:
        found = by_dataset.get(column.dataset, [])
    else:  # a scene is told by its name alone, a mean is not
        found = [text for of in by_dataset.values() for text in of] if column.scene else []
    return Cell(printed=" / ".join(dict.fromkeys(found))) if found else BLANK


def _plain(name: str) -> str:
    """A scene's name without what its spellings differ in."""
    return "".join(c for c in name.casefold() if c.isalnum())
