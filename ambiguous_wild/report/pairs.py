"""Differences of two methods on the same test images: with intervals, tests and counts, and which are ties.

The unit of a test decides what it says. Images of one scene say whether other images of these scenes would
give the same sign; scenes say whether other scenes would. See docs/tables.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from ambiguous_wild.core.errors import AwError, counted, shortlist, unknown
from ambiguous_wild.harness.measures import Measure
from ambiguous_wild.harness.store import Runs
from ambiguous_wild.metrics import stats
from ambiguous_wild.metrics.stats import Interval
from ambiguous_wild.report.comparison import comparison, quality_columns
from ambiguous_wild.report.notes import incomparable, metric_versions, scenes_apart
from ambiguous_wild.report.plain_formats import UNEQUAL, shortest, to_csv
from ambiguous_wild.report.table_layout import ARROWS, DOUBTFUL, SHOWN, State, Table, TableCell, text_table

NONE = Interval(math.nan, math.nan, math.nan, 0)
CSV_HEAD = (
    "method", "other", "metric", "status", "difference",
    "images", "images_low", "images_high", "images_won", "images_tied", "images_lost",
    "scenes", "scenes_low", "scenes_high", "scenes_won", "scenes_tied", "scenes_lost", "p", "p_holm", "note",
)  # fmt: skip


class PairedValues:
    """Values of a metric by image and seed, of two methods on the same images."""

    def __init__(self, runs: Runs) -> None:
        self._rows = dict(iter(runs.images.groupby(["scene", "metric", "method"])))
        self._seeds: dict[tuple[str, str, str], pd.DataFrame | None] = {}

    def _of(self, scene: str, metric: str, method: str) -> pd.DataFrame | None:
        """Return a row for each image, a column for each seed; None without a value."""
        key = (scene, metric, method)
        if key not in self._seeds:
            rows = self._rows.get(key)
            self._seeds[key] = (
                None if rows is None else rows.pivot(index="image", columns="seed", values="value")
            )
        return self._seeds[key]

    def on(self, scene: str, metric: str, a: str, b: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the values of both [n, seeds]; NaN where one lacks an image, None where one has no value.

        Images with an infinite value are left out, as in means.
        """
        one, two = self._of(scene, metric, a), self._of(scene, metric, b)
        if one is None or two is None:
            return None
        images = one.index.union(two.index)
        first, second = (x.reindex(images).to_numpy(float) for x in (one, two))
        finite = ~(np.isinf(first).any(axis=1) | np.isinf(second).any(axis=1))
        return first[finite], second[finite]

    def interval(self, metric: str, a: str, b: str, scenes: Sequence[str]) -> Interval:
        """Return the interval of a - b over images and seeds of these scenes, a mean over scenes."""
        pairs = [self.on(scene, metric, a, b) for scene in scenes]
        known = [pair for pair in pairs if pair is not None]
        return stats.difference_interval(known) if known and len(known) == len(pairs) else NONE


class Ties:
    """Find methods that do not differ significantly from the best of their column.

    That is the interval of `PairedValues` with zero in it, without correction for the number of methods.
    """

    def __init__(self, runs: Runs) -> None:
        self._values = PairedValues(runs)

    def marked(self, tables: Sequence[Table], scenes: Sequence[str]) -> list[Table]:
        """Mark the cells of `comparison` tables; `scenes` are those of the means."""
        return [
            replace(table, rows=tuple(replace(row, cells=self._cells(table, k, scenes))
                                      for k, row in enumerate(table.rows)))
            for table in tables
        ]  # fmt: skip

    def _cells(self, table: Table, k: int, scenes: Sequence[str]) -> tuple[TableCell, ...]:
        row, cells = table.rows[k], []
        for i, (column, cell) in enumerate(zip(table.columns, row.cells)):
            best = [other.name for other in table.rows if other.cells[i].rank == 1]
            tie = (
                row.ranked and cell.state == "ok" and column.measure.per_image
                and bool(best) and row.name not in best
            )  # fmt: skip
            if tie:
                of = (column.scene,) if column.scene else scenes
                found = self._values.interval(column.measure.key, best[0], row.name, of)
                tie = found.low <= 0.0 <= found.high
            cells.append(replace(cell, tie=tie))
        return tuple(cells)


@dataclass(frozen=True)
class Counts:
    """How often the first method is better, equal as printed, and worse."""

    won: int
    tied: int
    lost: int

    @property
    def text(self) -> str:
        return f"{self.won}/{self.tied}/{self.lost}"


