"""From runs to a comparison: rows are methods, columns are measures, one block a scene.

The mean is taken over images, then over seeds, then over scenes, in that order. No mean is shown where a
value is missing. A scene that cannot have a value, such as a mask score without distractors, is left out of
the mean, for every method. A failed run makes its cell "failed", so that no method gains by failing where
it is hard, and a method with an unfinished run shows what it has but is not ranked.
`render.py` writes a `Table` as text, Markdown, CSV or LaTeX.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist, unknown
from ambiguous_wild.harness.measures import ALWAYS, COST, MEASURES, PARTIAL, Measure, measure
from ambiguous_wild.harness.running.store import TEXT_OF_RUNS, Runs
from ambiguous_wild.harness.tables.notes import notes
from ambiguous_wild.harness.tables.times import incomparable, untimed
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats

MASK_COLUMNS = ("mask_iou", "mask_precision")
UNDEFINED_ON_SOME = (*PARTIAL, *MASK_COLUMNS, "mask_recall")
State = Literal["ok", "missing", "failed", "absent"]


@dataclass(frozen=True)
class TableCell:
    """One number of the table."""

    value: float = math.nan
    spread: float = math.nan  # sample deviation over seeds; NaN for one seed
    low: float = math.nan  # 95 % bootstrap interval over the images of one scene
    high: float = math.nan
    rank: int | None = None  # 1, 2, 3 or None
    ranged: bool = False  # a time that cannot be compared: shown from `low` to `high`, its least and its most
    state: State = "ok"


@dataclass(frozen=True)
class Row:
    method: str
    cells: tuple[TableCell, ...]  # one a column
    runs: int  # finished runs behind it
    ranked: bool = True  # False: a run behind it is unfinished, or the method knows the truth


@dataclass(frozen=True)
class Block:
    scene: str | None  # None: the mean over all scenes
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Table:
    columns: tuple[Measure, ...]
    blocks: tuple[Block, ...]  # the mean over scenes first, where there are several
    scenes: tuple[str, ...]
    notes: tuple[str, ...]  # what is missing, failed or not comparable

    @property
    def title(self) -> str:
        return self.scenes[0] if len(self.scenes) == 1 else f"mean over {len(self.scenes)} scenes"

    def with_note(self, note: str) -> Table:
        """The same table with one more line below."""
        return replace(self, notes=(*self.notes, note))


def comparison(
    runs: Runs, *, metrics: Sequence[str] = (), scenes: Sequence[str] = (), drop_empty: bool | None = None
) -> Table:
    """The comparison of every method over the scenes.

    Args:
        runs: from `store.read_runs`.
        metrics: columns by key, in this order; empty: PSNR, SSIM, LPIPS, whatever else was measured, mask
            IoU and cost.
        scenes: only these, in this order; empty: all, by name.
        drop_empty: leave out columns without any value; a note says why they are empty. None: unless
            `metrics` names them.

    Raises:
        AwError: a metric or scene that no run has, or no finished run.
    """
    frame = runs.runs
    if not len(frame):
        names = shortlist(f"{i.folder} ({i.reason})" for i in runs.incomplete)
        raise AwError(f"no finished run: {names}")
    known = sorted(frame["scene"].unique())
    for name in scenes:
        if name not in known:
            raise unknown("scene", name, known)
    chosen = tuple(dict.fromkeys(scenes)) or tuple(known)
    runs = replace(
        runs,
        runs=frame[frame["scene"].isin(chosen)],
        images=runs.images[runs.images["scene"].isin(chosen)],
        missing=runs.missing[runs.missing["scene"].isin(chosen)],
    )
    methods = sorted(runs.runs["method"].unique())
    index = _Index(runs)
    columns = _columns(runs, metrics)
    defined = {c.key: [s for s in chosen if index.can_have(s, c, methods)] for c in columns}
    unranked = incomparable(runs.runs, columns)
    blocks = [Block(scene, tuple(_scene_row(index, m, scene, columns) for m in methods)) for scene in chosen]
    if len(chosen) > 1:
        mean = tuple(_mean_row(index, m, chosen, columns, blocks, defined) for m in methods)
        blocks.insert(0, Block(None, mean))
    told = (*notes(runs, columns, methods, chosen), *_undefined(columns, chosen, defined))
    if drop_empty if drop_empty is not None else not metrics:
        columns, blocks = _without_empty(columns, blocks)
    return Table(columns, tuple(_ranked(b, columns, unranked) for b in blocks), chosen, told)


def _without_empty(
    columns: tuple[Measure, ...], blocks: list[Block]
) -> tuple[tuple[Measure, ...], list[Block]]:
    """Without the columns that have no value anywhere; where none has any, everything stays."""
    kept = [
        i
        for i in range(len(columns))
        if any(row.cells[i].state == "ok" for block in blocks for row in block.rows)
    ]
    return (columns, blocks) if not kept else selected(columns, blocks, kept)


def selected(
    columns: tuple[Measure, ...], blocks: Sequence[Block], kept: Sequence[int]
) -> tuple[tuple[Measure, ...], list[Block]]:
    """Columns and blocks with the columns of these numbers alone."""
    chosen = [
        replace(b, rows=tuple(replace(r, cells=tuple(r.cells[i] for i in kept)) for r in b.rows))
        for b in blocks
    ]
    return tuple(columns[i] for i in kept), chosen


def _undefined(
    columns: tuple[Measure, ...], scenes: tuple[str, ...], defined: Mapping[str, Sequence[str]]
) -> list[str]:
    """A line for the columns whose mean leaves the same scenes out."""
    lines: dict[str, list[str]] = {}
    for column in columns:
        out = [s for s in scenes if s not in defined[column.key]]
        if out and len(out) < len(scenes):
            lines.setdefault(shortlist(out), []).append(column.label)
    return [f"undefined on {out}, left out of the mean: {', '.join(c)}" for out, c in lines.items()]


class _Index:
    """Values by (method, scene): finding them in the frames for every cell would be quadratic."""

    def __init__(self, runs: Runs) -> None:
        self.runs = dict(iter(runs.runs.groupby(["method", "scene"])))
        self.images = dict(iter(runs.images.groupby(["method", "scene", "metric"])))
        self.unfinished = {(i.method, i.scene) for i in runs.incomplete}
        self.untimed = set(untimed(runs.runs))

    def seeds(self, method: str, scene: str, column: Measure) -> pd.Series:
        """The run's value by seed, NaN where missing."""
        rows = self.runs[method, scene].set_index("seed")
        if not column.per_image:
            values = rows[column.key] if column.key in rows else pd.Series(math.nan, index=rows.index)
            values = values.astype(float)
            if column.key in MASK_COLUMNS and "mask_recall" in rows:
                # Without a distractor recall is undefined, and an IoU of 0 says nothing.
                values = values.where(rows["mask_recall"].notna())
            return values.sort_index()
        images = self.images.get((method, scene, column.key))
        found = {} if images is None else {seed: g["value"].to_numpy() for seed, g in images.groupby("seed")}
        means = {seed: stats.mean(found.get(seed, np.empty(0))) for seed in sorted(rows.index)}
        return pd.Series(means, dtype=float)

    def can_have(self, scene: str, column: Measure, methods: Sequence[str]) -> bool:
        """Whether the measure is defined on the scene: some method has a value, or it always is."""
        if column.key not in UNDEFINED_ON_SOME:
            return True
        return any(
            (m, scene) in self.runs and bool(self.seeds(m, scene, column).notna().any()) for m in methods
        )

    def state(self, method: str, scene: str) -> State:
        if (method, scene) not in self.runs:
            return "absent"
        return "failed" if (self.runs[method, scene]["status"] == "failed").any() else "ok"


