"""Compare runs in tables: rows are methods, columns are measures, one table for each scene.

The mean is taken over images, then over seeds, then over scenes, in that order. No mean is shown if a value
is missing. A scene on which a measure is undefined, such as a mask score without distractors, is left out of
the mean for every method. A failed run makes its cell "failed", so that no method gains by failing on hard
scenes. A method with an unfinished run is shown, but not ranked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist, unknown
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.harness.measures import ALWAYS, COST, MEASURES, Measure, measure
from ambiguous_wild.harness.store import TEXT_OF_RUNS, Runs, check_names, read_runs
from ambiguous_wild.methods.registry import all_methods, knows_truth
from ambiguous_wild.metrics import stats
from ambiguous_wild.report.notes import (
    incomparable,
    metric_versions,
    mixed_runs,
    mixed_scenes,
    notes,
    scenes_apart,
    untimed,
)
from ambiguous_wild.report.plain_formats import to_text
from ambiguous_wild.report.table_layout import Column, Row, State, Table, TableCell, ranks
from ambiguous_wild.report.typeset import to_html

LPIPS = ("lpips_alex", "lpips_vgg", "lpips_vgg_01")
MASK_COLUMNS = ("mask_iou", "mask_precision")
EFFECTS = Measure("effects", "effects", None, 0, per_image=False)
COLUMNS = ("scene", "method", "seed", "image", "metric", "value", "better", "reason", "config_hash",
           "effects", "length")  # fmt: skip
_KEYS = ["scene", "method", "seed"]
_OF_RUN = ["config_hash", "effects", "length"]
_NO_NUMBER = {*_KEYS, "images", *TEXT_OF_RUNS}
_TEXT = ("scene", "method", "image", "metric", "better", "reason", *_OF_RUN)


def comparison(
    runs: Runs, *, metrics: Sequence[str] = (), scenes: Sequence[str] = (), drop_empty: bool | None = None
) -> list[Table]:
    """Compare all methods: one table for each scene, preceded by the mean if there are several scenes.

    The last table has notes on runs that are missing, failed or not comparable.

    Args:
        runs: from `store.read_runs`.
        metrics: keys of the columns, in this order; empty: PSNR, SSIM, LPIPS, every other measured metric,
            mask IoU and cost.
        scenes: names of scenes, in this order; empty: all, by name.
        drop_empty: leave out columns without any value; a note says why they are empty. None: leave them
            out unless `metrics` names them.

    Raises:
        AwError: no run has such a metric or scene, or there is no finished run.
    """
    frame = runs.runs
    if not len(frame):
        names = shortlist(f"{i.folder} ({i.reason})" for i in runs.incomplete)
        raise AwError(f"no finished run: {names}")
    present = sorted(frame["scene"].unique())
    check_names("scene", scenes, present)
    chosen = tuple(dict.fromkeys(scenes)) or tuple(present)
    runs = replace(
        runs,
        runs=frame[frame["scene"].isin(chosen)],
        images=runs.images[runs.images["scene"].isin(chosen)],
        missing=runs.missing[runs.missing["scene"].isin(chosen)],
    )
    versions = metric_versions(runs.runs)
    runs = replace(runs, images=_of_one_function(runs.images, versions))
    methods = runs.rows()
    index = _Index(runs)
    columns = _columns(runs, metrics)
    defined = {c.key: [s for s in chosen if index.can_have(s, c, methods)] for c in columns}
    unranked = incomparable(runs.runs, columns) | versions.keys()
    apart, quality = scenes_apart(runs), frozenset(c.key for c in columns if c.quality)
    apart |= {""} if apart else set()  # the mean over scenes
    mixed, whole = mixed_scenes(runs.runs), frozenset(c.key for c in columns if c.whole_photo)
    mixed |= {""} if mixed else set()
    rows = {scene: [_scene_row(index, m, scene, columns) for m in methods] for scene in chosen}
    if len(chosen) > 1:
        mean = [_mean_row(index, k, m, chosen, columns, rows, defined) for k, m in enumerate(methods)]
        rows = {"": mean} | rows
    title = f"mean over {len(chosen)} scenes"
    tables = [
        Table(
            scene or title,
            tuple(Column("", measure, scene, doubtful=measure.key in doubtful) for measure in columns),
            tuple(ranked(of, columns, unranked | doubtful | (quality if scene in apart else frozenset()))),
            continued=True,
        )
        for scene, of in rows.items()
        for doubtful in [whole if scene in mixed else frozenset()]
    ]
    tables = [_with_effects(_cited(table, runs), runs.runs) for table in tables]
    tables[-1] = replace(tables[-1], continued=False).with_notes(
        *notes(runs, columns, methods, chosen), *_undefined(columns, chosen, defined)
    )
    return _without_empty(tables) if drop_empty or (drop_empty is None and not metrics) else tables


class Tables(tuple[Table, ...]):
    """Tables that `print` shows as text and a notebook as HTML."""

    def __repr__(self) -> str:
        return f"Tables({', '.join(table.title for table in self)})"

    def __str__(self) -> str:
        return to_text(self)

    def _repr_html_(self) -> str:
        return to_html(self)


def table(
    runs: Runs | Path | str, *, metrics: str | Sequence[str] = (), scenes: str | Sequence[str] = ()
) -> Tables:
    """Return the `comparison` of runs, or of every run below a folder; a single name needs no list."""
    runs = runs if isinstance(runs, Runs) else read_runs(runs)
    columns, only = ([names] if isinstance(names, str) else names for names in (metrics, scenes))
    return Tables(comparison(runs, metrics=columns, scenes=only))


def _cited(table: Table, runs: Runs) -> Table:
    """Add the key of the paper to rows with a label: a table with names of papers is for a paper."""
    labelled = {name: method for name, method in runs.methods.items() if name != method}
    entries = all_methods() if labelled else {}
    keys = {name: entries[method].cite for name, method in labelled.items() if method in entries}
    return replace(table, rows=tuple(replace(row, cite=keys.get(row.name, "")) for row in table.rows))


def _with_effects(table: Table, frame: pd.DataFrame) -> Table:
    """Add a column with the effects of each row, if the rows of a scene differ in their effects."""
    done = frame[frame["status"] == "ok"]
    if not any(of["effects"].nunique() > 1 for _, of in done.groupby("scene")):
        return table
    shown = done[done["scene"] == table.columns[0].scene] if table.columns[0].scene else done
    rows = []
    for row in table.rows:
        names = " or ".join(dict.fromkeys(shown[shown["method"] == row.name]["effects"]))
        cell = TableCell(printed=names) if names else TableCell(state="missing")
        rows.append(replace(row, cells=(*row.cells, cell)))
    column = Column("", EFFECTS, table.columns[0].scene, words=True)
    return replace(table, columns=(*table.columns, column), rows=tuple(rows))


def _of_one_function(images: pd.DataFrame, versions: Mapping[str, Mapping[str, set[str]]]) -> pd.DataFrame:
    """Leave out the values of methods whose own runs measured a metric by different functions."""
    mixed = {(key, method) for key, of in versions.items() for method, named in of.items() if len(named) > 1}
    if not mixed:
        return images
    keep = [pair not in mixed for pair in zip(images["metric"], images["method"])]
    return images.assign(value=images["value"].where(pd.Series(keep, index=images.index)))


def _without_empty(tables: list[Table]) -> list[Table]:
    """Leave out columns without any value, unless all columns are such."""
    kept = [
        i
        for i in range(len(tables[0].columns))
        if any(row.cells[i].state == "ok" for table in tables for row in table.rows)
    ]
    return [table.picked(kept) for table in tables] if kept else tables


def _undefined(
    columns: tuple[Measure, ...], scenes: tuple[str, ...], defined: Mapping[str, Sequence[str]]
) -> list[str]:
    """Return lines that name the columns whose mean leaves out scenes."""
    left_out = {c.label: [s for s in scenes if s not in defined[c.key]] for c in columns}
    partly = [label for label, out in left_out.items() if out and len(out) < len(scenes)]
    by_scenes = grouped(partly, lambda label: shortlist(left_out[label]))
    return [f"undefined on {out}, left out of the mean: {', '.join(c)}" for out, c in by_scenes.items()]


class _Index:
    """Values by (method, scene); a search in the frames for every cell would take quadratic time."""

    def __init__(self, runs: Runs) -> None:
        self.runs = dict(iter(runs.runs.groupby(["method", "scene"])))
        self.images = dict(iter(runs.images.groupby(["method", "scene", "metric"])))
        self.unfinished = {(i.method, i.scene) for i in runs.incomplete}
        self.references = {name for name in runs.rows() if knows_truth(runs.method_of(name))}
        self.untimed, self.mixed = set(untimed(runs.runs)), set(mixed_runs(runs.runs))

    def seeds(self, method: str, scene: str, column: Measure) -> pd.Series:
        """Return the value of each seed's run; NaN if it is missing."""
        rows = self.runs[method, scene].set_index("seed")
        if not column.per_image:
            values = rows[column.key] if column.key in rows else pd.Series(math.nan, index=rows.index)
            values = values.astype(float)
            if column.key in MASK_COLUMNS and "mask_recall" in rows:
                # without a distractor recall is undefined, and an IoU of 0 has no meaning
                values = values.where(rows["mask_recall"].notna())
            return values.sort_index()
        images = self.images.get((method, scene, column.key))
        by_seed = {} if images is None else dict(iter(images.groupby("seed")["value"]))
        means = {seed: stats.mean(by_seed.get(seed, ())) for seed in sorted(rows.index)}
        return pd.Series(means, dtype=float)

    def can_have(self, scene: str, column: Measure, methods: Sequence[str]) -> bool:
        """Return whether the measure is defined on the scene: always, or because a method has a value."""
        if not column.partial and column.key not in (*MASK_COLUMNS, "mask_recall"):
            return True
        return any(
            (m, scene) in self.runs and bool(self.seeds(m, scene, column).notna().any()) for m in methods
        )

    def state(self, method: str, scene: str) -> State:
        if (method, scene) not in self.runs:
            return "absent"
        if (self.runs[method, scene]["status"] == "failed").any():
            return "failed"
        return "missing" if (method, scene) in self.mixed else "ok"


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