@dataclass(frozen=True)
class MethodPair:
    """The difference of a method to another in one measure; NaN = not known, `state` says why."""

    method: str
    other: str
    measure: Measure
    state: State
    images: Interval = NONE  # over images and seeds of these scenes
    scenes: Interval = NONE  # over scenes
    doubtful: bool = False  # distractors in test photos count as truth: not compared, a note says so
    p_holm: float = math.nan  # p of `scenes`, corrected for the methods of this measure
    won_scenes: Counts = Counts(0, 0, 0)
    won_images: Counts = Counts(0, 0, 0)


def compared(
    runs: Runs, names: Sequence[str], *, metrics: Sequence[str] = (), scenes: Sequence[str] = ()
) -> tuple[list[MethodPair], tuple[str, ...]]:
    """Return the differences of the first method to each other, and notes on what limits them.

    Args:
        runs: from `store.read_runs`.
        names: methods, by their own or by their shown name; at least two.
        metrics: keys; empty: PSNR, SSIM and the LPIPS that was measured.
        scenes: names of scenes; empty: all. A method without a result on one of them is not compared.

    Raises:
        AwError: less than two methods, one of them twice or without runs, or see `comparison`.
    """
    first, *others = _rows_of(runs, names)
    runs = _only(runs, [first, *others])
    shown = metrics or quality_columns(runs)
    tables = comparison(runs, metrics=shown, scenes=scenes, drop_empty=not metrics)
    columns = [column.measure for column in tables[0].columns if not column.words]
    by_scene = {table.columns[0].scene: table for table in tables if table.columns[0].scene}
    apart = [scene for scene in by_scene if scene in scenes_apart(runs)]
    unranked = incomparable(runs.runs, columns) | metric_versions(runs.runs).keys()
    # where test photos may hold distractors, a model gains by drawing them
    doubtful = {c.measure.key for table in tables for c in table.columns if c.doubtful}
    values, pairs = PairedValues(runs), []
    for i, measure in enumerate(columns):
        fair, doubt = not apart and measure.key not in unranked | doubtful, measure.key in doubtful
        of = [_pair(values, tables[0], by_scene, i, first, other, fair=fair) for other in others]
        of = [replace(pair, doubtful=doubt) for pair in of]
        pairs += [replace(p, p_holm=q) for p, q in zip(of, stats.holm([p.scenes.p for p in of]))]
    return pairs, (*_reading(runs, pairs, len(by_scene)), *tables[-1].notes)


def _rows_of(runs: Runs, names: Sequence[str]) -> list[str]:
    """Return the shown names of the methods."""
    present = runs.rows()
    shown = {method: name for name, method in runs.methods.items()}
    rows = [name if name in present else shown.get(name, name) for name in names]
    for name, row in zip(names, rows):
        if row not in present:
            raise unknown("method", name, {*present, *(m for m, s in shown.items() if s in present)})
    if len(rows) < 2 or len(set(rows)) < len(rows):
        raise AwError(
            f"--compare {','.join(names)}: name two or more methods, each once, the first against each"
        )
    return rows


def names_of(text: str, runs: Runs) -> list[str]:
    """Divide "mine,robustsplat" at its commas, except those in names: of grafts, and labels."""
    known = {*runs.rows(), *runs.methods.values()}
    names, rest = [], text.strip()
    while rest:
        fitting = [name for name in known if rest == name or rest.startswith(name + ",")]
        name = max(fitting, key=len, default=rest.partition(",")[0])
        names.append(name.strip())
        rest = rest[len(name) + 1 :].strip()
    return names


def _only(runs: Runs, names: Sequence[str]) -> Runs:
    runs_of, images, missing = (
        frame[frame["method"].isin(names)] for frame in (runs.runs, runs.images, runs.missing)
    )
    incomplete = tuple(run for run in runs.incomplete if run.method in names)
    return replace(runs, runs=runs_of, images=images, missing=missing, incomplete=incomplete)


def _pair(
    values: PairedValues,
    mean: Table,
    by_scene: dict[str, Table],
    i: int,  # number of the column
    first: str,
    other: str,
    *,
    fair: bool,  # the same pixels were measured by the same function
) -> MethodPair:
    measure = mean.columns[i].measure
    cells = [row.cells[i] for name in (first, other) for row in mean.rows if row.name == name]
    states = [cell.state for cell in cells if cell.state != "ok"]
    if states or not fair or any(cell.ranged for cell in cells):
        return MethodPair(first, other, measure, states[0] if states else "missing")
    own: dict[str, float] = {}
    for scene, table in by_scene.items():
        a, b = (next(row.cells[i] for row in table.rows if row.name == name) for name in (first, other))
        if a.state == b.state == "ok":  # else the measure is undefined on the scene, for both
            own[scene] = a.value - b.value
    span = measure.range
    over_scenes = stats.mean_interval(list(own.values())).within(-span, span)
    over_images, on_images = NONE, Counts(0, 0, 0)
    if measure.per_image:
        over_images = values.interval(measure.key, first, other, list(own)).within(-span, span)
        both = [pair for scene in own if (pair := values.on(scene, measure.key, first, other)) is not None]
        on_images = counts_of([d for a, b in both for d in a.mean(axis=1) - b.mean(axis=1)], measure)
    on_scenes = counts_of(list(own.values()), measure)
    return MethodPair(
        first, other, measure, "ok", over_images, over_scenes, won_scenes=on_scenes, won_images=on_images
    )


