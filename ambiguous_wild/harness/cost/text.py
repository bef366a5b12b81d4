"""The cost report for a terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ambiguous_wild.harness.cost.curves import Summary
from ambiguous_wild.harness.cost.front import Point
from ambiguous_wild.harness.cost.pairs import Change
from ambiguous_wild.harness.cost.reach import Reach
from ambiguous_wild.harness.cost.report import CostReport
from ambiguous_wild.harness.running.timing import seconds_range
from ambiguous_wild.harness.tables import plain_formats
from ambiguous_wild.harness.tables.plain_formats import plain
from ambiguous_wild.harness.tables.table import Table, text_table

MISSING = "—"
TIMES = {
    True: "times: reference seconds, see docs/cost.md; ranked between runs that were alone",
    False: "times: wall seconds of the machine; ranked between runs that were alone",
}
SHORT_MIN = 3.0  # trainings below this are told in seconds


def to_text(report: CostReport) -> str:
    """Every table of the report, aligned, and what is missing below."""
    parts = [plain_formats.to_text(tables_of(report))]
    parts += [f"{plain(answer.text)}" for answer in report.answers]
    parts += ["±: sample standard deviation over seeds"] if _has_spread(report) else []
    parts += [TIMES[report.reference]]
    parts += [plain(note) for note in report.notes]
    parts += [f"command: {plain(report.made_by)}"] if report.made_by else []
    return "\n".join(parts) + "\n"


@dataclass(frozen=True)
class Unit:
    """Of the times that are shown; files hold minutes."""

    name: str
    per_minute: float
    digits: int

    def of(self, minutes: Summary) -> Summary:
        return Summary(minutes.mean * self.per_minute, minutes.spread * self.per_minute)


def time_unit(report: CostReport) -> Unit:
    """Seconds where every training is short, else minutes."""
    minutes = [
        run.train_s / 60.0 for curve in report.curves for run in curve.runs if not math.isnan(run.train_s)
    ]
    kind = "ref " if report.reference else ""
    if max(minutes, default=0.0) < SHORT_MIN:
        return Unit(f"{kind}s", 60.0, 1)
    return Unit(f"{kind}min", 1.0, 2)


def tables_of(report: CostReport) -> list[Table]:
    """The tables: what each curve reaches, how soon, and what each change brings."""
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


def _when(row: Reach, unit: Unit, several: bool) -> str:
    if not row.runs:
        return "no run"
    if row.missing:  # the reason stands below the tables
        return MISSING
    if row.reached < row.runs:
        return "never" if not row.reached else f"{row.reached} of {row.runs} runs"
    if math.isnan(row.minutes.mean):
        return MISSING
    text = ("≤ " if row.bound else "") + _time(row.minutes, row, unit)
    return f"{text} (in {row.length})" if several else text


def _time(minutes: Summary, row: Point | Reach, unit: Unit) -> str:
    """A mean with its deviation; where it is not ranked, the range over the runs."""
    if not row.unranked or math.isnan(minutes.mean):
        return number(unit.of(minutes), unit.digits)
    return seconds_range([row.low * unit.per_minute, row.high * unit.per_minute], unit.digits)


def _changed(title: str, rows: Sequence[Change], unit: Unit) -> Table:
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
    """dB an extra minute, or why there is none."""
    if math.isnan(change.minutes.mean) or math.isnan(change.db.mean):
        return MISSING
    if change.unranked:
        return "not ranked"
    if change.same_time:
        return "same time"
    return f"{change.per_minute:+.2f}" if change.minutes.mean > 0.0 else "takes less"


def number(value: Summary, digits: int, *, sign: bool = False, spread: bool = True) -> str:
    """A mean and its deviation over seeds; a dash where it is missing."""
    if math.isnan(value.mean):
        return MISSING
    text = f"{value.mean:{'+' if sign else ''},.{digits}f}"
    return text if math.isnan(value.spread) or not spread else f"{text} ± {value.spread:.{digits}f}"


def _has_spread(report: CostReport) -> bool:
    return any(not math.isnan(p.psnr.spread) for p in report.points)