def quality_columns(runs: Runs) -> tuple[str, ...]:
    """Return PSNR, SSIM and the first LPIPS that was measured, or else the first with a row for it."""
    measured = set(runs.images.dropna(subset=["value"])["metric"])
    present = measured | set(runs.images["metric"])
    lpips = next((k for k in LPIPS if k in measured), next((k for k in LPIPS if k in present), ""))
    consistent = ["psnr_consistent"] if "psnr_consistent" in measured else []
    return ("psnr", *consistent, "ssim", *([lpips] if lpips else []))


def _scene_row(index: _Index, method: str, scene: str, columns: tuple[Measure, ...]) -> Row:
    state = index.state(method, scene)
    if state != "ok":
        count = 0 if state == "absent" else int((index.runs[method, scene]["status"] == "ok").sum())
        return Row(method, tuple(TableCell(state=state) for _ in columns), runs=count)
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
            means = images.to_numpy().mean(axis=1)
            interval = stats.mean_interval(means[np.isfinite(means)] if np.isfinite(means).any() else means)
            low, high = interval.low, interval.high
        cells.append(TableCell(value, stats.sample_std(values), low, high))
    why = "unfinished, not ranked" if (method, scene) in index.unfinished else ""
    why = "knows the truth, not ranked" if method in index.references else why
    return Row(method, tuple(cells), runs=len(index.runs[method, scene]), ranked=not why, note=why)


