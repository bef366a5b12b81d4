"""Tables in the form of papers: scenes side by side, means over datasets, rows with reported numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.datasets.foreign import plain
from ambiguous_wild.harness.store import Runs, check_names
from ambiguous_wild.report.audit_numbers import MEAN, REPORTED, PrintedNumber, read_tables
from ambiguous_wild.report.comparison import comparison, quality_columns
from ambiguous_wild.report.pairs import Ties
from ambiguous_wild.report.table_layout import BLANK, Column, Row, Table, TableCell

PER_TABLE = 6  # scenes side by side, as in the papers; more are several tables, the last with the mean
FAMILIES = ("psnr", "ssim", "lpips")
NAMES = {"model_mb": "memory"}  # key of a measure -> its name in papers


def in_blocks(runs: Runs, *, metrics: Sequence[str] = (), scenes: Sequence[str] = ()) -> list[Table]:
    """Return the tables of `comparison`, with cells marked that do not differ from the best."""
    tables = comparison(runs, metrics=metrics, scenes=scenes)
    return Ties(runs).marked(tables, [table.title for table in tables if table.columns[0].scene])


def paper(
    runs: Runs,
    *,
    metrics: Sequence[str] = (),
    scenes: Sequence[str] = (),
    datasets: Mapping[str, Sequence[str]] | None = None,
) -> list[Table]:
    """Return tables with scenes side by side, PSNR / SSIM / LPIPS under each, and the mean last.

    Args:
        runs: from `store.read_runs`.
        metrics: columns under each scene; empty = PSNR, SSIM and the LPIPS that was measured.
        scenes: names of scenes to show; empty = all.
        datasets: scenes by dataset. Each dataset has its own tables and mean; other scenes come last.

    Raises:
        AwError: unknown metric, scene, or a scene in two datasets.
    """
    parts = []
    for name, members, tables in _by_dataset(runs, metrics, scenes, datasets or {}):
        by_scene, mean = (tables[1:], tables[:1]) if len(members) > 1 else (tables, [])
        title = name or (f"{len(members)} scenes" if mean else tables[0].title)
        chunks = [by_scene[i : i + PER_TABLE] for i in range(0, len(by_scene), PER_TABLE)]
        for number, chunk in enumerate(chunks, start=1):
            part = f" ({number} of {len(chunks)})" if len(chunks) > 1 else ""
            shown = [(table.title, table) for table in chunk]
            shown += [("Mean", table) for table in mean if number == len(chunks)]
            parts.append(side_by_side(title + part, shown, dataset=name).with_notes(*tables[-1].notes))
    return parts


def _by_dataset(
    runs: Runs, metrics: Sequence[str], scenes: Sequence[str], datasets: Mapping[str, Sequence[str]]
) -> Iterator[tuple[str, tuple[str, ...], list[Table]]]:
    """Yield each dataset with its scenes and the tables of `comparison`, ties marked; the mean is first."""
    ties, shown = Ties(runs), metrics or quality_columns(runs)
    for name, members in divided(runs, scenes, datasets).items():
        tables = comparison(runs, metrics=shown, scenes=members, drop_empty=not metrics)
        yield name, members, ties.marked(tables, members)


def means(
    runs: Runs,
    *,
    metrics: Sequence[str] = (),
    scenes: Sequence[str] = (),
    datasets: Mapping[str, Sequence[str]] | None = None,
) -> list[Table]:
    """Return one table with the means over each dataset's scenes side by side; arguments as for `paper`."""
    parts: list[Table] = []
    notes: dict[str, None] = {}
    for name, members, tables in _by_dataset(runs, metrics, scenes, datasets or {}):
        heading = f"{name or ('other scenes' if parts else 'all scenes')} ({len(members)})"
        part = side_by_side("", [(heading, tables[0])], dataset=name)
        parts.append(replace(part, columns=tuple(replace(column, scene="") for column in part.columns)))
        notes |= dict.fromkeys(tables[-1].notes)
    rows = []
    every = {row.name: row for part in parts for row in part.rows}
    for method in (name for name in runs.rows() if name in every):
        cells: list[TableCell] = []
        for part in parts:
            absent = (TableCell(state="absent"),) * len(part.columns)
            cells += next((row.cells for row in part.rows if row.name == method), absent)
        rows.append(replace(every[method], cells=tuple(cells)))
    columns = tuple(column for part in parts for column in part.columns)
    return [Table("means over scenes, by dataset (number of scenes)", columns, tuple(rows), tuple(notes))]


