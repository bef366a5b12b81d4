"""Comparisons side by side: the papers' tables, means over datasets, memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.harness.running.store import Runs
from ambiguous_wild.harness.tables.comparison import comparison
from ambiguous_wild.harness.tables.significance import Ties
from ambiguous_wild.harness.tables.table import Cell, Row, Table

PER_TABLE = 6  # scenes side by side, as the papers have it
MEAN = "Mean"
LPIPS = ("lpips_alex", "lpips_vgg", "lpips_vgg_01")
MEMORY = ("model_mb",)


def paper(
    runs: Runs,
    *,
    metrics: Sequence[str] = (),
    scenes: Sequence[str] = (),
    datasets: Mapping[str, Sequence[str]] | None = None,
    per_table: int = PER_TABLE,
    subject: str = "",
) -> list[Table]:
    """Scenes side by side, PSNR / SSIM / LPIPS under each, the mean last.

    Args:
        runs: from `store.read_runs`.
        metrics: columns under each scene; empty = PSNR, SSIM and the LPIPS that was measured.
        scenes: only these; empty = all.
        datasets: scenes by dataset: each has tables and a mean of its own; what is in none comes last.
        per_table: more scenes than this go into several tables; the mean stands in the last.
        subject: what the tables are of, where the columns do not say it.

    Raises:
        AwError: unknown metric, scene, or a scene in two datasets.
    """
    ties, made, begin = Ties(runs), [], f"{subject}, " if subject else ""
    for name, members in divided(runs, scenes, datasets or {}).items():
        tables = comparison(
            runs, metrics=metrics or quality_columns(runs), scenes=members, drop_empty=not metrics
        )
        tables = ties.marked(tables, members)
        by_scene, mean = (tables[1:], tables[:1]) if len(members) > 1 else (tables, [])
        title = begin + (name or (f"{len(members)} scenes" if mean else tables[0].title))
        chunks = [by_scene[i : i + per_table] for i in range(0, len(by_scene), per_table)]
        for number, chunk in enumerate(chunks, start=1):
            part = f" ({number} of {len(chunks)})" if len(chunks) > 1 else ""
            shown = [(table.title, table) for table in chunk]
            shown += [(MEAN, table) for table in mean if number == len(chunks)]
            made.append(side_by_side(title + part, shown, dataset=name).with_notes(*tables[-1].notes))
    return made


def means(
    runs: Runs,
    *,
    metrics: Sequence[str] = (),
    scenes: Sequence[str] = (),
    datasets: Mapping[str, Sequence[str]] | None = None,
) -> list[Table]:
    """One table: the mean over each dataset's scenes side by side; arguments as for `paper`."""
    ties = Ties(runs)
    parts: list[Table] = []
    notes: dict[str, None] = {}
    for name, members in divided(runs, scenes, datasets or {}).items():
        tables = comparison(
            runs, metrics=metrics or quality_columns(runs), scenes=members, drop_empty=not metrics
        )
        heading = f"{name or ('other scenes' if parts else 'all scenes')} ({len(members)})"
        (mean,) = ties.marked(tables[:1], members)
        part = side_by_side("", [(heading, mean)], dataset=name)
        parts.append(replace(part, columns=tuple(replace(column, scene="") for column in part.columns)))
        notes |= dict.fromkeys(tables[-1].notes)
    methods = sorted({row.name for part in parts for row in part.rows})
    rows = [Row(m, tuple(cell for part in parts for cell in _cells(part, m))) for m in methods]
    columns = tuple(column for part in parts for column in part.columns)
    return [Table("means over scenes, by dataset (number of scenes)", columns, tuple(rows), tuple(notes))]


def side_by_side(title: str, tables: Sequence[tuple[str, Table]], *, dataset: str = "") -> Table:
    """One table of tables with the same rows.

    Args:
        title: of the table.
        tables: (heading of its columns, table), from the left; their notes are left out.
        dataset: that the scenes belong to.
    """
    columns = [replace(c, group=group, dataset=dataset) for group, table in tables for c in table.columns]
    rows = []
    for same in zip(*(table.rows for _, table in tables)):
        note = next((row.note for row in same if row.note), "")
        rows.append(Row(same[0].name, tuple(cell for row in same for cell in row.cells), note=note))
    return Table(title, tuple(columns), tuple(rows))


def cost_at_the_end(tables: Sequence[Table]) -> Table:
    """Tables of `comparison` as one without a title: quality scene by scene, the mean last, then cost."""
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
    """The scenes by dataset, in the order given; those of none under "".

    Raises:
        AwError: an unknown scene, or one in two datasets.
    """
    known = sorted(set(runs.runs["scene"]) | {i.scene for i in runs.incomplete})
    for name in [*scenes, *(s for members in datasets.values() for s in members)]:
        if name not in known:
            raise unknown("scene", name, known)
    wanted = list(dict.fromkeys(scenes)) or sorted(set(runs.runs["scene"]))
    of: dict[str, str] = {}
    for dataset, members in datasets.items():
        for scene in members:
            if of.setdefault(scene, dataset) != dataset:
                raise AwError(
                    f"scene {scene!r} is in two datasets, {of[scene]!r} and {dataset!r}: leave one out"
                )
    found = {name: tuple(s for s in wanted if of.get(s, "") == name) for name in [*datasets, ""]}
    return {name: members for name, members in found.items() if members}


def quality_columns(runs: Runs) -> tuple[str, ...]:
    """PSNR, SSIM and the first LPIPS that was measured; without any, the one that says why it is missing."""
    measured = set(runs.images.dropna(subset=["value"])["metric"])
    present = measured | set(runs.images["metric"])
    lpips = next((k for k in LPIPS if k in measured), next((k for k in LPIPS if k in present), ""))
    return ("psnr", "ssim", *([lpips] if lpips else []))


def _cells(part: Table, method: str) -> tuple[Cell, ...]:
    found = [row.cells for row in part.rows if row.name == method]
    return found[0] if found else tuple(Cell(state="absent") for _ in part.columns)