def _mean_row(
    index: _Index,
    k: int,  # number of the method among the rows
    method: str,
    scenes: tuple[str, ...],
    columns: tuple[Measure, ...],
    by_scene: Mapping[str, Sequence[Row]],
    defined: Mapping[str, Sequence[str]],  # column -> scenes that can have a value
) -> Row:
    rows = [by_scene[scene][k] for scene in scenes]
    states = [index.state(method, scene) for scene in scenes]
    cells = []
    for i, column in enumerate(columns):
        over = defined[column.key]
        value = stats.mean([row.cells[i].value for row, s in zip(rows, scenes) if s in over])
        if "failed" in states:
            cells.append(TableCell(state="failed"))
        elif math.isnan(value) or (method, "") in index.mixed:
            cells.append(TableCell(state="missing"))
        elif any(row.cells[i].ranged for row in rows):
            own = [(c.low, c.high) if c.ranged else (c.value, c.value) for c in (r.cells[i] for r in rows)]
            low, high = (float(np.mean(ends)) for ends in zip(*own))
            cells.append(TableCell(value, math.nan, low, high, ranged=True))
        else:
            # means over scenes for each seed, whose spread is shown; they need the same seeds on all scenes
            by_seed = pd.concat([index.seeds(method, s, column) for s in over], axis=1).to_numpy()
            cells.append(TableCell(value, stats.sample_std(by_seed.mean(axis=1))))
    why = next((row.note for row in rows if row.note), "")
    return Row(method, tuple(cells), runs=sum(row.runs for row in rows), ranked=not why, note=why)