def _columns(runs: Runs, metrics: Sequence[str]) -> tuple[Measure, ...]:
    images = runs.images.dropna(subset=["value"])
    measured = list(dict.fromkeys([*MEASURES, *sorted(images["metric"].unique())]))
    of_runs = set(runs.runs.columns) - {"scene", "method", *TEXT_OF_RUNS}
    if metrics:
        choices = set(MEASURES) | set(runs.images["metric"]) | of_runs
        for name in metrics:
            if name not in choices:
                raise unknown("metric", name, choices, "'aw table RUNS' shows what was measured")
        listed = [measure(name) for name in dict.fromkeys(metrics)]
        return tuple(replace(m, per_image=False) if m.key in of_runs else m for m in listed)
    present = set(images["metric"]) | set(ALWAYS)
    quality = [measure(k) for k in measured if k in present and measure(k).per_image]
    masks = [MEASURES["mask_iou"]] if runs.runs["mask_iou"].notna().any() else []
    cost = [MEASURES[k] for k in COST if k in runs.runs and runs.runs[k].notna().any()]
    return (*quality, *masks, *cost)


def _scene_row(index: _Index, method: str, scene: str, columns: tuple[Measure, ...]) -> Row:
    state = index.state(method, scene)
    if state != "ok":
        count = 0 if state == "absent" else int((index.runs[method, scene]["status"] == "ok").sum())
        return Row(method, tuple(TableCell(state=state) for _ in columns), count)
    cells = []
    for column in columns:
        values = index.seeds(method, scene, column).to_numpy()
        value = stats.mean(values)
        if math.isnan(value):
            cells.append(TableCell(state="missing"))
            continue
        low = high = math.nan
        if column.timed and (method, scene) in index.untimed:
            cells.append(TableCell(value, math.nan, float(values.min()), float(values.max()), ranged=True))
            continue
        if column.per_image:
            images = index.images[method, scene, column.key].pivot_table(
                index="image", columns="seed", values="value", aggfunc="mean", dropna=False
            )
            interval = stats.bootstrap_interval(images.to_numpy().mean(axis=1))
            low, high = interval.low, interval.high
        cells.append(TableCell(value, stats.spread(values), low, high))
    ranked = (method, scene) not in index.unfinished and not knows_truth(method)
    return Row(method, tuple(cells), len(index.runs[method, scene]), ranked=ranked)