def side_by_side(title: str, tables: Sequence[tuple[str, Table]], *, dataset: str = "") -> Table:
    """Join tables with the same rows to one table.

    Args:
        title: title of the table.
        tables: (heading of the columns, table), from left to right; their notes are left out.
        dataset: dataset of the scenes.
    """
    shown, rows = [], []
    for number, (group, table) in enumerate(tables, start=1):
        # text columns about a row are kept once, in the last table
        own = [i for i, c in enumerate(table.columns) if not c.words or number == len(tables)]
        shown.append((group, table.picked(own)))
    columns = [
        replace(c, group="" if c.words else group, dataset=dataset)
        for group, table in shown
        for c in table.columns
    ]
    for same in zip(*(table.rows for _, table in shown)):
        note = next((row.note for row in same if row.note), "")
        rows.append(replace(same[0], cells=tuple(cell for row in same for cell in row.cells), note=note))
    return Table(title, tuple(columns), tuple(rows))


def cost_at_the_end(tables: Sequence[Table]) -> Table:
    """Join tables of `comparison` to one without a title: quality by scene, then the mean, then cost."""
    ordered = [*tables[1:], tables[0]] if len(tables) > 1 else list(tables)
    numbers = range(len(tables[0].columns))
    quality = [i for i in numbers if tables[0].columns[i].measure.quality]
    cost = [i for i in numbers if i not in quality]
    shown = [(table.title, table.picked(quality)) for table in ordered if quality]
    if cost:
        shown.append(("cost" if quality else ordered[-1].title, ordered[-1].picked(cost)))
    return side_by_side("", shown).with_notes(*tables[-1].notes)


def divided(
    runs: Runs, scenes: Sequence[str], datasets: Mapping[str, Sequence[str]]
) -> dict[str, tuple[str, ...]]:
    """Return the scenes by dataset, in the given order; those without a dataset under "".

    Raises:
        AwError: an unknown scene, or a scene in two datasets.
    """
    present = sorted(set(runs.runs["scene"]) | {i.scene for i in runs.incomplete})
    check_names("scene", [*scenes, *(s for members in datasets.values() for s in members)], present)
    wanted = list(dict.fromkeys(scenes)) or sorted(set(runs.runs["scene"]))
    of: dict[str, str] = {}
    for dataset, members in datasets.items():
        for scene in members:
            if of.setdefault(scene, dataset) != dataset:
                raise AwError(
                    f"scene {scene!r} is in two datasets, {of[scene]!r} and {dataset!r}: leave one out"
                )
    by_dataset = {name: tuple(s for s in wanted if of.get(s, "") == name) for name in [*datasets, ""]}
    return {name: members for name, members in by_dataset.items() if members}


def read_reported(folder: Path | None = None) -> list[PrintedNumber]:
    """Read the numbers transcribed from papers.

    Raises:
        AwError: there are none, or a file cannot be read.
    """
    folder = folder or REPORTED
    if not folder.exists():
        raise AwError(f"no reported numbers in {folder}: name their folder with --reported")
    return read_tables([folder])


def datasets_of(numbers: Sequence[PrintedNumber], scenes: Sequence[str]) -> dict[str, list[str]]:
    """Group our scenes by the dataset in which a reported table has a scene of the same name."""
    dataset_of = {plain(n.scene): n.dataset for n in numbers if n.known}
    datasets: dict[str, list[str]] = {}
    for scene in scenes:
        if plain(scene) in dataset_of:
            datasets.setdefault(dataset_of[plain(scene)], []).append(scene)
    return datasets


def with_reported(table: Table, numbers: Sequence[PrintedNumber]) -> Table:
    """Add a row for every method that a paper reports on the table's scenes and metrics.

    Only methods as published are added, no rows of ablations. Where papers contradict each other, all values
    are shown. A paper's mean over a dataset is shown under ours even if its scenes differ.

    Args:
        table: a table of `papers`.
        numbers: from `read_reported`.
    """
    texts: dict[tuple[str, str, str], dict[str, list[str]]] = {}  # (method, scene, metric) -> by dataset
    for n in numbers:
        if n.known and not n.setting:
            by_dataset = texts.setdefault((n.method, plain(n.scene), n.metric), {})
            by_dataset.setdefault(n.dataset, []).append(n.text)
    rows = []
    for method in dict.fromkeys(key[0] for key in texts):
        cells = tuple(_cell(texts, method, column) for column in table.columns)
        if any(cell.printed for cell in cells):
            rows.append(Row(method, cells, kind="reported"))
    if not rows:
        return table.with_notes("reported: no paper's table has these scenes")
    return replace(table, rows=(*table.rows, *rows))


def _cell(
    texts: Mapping[tuple[str, str, str], Mapping[str, list[str]]], method: str, column: Column
) -> TableCell:
    family = column.measure.key.partition("_")[0]
    metric = NAMES.get(column.measure.key, family if family in FAMILIES else "")
    by_dataset = texts.get((method, plain(column.scene or MEAN), metric), {})
    if column.dataset:
        values = by_dataset.get(column.dataset, [])
    else:  # the name identifies a scene without its dataset, but not a mean
        values = [text for of in by_dataset.values() for text in of] if column.scene else []
    return TableCell(printed=" / ".join(dict.fromkeys(values))) if values else BLANK