def ranked(rows: Sequence[Row], columns: tuple[Measure, ...], unranked: frozenset[str]) -> list[Row]:
    """Mark the first, second and third of every column, except in the `unranked` columns."""
    marked = [list(row.cells) for row in rows]
    for i, column in enumerate(columns):
        if column.key in unranked:
            continue
        cells = [row.cells[i] for row in rows]
        values = [
            c.value if row.ranked and c.state == "ok" and not c.ranged else math.nan
            for row, c in zip(rows, cells)
        ]
        for k, rank in enumerate(ranks(values, column)):
            marked[k][i] = replace(cells[k], rank=rank)
    return [replace(row, cells=tuple(cells)) for row, cells in zip(rows, marked)]


def tidy(runs: Runs, *, metrics: Sequence[str] = (), scenes: Sequence[str] = ()) -> pd.DataFrame:
    """Return all runs as one table with a row for each number.

    Args:
        runs: from `store.read_runs`.
        metrics: keys to keep; empty: all.
        scenes: names to keep; empty: all.

    Returns:
        Columns `COLUMNS`. A number of a whole run (cost, masks) has an empty image. A missing value is NaN,
        with the `reason` if the run has one. A failed run has one row, with metric "failed". `better` is
        "higher", "lower" or empty.

    Raises:
        AwError: no run has such a metric or scene.
    """
    parts = [_images(runs), _missing(runs)]
    parts += [_whole(runs), _failed(runs)] if len(runs.runs) else []
    frame = pd.concat(parts, ignore_index=True)
    frame = _only(_only(frame, "metric", metrics), "scene", scenes)
    frame["better"] = frame["metric"].map(lambda key: measure(str(key)).better or "")
    if len(runs.runs):  # without a finished run there are neither rows nor hashes
        frame = frame.merge(runs.runs[[*_KEYS, *_OF_RUN]], on=_KEYS, how="left")
    frame = frame.reindex(columns=list(COLUMNS)).fillna(dict.fromkeys(_TEXT, ""))
    return frame.sort_values([*_KEYS, "image"], kind="stable", ignore_index=True)


def _only(frame: pd.DataFrame, column: str, names: Sequence[str]) -> pd.DataFrame:
    check_names(column, names, sorted(frame[column].unique()))
    return frame[frame[column].isin(list(names))].copy() if names else frame


def _images(runs: Runs) -> pd.DataFrame:
    frame = runs.images.merge(runs.missing, on=[*_KEYS, "metric"], how="left")
    return frame.assign(reason=frame["reason"].where(frame["value"].isna(), ""))


def _missing(runs: Runs) -> pd.DataFrame:
    """Return metrics that a run lacks as a whole, and that have no row for any image."""
    key = [*_KEYS, "metric"]
    with_images = set(runs.images[key].itertuples(index=False, name=None))
    lacking = [row not in with_images for row in runs.missing[key].itertuples(index=False, name=None)]
    return runs.missing[lacking].assign(image="", value=math.nan)


def _whole(runs: Runs) -> pd.DataFrame:
    done = runs.runs[runs.runs["status"] == "ok"]
    numbers = [name for name in done.columns if name not in _NO_NUMBER]
    frame = done.melt(_KEYS, numbers, "metric", "value")
    # costs that do not apply (memory of a GPU) and mask scores without a truth are left out
    frame["value"] = pd.to_numeric(frame["value"], errors="coerce")
    return frame[frame["value"].notna()].assign(image="", reason="")


def _failed(runs: Runs) -> pd.DataFrame:
    lost = runs.runs[runs.runs["status"] == "failed"]
    return lost[_KEYS].assign(image="", metric="failed", value=math.nan, reason=lost["error"])
