"""From runs to laid-out tables: the paper's, means over datasets, memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.running.store import Runs
from ambiguous_wild.harness.tables.comparison import Block, Table, comparison
from ambiguous_wild.harness.tables.layouts.grid import Column, Layout, LayoutCell, Line
from ambiguous_wild.harness.tables.layouts.significance import Ties
from ambiguous_wild.methods.registry import knows_truth

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
) -> list[Layout]:
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
    ties, layouts, begin = Ties(runs), [], f"{subject}, " if subject else ""
    for name, members in divided(runs, scenes, datasets or {}).items():
        table = comparison(
            runs, metrics=metrics or quality_columns(runs), scenes=members, drop_empty=not metrics
        )
        blocks = [b for b in table.blocks if b.scene is not None]
        mean = [b for b in table.blocks if b.scene is None]
        chunks = [blocks[i : i + per_table] for i in range(0, len(blocks), per_table)]
        for number, chunk in enumerate(chunks, start=1):
            part = f" ({number} of {len(chunks)})" if len(chunks) > 1 else ""
            shown = chunk + (mean if number == len(chunks) else [])
            layouts.append(_layout(begin + (name or _title(table)) + part, table, shown, ties, dataset=name))
    return layouts


def means(
    runs: Runs,
    *,
    metrics: Sequence[str] = (),
    scenes: Sequence[str] = (),
    datasets: Mapping[str, Sequence[str]] | None = None,
) -> list[Layout]:
    """One table: the mean over each dataset's scenes side by side; arguments as for `paper`."""
    ties = Ties(runs)
    parts: list[Layout] = []
    notes: dict[str, None] = {}
    for name, members in divided(runs, scenes, datasets or {}).items():
        table = comparison(
            runs, metrics=metrics or quality_columns(runs), scenes=members, drop_empty=not metrics
        )
        heading = f"{name or ('other scenes' if parts else 'all scenes')} ({len(members)})"
        parts.append(_layout("", table, table.blocks[:1], ties, heading=heading, dataset=name))
        notes |= dict.fromkeys(table.notes)
    methods = sorted({line.name for part in parts for line in part.lines})
    lines = [Line(m, tuple(e for part in parts for e in _entries(part, m))) for m in methods]
    columns = tuple(column for part in parts for column in part.columns)
    return [Layout("means over scenes, by dataset (number of scenes)", columns, tuple(lines), tuple(notes))]


def blocks(runs: Runs, *, metrics: Sequence[str] = (), scenes: Sequence[str] = ()) -> list[Layout]:
    """One table a scene, the mean first, every measure a column: what `comparison` has."""
    ties, table = Ties(runs), comparison(runs, metrics=metrics, scenes=scenes)
    made = [_layout(b.scene or table.title, table, (b,), ties, heading="") for b in table.blocks]
    return [_without_notes(layout) for layout in made[:-1]] + made[-1:]


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


def _title(table: Table) -> str:
    return table.title if len(table.scenes) == 1 else f"{len(table.scenes)} scenes"


def _layout(
    title: str,
    table: Table,
    shown: Sequence[Block],
    ties: Ties,
    *,
    heading: str | None = None,  # of every column; None: the scene, or that it is the mean
    dataset: str = "",
) -> Layout:
    columns = []
    for block in shown:
        group = heading if heading is not None else block.scene or MEAN
        scene = "" if heading else block.scene or ""
        columns += [Column(group, measure, scene, dataset) for measure in table.columns]
    lines = []
    for k, row in enumerate(table.blocks[0].rows):
        entries = [e for block in shown for e in _row_entries(block, k, table, ties)]
        why = "knows the truth" if knows_truth(row.method) else "unfinished"
        lines.append(Line(row.method, tuple(entries), note="" if row.ranked else f"{why}, not ranked"))
    return Layout(title, tuple(columns), tuple(lines), table.notes)


def _row_entries(block: Block, k: int, table: Table, ties: Ties) -> list[LayoutCell]:
    row = block.rows[k]
    entries = []
    for i, measure in enumerate(table.columns):
        tie = row.ranked and row.cells[i].state == "ok" and _tied(block, i, row.method, measure, table, ties)
        entries.append(LayoutCell.of(row.cells[i], tie=tie))
    return entries


def _tied(block: Block, i: int, method: str, measure: Measure, table: Table, ties: Ties) -> bool:
    best = [row.method for row in block.rows if row.cells[i].rank == 1]
    if not measure.per_image or not best or method in best:
        return False
    scenes = table.scenes if block.scene is None else (block.scene,)
    return ties.tied(best[0], method, scenes, measure.key)


def _entries(part: Layout, method: str) -> tuple[LayoutCell, ...]:
    found = [line.entries for line in part.lines if line.name == method]
    return found[0] if found else tuple(LayoutCell(state="absent") for _ in part.columns)


def _without_notes(layout: Layout) -> Layout:
    return Layout(layout.title, layout.columns, layout.lines)
