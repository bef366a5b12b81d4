"""Make the cost report and write it as JSON, CSV, and text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.result_file import encoded
from ambiguous_wild.harness.timing import seconds_range
from ambiguous_wild.io.files import is_record, refuse_files_there, write_json, write_text
from ambiguous_wild.report import plain_formats
from ambiguous_wild.report.cost_curves import (
    Change,
    Curve,
    MeanAndDeviation,
    Point,
    changes,
    curves_of,
    points,
)
from ambiguous_wild.report.cost_runs import CostRun, CostRuns, why_unranked
from ambiguous_wild.report.cost_targets import Reach, TargetRow, answers, times_to_reach
from ambiguous_wild.report.plain_formats import to_csv
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


@dataclass(frozen=True)
class CostReport:
    """Everything `aw cost` prints, writes and draws."""

    curves: tuple[Curve, ...]
    scenes: tuple[str, ...]
    points: tuple[Point, ...]
    reach: tuple[Reach, ...]
    changes: tuple[Change, ...]
    notes: tuple[str, ...]
    answers: tuple[TargetRow, ...]  # one for each scene
    reference: bool  # times are seconds of the reference machine; else wall seconds
    setup: bool  # times include the set-up before the first step
    made_by: str  # the command


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
    curves, scenes = curves_of(cost_runs.runs), tuple(sorted({run.scene for run in cost_runs.runs}))
    return CostReport(
        tuple(curves),
        scenes,
        tuple(points(curves, setup=setup)),
        tuple(times_to_reach(curves, targets, setup=setup)),
        tuple(changes(cost_runs.runs)),
        (*cost_runs.notes, *_gaps(curves, scenes), *_unranked(curves)),
        tuple(answers(curves, setup=setup)),
        cost_runs.reference,
        setup,
        made_by,
    )


def _unranked(curves: Sequence[Curve]) -> list[str]:
    """Return a line for each reason why times are not ranked."""
    reasons: dict[str, list[str]] = {}
    for curve in curves:
        if why := why_unranked(curve.runs):
            reasons.setdefault(why, []).append(f"{curve.name}, {curve.length.text}")
    return [f"times not ranked: {shortlist(names)} ({why})" for why, names in reasons.items()]


def _gaps(curves: Sequence[Curve], scenes: Sequence[str]) -> list[str]:
    lines = []
    for curve in curves:
        lacking = [scene for scene in scenes if not curve.on(scene)]
        if lacking:
            lines.append(
                f"no run: {curve.name}, {curve.length.text}, on {', '.join(lacking)}; its means over scenes "
                "are missing"
            )
    return lines + _unprobed([run for curve in curves for run in curve.runs if not run.error])


def _unprobed(runs: Sequence[CostRun]) -> list[str]:
    """Return lines about runs without probes: one for each run, or for all methods without any probes."""
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
        "cost.csv": [_point_row(p) for p in report.points],
        "time-to-psnr.csv": [_reach_row(r) for r in report.reach],
        "changes.csv": [_change_row(c) for c in report.changes],
        "timelines.csv": list(_timeline_rows(report.curves)),
    }
    written = [folder / "cost.json"]
    write_json(written[0], plain_data(report))
    for name, rows in tables.items():
        if rows:
            write_text(folder / name, to_csv(list(rows[0]), (row.values() for row in rows)))
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
        "answers": [asdict(answer) | {"text": answer.text} for answer in report.answers],
        "scenes": list(report.scenes),
        "curves": [_point_row(p) for p in report.points],
        "time_to_psnr": [_reach_row(r) for r in report.reach],
        "changes": [_change_row(c) for c in report.changes],
        "notes": list(report.notes),
    }
    return dict(encoded(data))


def _point_row(p: Point) -> Facts:
    row: Facts = {"curve": p.curve, "method": p.method, "length": p.length, "runs": p.runs}
    row |= _both("psnr", p.psnr) | _both("minutes", p.minutes)
    row |= {"minutes_low": p.low, "minutes_high": p.high, "not_ranked": p.unranked, "pareto_front": p.front}
    row |= _both("setup_s", p.setup_s)
    for name, value in p.numbers.items():
        row |= _both(name, value)
    return row


def _reach_row(r: Reach) -> Facts:
    row: Facts = {"scene": r.scene or "", "curve": r.curve, "length": r.length, "target": r.target}
    row |= {"psnr": r.psnr} | _both("minutes", r.minutes)
    row |= {"minutes_low": r.low, "minutes_high": r.high, "not_ranked": r.unranked}
    return row | {"upper_bound": r.bound, "reached": r.reached, "runs": r.runs, "missing": r.missing}


def _change_row(c: Change) -> Facts:
    row: Facts = {"kind": c.kind, "name": c.name, "method": c.method, "before": c.before, "after": c.after}
    row |= {"length": c.length, "scenes": " ".join(c.scenes), "pairs": c.pairs}
    row |= _both("db", c.db) | {"db_low": c.low, "db_high": c.high}
    row |= _both("minutes", c.minutes) | _both("ms_per_iteration", c.ms)
    return row | {"db_per_minute": c.per_minute, "same_time": c.same_time, "not_ranked": c.unranked}


def _timeline_rows(curves: Iterable[Curve]) -> Iterable[Facts]:
    for curve in curves:
        for run in curve.runs:
            for at, psnr in run.points:
                yield {"curve": curve.name, "length": curve.length.text, "scene": run.scene, "seed": run.seed,
                       "train_s": at, "psnr": psnr}  # fmt: skip


def _both(name: str, value: MeanAndDeviation) -> dict[str, float]:
    return {name: value.mean, f"{name}_std": value.spread}


def to_text(report: CostReport) -> str:
    """Return every table of the report as aligned text, with the notes below."""
    parts = [plain_formats.to_text(tables_of(report))]
    parts += [f"{plain(answer.text)}" for answer in report.answers]
    spread = any(not math.isnan(p.psnr.spread) for p in report.points)
    parts += ["±: sample standard deviation over seeds"] if spread else []
    parts += [TIMES[report.reference]]
    parts += [plain(note) for note in report.notes]
    parts += [f"command: {plain(report.made_by)}"] if report.made_by else []
    return "\n".join(parts) + "\n"


@dataclass(frozen=True)
class TimeUnit:
    """The unit of times that are shown; files hold minutes."""

    name: str
    per_minute: float
    digits: int

    def of(self, minutes: MeanAndDeviation) -> MeanAndDeviation:
        return MeanAndDeviation(minutes.mean * self.per_minute, minutes.spread * self.per_minute)


def time_unit(report: CostReport) -> TimeUnit:
    """Return seconds if every training is short, else minutes."""
    minutes = [
        run.train_s / 60.0 for curve in report.curves for run in curve.runs if not math.isnan(run.train_s)
    ]
    kind = "ref " if report.reference else ""
    if max(minutes, default=0.0) < SHORT_MIN:
        return TimeUnit(f"{kind}s", 60.0, 1)
    return TimeUnit(f"{kind}min", 1.0, 2)


def tables_of(report: CostReport) -> list[Table]:
    """Return the tables: what each curve reaches, when it reaches a PSNR, and what each change brings."""
    tables = [_points(report)]
    scenes: dict[str | None, list[Reach]] = {}
    for row in report.reach:
        scenes.setdefault(row.scene, []).append(row)
    tables += [_reached(scene, rows, report) for scene, rows in scenes.items()]
    for kind, title in (
        ("effect", "what each effect brings, on runs that differ in it alone"),
        ("part", "what each variant of an ablation changes, against the method as it is"),
        ("resolution", "what another resolution of training brings"),
        ("gaussians", "what more Gaussians bring"),
        ("interval", "what refreshing more often brings, on runs that differ in the interval alone"),
        ("option", "what other options bring, on runs that differ in one alone"),
    ):
        rows = [c for c in report.changes if c.kind == kind]
        tables += [_changed(title, rows, time_unit(report))] if rows else []
    return tables


def _points(report: CostReport) -> Table:
    over = f"mean over {len(report.scenes)} scenes" if len(report.scenes) > 1 else report.scenes[0]
    unit = time_unit(report)
    rows = []
    for p in report.points:
        n, front = p.numbers, "not ranked" if p.unranked else "yes" if p.front else ""
        rows.append((
            p.curve, p.length, str(p.runs), number(p.psnr, 2), _time(p.minutes, p, unit), front,
            number(p.setup_s, 1), number(n["ms_per_iteration"], 1),
            number(n["gaussians"], 0, spread=False), number(n["model_mb"], 1, spread=False),
            number(n["fps"], 1, spread=False),
        ))  # fmt: skip
    took = f"{unit.name} with set-up" if report.setup else unit.name
    kind = "ref " if report.reference else ""
    head = ("method", "trained for", "runs", "PSNR dB", took, "on the front", f"{kind}set-up s",
            f"{kind}ms/iter", "Gaussians", "MB", f"{kind}FPS")  # fmt: skip
    return text_table(f"what each method reaches, and what it costs ({over})", head, rows)


def _reached(scene: str | None, rows: Sequence[Reach], report: CostReport) -> Table:
    unit = time_unit(report)
    targets = list(dict.fromkeys(row.target for row in rows))
    by_key = {(row.curve, row.target): row for row in rows}
    several = len({curve.length for curve in report.curves}) > 1
    lines = [
        (name, *(_when(by_key[name, target], unit, several) for target in targets))
        for name in dict.fromkeys(row.curve for row in rows)
    ]
    psnr = {row.target: row.psnr for row in rows}
    head = [t if math.isnan(psnr[t]) or t == f"{psnr[t]:g} dB" else f"{t} ({psnr[t]:.2f})" for t in targets]
    where = "mean over all scenes" if scene is None else scene
    kind = "reference " if report.reference else ""
    counted = kind + ("minutes" if unit.per_minute == 1.0 else "seconds") + " of training"
    counted += " and set-up" if report.setup else ""
    return text_table(f"{counted} to reach a test PSNR ({where})", ("method", *head), lines)


def _when(row: Reach, unit: TimeUnit, several: bool) -> str:
    if not row.runs:
        return "no run"
    if row.missing:  # the reason is in the notes below the tables
        return MISSING
    if row.reached < row.runs:
        return "never" if not row.reached else f"{row.reached} of {row.runs} runs"
    if math.isnan(row.minutes.mean):
        return MISSING
    text = ("≤ " if row.bound else "") + _time(row.minutes, row, unit)
    return f"{text} (in {row.length})" if several else text


def _time(minutes: MeanAndDeviation, row: Point | Reach, unit: TimeUnit) -> str:
    """Return a mean with its deviation or, if it is not ranked, the range over the runs."""
    if not row.unranked or math.isnan(minutes.mean):
        return number(unit.of(minutes), unit.digits)
    return seconds_range([row.low * unit.per_minute, row.high * unit.per_minute], unit.digits)


def _changed(title: str, rows: Sequence[Change], unit: TimeUnit) -> Table:
    head = ("change", "method", "trained for", "pairs", "dB gained", "95 % interval", f"extra {unit.name}",
            "extra ms/iter", f"dB per extra {'ref ' if unit.name.startswith('ref') else ''}min")  # fmt: skip
    lines = []
    for c in rows:
        interval = MISSING if math.isnan(c.low) else f"{c.low:+.2f} to {c.high:+.2f}"
        lines.append((
            c.what, c.method, c.length, str(c.pairs), number(c.db, 2, sign=True), interval,
            number(unit.of(c.minutes), unit.digits, sign=True), number(c.ms, 1, sign=True), per_minute(c),
        ))  # fmt: skip
    return text_table(title, head, lines)


def per_minute(change: Change) -> str:
    """Return the dB per extra minute, or why there are none."""
    if math.isnan(change.minutes.mean) or math.isnan(change.db.mean):
        return MISSING
    if change.unranked:
        return "not ranked"
    if change.same_time:
        return "same time"
    return f"{change.per_minute:+.2f}" if change.minutes.mean > 0.0 else "takes less"


def number(value: MeanAndDeviation, digits: int, *, sign: bool = False, spread: bool = True) -> str:
    """Return a mean and its deviation over seeds as text; a dash if it is missing."""
    if math.isnan(value.mean):
        return MISSING
    text = f"{value.mean:{'+' if sign else ''},.{digits}f}"
    return text if math.isnan(value.spread) or not spread else f"{text} ± {value.spread:.{digits}f}"