def counts_of(differences: Sequence[float], measure: Measure) -> Counts:
    """Count how often a difference is for the first method, zero as printed, and against it."""
    sign = -1.0 if measure.better == "lower" else 1.0
    shown = [sign * round(d, measure.digits) for d in differences]
    return Counts(sum(d > 0 for d in shown), sum(d == 0 for d in shown), sum(d < 0 for d in shown))


def _reading(runs: Runs, pairs: Sequence[MethodPair], scenes: int) -> Iterator[str]:
    """Yield how the table is read, and what it cannot say."""
    first, others = pairs[0].method, len({pair.other for pair in pairs})
    yield f"difference: {first} minus the method of the row; the arrow says whether more or less is better"
    yield "95 %, images: other test images and seeds of these scenes (Student's t, paired by image)"
    if scenes > 1:
        corrected = f"; p corrected for {others} methods (Holm), metric by metric" if others > 1 else ""
        yield f"95 %, scenes, and p: other scenes (Student's t over {counted(scenes, 'scene')}){corrected}"
    else:
        yield "one scene says nothing of other scenes: no p, and no interval over scenes"
    counted_unit = "scenes" if scenes > 1 else "test images"
    yield f"w/t/l: {counted_unit} on which {first} is better, equal as printed, and worse"
    if any(pair.state != "ok" and not pair.doubtful for pair in pairs):
        yield "not compared: results are missing, failed or measured otherwise (below); --only chooses scenes"
    seeds = runs.runs.groupby(["method", "scene"])["seed"].nunique().groupby("method").min()
    if alone := [name for name in runs.rows() if seeds[name] < 2]:
        yield f"one seed of {shortlist(alone)}: the interval over images takes its training as it is"


def pair_table(pairs: Sequence[MethodPair], notes: Sequence[str]) -> Table:
    """Return the differences as a table of texts: a row for each metric and method."""
    others = dict.fromkeys(pair.other for pair in pairs)
    title = f"differences of {pairs[0].method} to {shortlist(others)}"
    head = ["method", "difference", "95 %, images", "95 %, scenes", "p", "w/t/l"]
    return replace(text_table(title, head, [_texts(pair) for pair in pairs]), notes=tuple(notes))


def _texts(pair: MethodPair) -> list[str]:
    mark = DOUBTFUL if pair.doubtful else ""
    name = f"{pair.other}, {pair.measure.label}{mark}{ARROWS[pair.measure.better]}"
    if pair.state != "ok":
        return [name, SHOWN[pair.state], "", "", "", ""]
    digits = pair.measure.digits
    counts = pair.won_scenes if pair.scenes.count > 1 else pair.won_images
    over = [interval_text(interval, digits) for interval in (pair.images, pair.scenes)]
    return [name, f"{pair.scenes.mean:+z.{digits}f}", *over, p_text(pair.p_holm), counts.text]


def interval_text(interval: Interval, digits: int) -> str:
    """Return the interval; a dash where there are too few values for one."""
    if math.isnan(interval.low):
        return SHOWN["missing"]
    return f"[{interval.low:z.{digits}f}, {interval.high:z.{digits}f}]"


def p_text(p: float) -> str:
    """Return p with two digits that count, no more than three decimals; a dash if it is not known."""
    if math.isnan(p):
        return SHOWN["missing"]
    return "<0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def pairs_csv(pairs: Sequence[MethodPair], notes: Sequence[str]) -> str:
    """Return CSV with a row for each metric and method; `note` is what makes methods incomparable."""
    note = "; ".join(line for line in notes if line.startswith(UNEQUAL))
    rows = (
        (p.method, p.other, p.measure.key, p.state, p.scenes.mean, *_in_csv(p.images, p.won_images),
         *_in_csv(p.scenes, p.won_scenes), p.scenes.p, p.p_holm, note)
        for p in pairs
    )  # fmt: skip
    return to_csv(CSV_HEAD, rows, number=shortest)


def _in_csv(interval: Interval, counts: Counts) -> tuple[float, ...]:
    return interval.count, interval.low, interval.high, counts.won, counts.tied, counts.lost