def _mean_row(
    index: _Index,
    method: str,
    scenes: tuple[str, ...],
    columns: tuple[Measure, ...],
    blocks: list[Block],
    defined: Mapping[str, Sequence[str]],  # column -> scenes that can have a value
) -> Row:
    rows = [next(r for r in block.rows if r.method == method) for block in blocks]
    states = [index.state(method, scene) for scene in scenes]
    cells = []
    for i, column in enumerate(columns):
        over = defined[column.key]
        value = stats.mean([row.cells[i].value for row, s in zip(rows, scenes) if s in over])
        if "failed" in states:
            cells.append(TableCell(state="failed"))
        elif math.isnan(value):
            cells.append(TableCell(state="missing"))
        elif any(row.cells[i].ranged for row in rows):
            own = [(c.low, c.high) if c.ranged else (c.value, c.value) for c in (r.cells[i] for r in rows)]
            low, high = (float(np.mean(ends)) for ends in zip(*own))
            cells.append(TableCell(value, math.nan, low, high, ranged=True))
        else:
            # Seed by seed, so that the spread is that of the number shown; needs the same seeds everywhere.
            by_seed = pd.concat([index.seeds(method, s, column) for s in over], axis=1).to_numpy()
            cells.append(TableCell(value, stats.spread(by_seed.mean(axis=1))))
    return Row(method, tuple(cells), sum(row.runs for row in rows), ranked=all(row.ranked for row in rows))


def _ranked(block: Block, columns: tuple[Measure, ...], unranked: frozenset[str]) -> Block:
    """The block with the first, second and third of every column marked; equal in print = equal rank.

    `unranked`: columns of times that were measured on machines that differ.
    """
    rows = [list(row.cells) for row in block.rows]
    for i, column in enumerate(columns):
        values = {
            k: round(row.cells[i].value, column.digits)
            for k, row in enumerate(block.rows)
            if row.ranked and row.cells[i].state == "ok" and not row.cells[i].ranged
        }
        if column.better is None or column.key in unranked or len(set(values.values())) < 2:
            continue
        for k, value in values.items():
            ahead = sum(v > value if column.better == "higher" else v < value for v in values.values())
            if ahead < 3:
                rows[k][i] = replace(rows[k][i], rank=ahead + 1)
    marked = (replace(row, cells=tuple(cells)) for row, cells in zip(block.rows, rows))
    return replace(block, rows=tuple(marked))
