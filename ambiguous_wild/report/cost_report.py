"""Make the cost report and write it as JSON, CSV, and text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.result_file import encoded
from ambiguous_wild.harness.timing import seconds_range
from ambiguous_wild.io.files import is_record, refuse_files_there, write_json, write_text
from ambiguous_wild.io.terminal import wrapped
from ambiguous_wild.report import plain_formats
from ambiguous_wild.report.cost_changes import Change, changes
from ambiguous_wild.report.cost_curves import (
    Curve,
    MeanAndDeviation,
    Point,
    Reach,
    curves_of,
    points,
    times_to_reach,
)
from ambiguous_wild.report.cost_runs import CostRuns, why_unranked
from ambiguous_wild.report.table_layout import Table, text_table

PLOTS = ("timelines", "budgets", "front", "changes")
FILES = ("cost.csv", "time-to-psnr.csv", "changes.csv", "timelines.csv", "cost.json",
         *(f"{plot}{suffix}" for plot in PLOTS for suffix in (".svg", ".png")))  # fmt: skip
MISSING = "—"
TIMES = {
    True: "times: reference seconds, see docs/cost.md; ranked between runs that were alone",
    False: "times: wall seconds of the machine; ranked between runs that were alone",
}
SHORT_MIN = 3.0  # trainings below this are shown in seconds
CHANGES = {  # kind of a change -> title of its table
    "effect": "what each effect brings, on runs that differ in it alone",
    "part": "what each variant of an ablation changes, against the method as it is",
    "resolution": "what another resolution of training brings",
    "gaussians": "what more Gaussians bring",
    "interval": "what refreshing more often brings, on runs that differ in the interval alone",
    "option": "what other options bring, on runs that differ in one alone",
}


@dataclass(frozen=True)
class TimeUnit:
    """The unit of times that are shown; files hold minutes."""

    name: str
    per_minute: float
    digits: int

    def of(self, minutes: MeanAndDeviation) -> MeanAndDeviation:
        return MeanAndDeviation(minutes.mean * self.per_minute, minutes.spread * self.per_minute)


@dataclass(frozen=True)
class CostReport:
    """Everything `aw cost` prints, writes and draws."""

    curves: tuple[Curve, ...]
    scenes: tuple[str, ...]
    points: tuple[Point, ...]
    reach: tuple[Reach, ...]
    changes: tuple[Change, ...]
    notes: tuple[str, ...]
    reference: bool  # times are seconds of the reference machine; else wall seconds
    setup: bool  # times include the set-up before the first step
    made_by: str  # the command

    @property
    def over(self) -> str:
        """What the points are means over, as text."""
        return f"mean over {len(self.scenes)} scenes" if len(self.scenes) > 1 else self.scenes[0]

    @property
    def kind(self) -> str:
        """What stands in front of a unit of time."""
        return "ref " if self.reference else ""

    @property
    def unit(self) -> TimeUnit:
        """Seconds if every training is short, else minutes."""
        minutes = [run.train_s / 60.0 for curve in self.curves for run in curve.runs]
        if max((m for m in minutes if not math.isnan(m)), default=0.0) < SHORT_MIN:
            return TimeUnit(f"{self.kind}s", 60.0, 1)
        return TimeUnit(f"{self.kind}min", 1.0, 2)


def cost_report(
    cost_runs: CostRuns, *, targets: Sequence[float] = (), setup: bool = False, made_by: str = ""
) -> CostReport:
    """Make the cost report of the runs.

    Args:
        cost_runs: from `read_cost_runs`.
        targets: PSNR in dB to reach; empty = some below the best of each scene.
        setup: add the set-up before the first step to the time.
        made_by: the command that makes it again.
    """
    runs = [replace(run, added_s=run.setup_s if setup else 0.0) for run in cost_runs.runs]
    curves, scenes = curves_of(runs), tuple(sorted({run.scene for run in runs}))
    return CostReport(
        tuple(curves),
        scenes,
        tuple(points(curves)),
        tuple(times_to_reach(curves, targets)),
        tuple(changes(runs)),
        (*cost_runs.notes, *_gaps(curves, scenes), *_unprobed(curves), *_unranked(curves)),
        cost_runs.reference,
        setup,
        made_by,
    )


def _unranked(curves: Sequence[Curve]) -> Iterator[str]:
    """Yield a line for each reason why times are not ranked."""
    for why, of in grouped(curves, lambda curve: why_unranked(curve.runs)).items():
        if why:
            names = shortlist(f"{curve.name}, {curve.length.text}" for curve in of)
            yield f"times not ranked: {names} ({why})"


def _gaps(curves: Sequence[Curve], scenes: Sequence[str]) -> Iterator[str]:
    for curve in curves:
        if lacking := [scene for scene in scenes if not curve.on(scene)]:
            yield (
                f"no run: {curve.name}, {curve.length.text}, on {', '.join(lacking)}; its means over scenes "
                "are missing"
            )


def _unprobed(curves: Sequence[Curve]) -> list[str]:
    """Return lines about runs without probes: one for each run, or for all methods without any probes."""
    runs = [run for curve in curves for run in curve.runs if not run.error]
    probed = {run.method for run in runs if not run.unprobed}
    never = sorted({run.method for run in runs} - probed)
    lines = [
        f"{run.unprobed} ({run.method} on {run.scene}, seed {run.seed}): only its final PSNR is known, so "
        "there is no mean time over it and runs with probes"
        for run in runs
        if run.unprobed and run.method in probed
    ]
    lines += [run.unprobed for run in runs if run.method in never and "damaged" in run.unprobed]
    if never:
        lines.append(f"no probes in the timelines of {', '.join(never)}: only their final PSNR is known")
    return lines


def write_report(report: CostReport, folder: Path) -> list[Path]:
    """Write cost.json, cost.csv, time-to-psnr.csv, changes.csv and timelines.csv; return the paths written.

    Raises:
        AwError: the folder has files of these names that are no earlier report.
    """
    _remove_earlier(folder)
    tables = {
        "cost.csv": list(map(_row, report.points)),
        "time-to-psnr.csv": list(map(_row, report.reach)),
        "changes.csv": list(map(_row, report.changes)),
        "timelines.csv": list(_timeline_rows(report.curves)),
    }
    written = [folder / "cost.json"]
    write_json(written[0], plain_data(report))
    for name, rows in tables.items():
        if rows:
            write_text(folder / name, plain_formats.to_csv(list(rows[0]), (row.values() for row in rows)))
            written.append(folder / name)
    return written


def _remove_earlier(folder: Path) -> None:
    """Remove the files of an earlier report, as old plots must not remain beside new tables."""
    if not is_record(folder / "cost.json", "time_to_psnr"):
        refuse_files_there(folder, FILES)
    for name in FILES:
        (folder / name).unlink(missing_ok=True)


def plain_data(report: CostReport) -> Facts:
    """Return the report for JSON; None = missing."""
    data = {
        "schema": 1,
        "made_by": report.made_by,
        "time": "training and what comes before its first step" if report.setup else "training",
        "seconds": "reference" if report.reference else "wall",
        "scenes": list(report.scenes),
        "curves": list(map(_row, report.points)),
        "time_to_psnr": list(map(_row, report.reach)),
        "changes": list(map(_row, report.changes)),
        "notes": list(report.notes),
    }
    return dict(encoded(data))


def _row(record: Point | Reach | Change) -> Facts:
    """Return a record by the columns of its file; a mean has a second column for its deviation."""
    return _columns(vars(record))


def _columns(values: Mapping[str, Any]) -> Facts:
    row: Facts = {}
    for name, value in values.items():
        if isinstance(value, MeanAndDeviation):
            row |= {name: value.mean, f"{name}_std": value.spread}
        elif isinstance(value, dict):
            row |= _columns(value)
        else:
            row[name] = " ".join(value) if isinstance(value, tuple) else value
    return row


def _timeline_rows(curves: Iterable[Curve]) -> Iterator[Facts]:
    for curve in curves:
        for run in curve.runs:
            for at, psnr in run.points:
                yield {"curve": curve.name, "length": curve.length.text, "scene": run.scene, "seed": run.seed,
                       "train_s": at, "psnr": psnr}  # fmt: skip


def to_text(report: CostReport, width: int | None = None) -> str:
    """Return every table of the report as aligned text, with the notes below.

    Args:
        report: the report.
        width: columns at which tables are divided and notes are broken; None: any number.
    """
    tables = tables_of(report)
    if width is not None:
        tables = [part for table in tables for part in plain_formats.divided(table, width)]
    spread = any(not math.isnan(p.psnr.spread) for p in report.points)
    notes = ["±: sample standard deviation over seeds"] if spread else []
    notes += [TIMES[report.reference], *report.notes]
    notes += [f"command: {report.made_by}"] if report.made_by else []
    return (
        "\n".join(
            [plain_formats.to_text(tables, width=width), *(wrapped(plain(note), width) for note in notes)]
        )
        + "\n"
    )


def tables_of(report: CostReport) -> list[Table]:
    """Return the tables: what each curve reaches, when it reaches a PSNR, and what each change brings."""
    reached = grouped(report.reach, lambda row: row.scene)
    changed = grouped(report.changes, lambda change: change.kind)
    return [
        _points(report),
        *(_reached(scene, rows, report) for scene, rows in reached.items()),
        *(_changed(CHANGES[kind], rows, report) for kind, rows in changed.items()),
    ]


def _points(report: CostReport) -> Table:
    unit, kind = report.unit, report.kind
    rows = []
    for p in report.points:
        n, front = p.numbers, "not ranked" if p.not_ranked else "yes" if p.pareto_front else ""
        rows.append((
            p.curve, p.length, str(p.runs), number(p.psnr, 2), _time(p.minutes, p, unit), front,
            number(p.setup_s, 1), number(n["ms_per_iteration"], 1),
            number(n["gaussians"], 0, spread=False), number(n["model_mb"], 1, spread=False),
            number(n["fps"], 1, spread=False),
        ))  # fmt: skip
    took = f"{unit.name} with set-up" if report.setup else unit.name
    head = ("method", "trained for", "runs", "PSNR dB", took, "on the front", f"{kind}set-up s",
            "ms/iter", "Gaussians", "MB", "FPS")  # fmt: skip
    return text_table(f"what each method reaches, and what it costs ({report.over})", head, rows)


def _reached(scene: str, rows: Sequence[Reach], report: CostReport) -> Table:
    unit = report.unit
    targets = list(dict.fromkeys(row.target for row in rows))
    by_key = {(row.curve, row.target): row for row in rows}
    several = len({curve.length for curve in report.curves}) > 1
    lines = [
        (name, *(_when(by_key[name, target], unit, several) for target in targets))
        for name in dict.fromkeys(row.curve for row in rows)
    ]
    psnr = {row.target: row.psnr for row in rows}
    head = [t if math.isnan(psnr[t]) or t == f"{psnr[t]:g} dB" else f"{t} ({psnr[t]:.2f})" for t in targets]
    kind = "reference " if report.reference else ""
    counted = kind + ("minutes" if unit.per_minute == 1.0 else "seconds") + " of training"
    counted += " and set-up" if report.setup else ""
    return text_table(
        f"{counted} to reach a test PSNR ({scene or 'mean over all scenes'})", ("method", *head), lines
    )


def _when(row: Reach, unit: TimeUnit, several: bool) -> str:
    if not row.runs:
        return "no run"
    if row.missing:  # the reason is in the notes below the tables
        return MISSING
    if row.reached < row.runs:
        return "never" if not row.reached else f"{row.reached} of {row.runs} runs"
    if math.isnan(row.minutes.mean):
        return MISSING
    text = ("≤ " if row.upper_bound else "") + _time(row.minutes, row, unit)
    return f"{text} (in {row.length})" if several else text


def _time(minutes: MeanAndDeviation, row: Point | Reach, unit: TimeUnit) -> str:
    """Return a mean with its deviation or, if it is not ranked, the range over the runs."""
    if not row.not_ranked or math.isnan(minutes.mean):
        return number(unit.of(minutes), unit.digits)
    return seconds_range([m * unit.per_minute for m in (row.minutes_low, row.minutes_high)], unit.digits)


def _changed(title: str, rows: Sequence[Change], report: CostReport) -> Table:
    unit = report.unit
    head = ("change", "method", "trained for", "pairs", "dB gained", "95 % interval", f"extra {unit.name}",
            f"extra {report.kind}ms/iter", f"dB per extra {report.kind}min")  # fmt: skip
    lines = []
    for c in rows:
        interval = MISSING if math.isnan(c.db_low) else f"{c.db_low:+.2f} to {c.db_high:+.2f}"
        lines.append((
            c.what, c.method, c.length, str(c.pairs), number(c.db, 2, sign=True), interval,
            number(unit.of(c.minutes), unit.digits, sign=True), number(c.ms_per_iteration, 1, sign=True),
            per_minute(c),
        ))  # fmt: skip
    return text_table(title, head, lines)


def per_minute(change: Change) -> str:
    """Return the dB per extra minute, or why there are none."""
    if math.isnan(change.minutes.mean) or math.isnan(change.db.mean):
        return MISSING
    if change.not_ranked:
        return "not ranked"
    if change.same_time:
        return "same time"
    return f"{change.db_per_minute:+.2f}" if change.minutes.mean > 0.0 else "takes less"


def number(value: MeanAndDeviation, digits: int, *, sign: bool = False, spread: bool = True) -> str:
    """Return a mean and its deviation over seeds as text; a dash if it is missing."""
    if math.isnan(value.mean):
        return MISSING
    text = f"{value.mean:{'+' if sign else ''},.{digits}f}"
    return text if math.isnan(value.spread) or not spread else f"{text} ± {value.spread:.{digits}f}"
