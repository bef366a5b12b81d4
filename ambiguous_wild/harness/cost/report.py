"""The cost report as plain data, JSON and CSV."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.cost.answer import Answer, answers
from ambiguous_wild.harness.cost.curves import Curve, Summary, curves_of
from ambiguous_wild.harness.cost.front import Point, points
from ambiguous_wild.harness.cost.pairs import Change, changes
from ambiguous_wild.harness.cost.reach import Reach, times_to_reach
from ambiguous_wild.harness.cost.read import CostRun, Found, why_unranked
from ambiguous_wild.harness.tables.plain_formats import to_csv
from ambiguous_wild.io.atomic import write_json, write_text

PLOTS = ("timelines", "budgets", "front", "changes")
FILES = ("cost.csv", "time-to-psnr.csv", "changes.csv", "timelines.csv", "cost.json",
         *(f"{plot}{suffix}" for plot in PLOTS for suffix in (".svg", ".png")))  # fmt: skip


@dataclass(frozen=True)
class CostReport:
    """Everything `aw cost` prints, writes and draws."""

    curves: tuple[Curve, ...]
    scenes: tuple[str, ...]
    points: tuple[Point, ...]
    reach: tuple[Reach, ...]
    changes: tuple[Change, ...]
    notes: tuple[str, ...]
    answers: tuple[Answer, ...]  # one a scene
    reference: bool  # times are seconds of the reference machine; else wall seconds
    setup: bool  # whether times count what comes before the first step
    made_by: str


def cost_report(
    found: Found, *, targets: Sequence[float] = (), setup: bool = False, made_by: str = ""
) -> CostReport:
    """The cost report of the runs.

    Args:
        found: from `read_cost_runs`.
        targets: PSNR in dB to reach; empty = some below the best of each scene.
        setup: count what comes before the first step as time too.
        made_by: the command that makes it again.
    """
    curves, scenes = curves_of(found.runs), tuple(sorted({run.scene for run in found.runs}))
    return CostReport(
        tuple(curves),
        scenes,
        tuple(points(curves, setup=setup)),
        tuple(times_to_reach(curves, targets, setup=setup)),
        tuple(changes(found.runs)),
        (*found.notes, *_gaps(curves, scenes), *_unranked(curves)),
        tuple(answers(curves, setup=setup)),
        found.reference,
        setup,
        made_by,
    )


def _unranked(curves: Sequence[Curve]) -> list[str]:
    """One line a reason for times that are not ranked."""
    reasons: dict[str, list[str]] = {}
    for curve in curves:
        if why := why_unranked(curve.runs):
            reasons.setdefault(why, []).append(f"{curve.name}, {curve.length.text}")
    return [
        f"times not ranked, shown from the fastest to the slowest run: {shortlist(names)}: {why}"
        for why, names in reasons.items()
    ]


def _gaps(curves: Sequence[Curve], scenes: Sequence[str]) -> list[str]:
    lines = []
    for curve in curves:
        gone = [scene for scene in scenes if not curve.on(scene)]
        if gone:
            lines.append(
                f"no run: {curve.name}, {curve.length.text}, on {', '.join(gone)}; its means over scenes are "
                "missing"
            )
    return lines + _blind([run for curve in curves for run in curve.runs if not run.error])


def _blind(runs: Sequence[CostRun]) -> list[str]:
    """Which runs were not probed: methods of which none was by their name, else each run."""
    seen = {run.method for run in runs if not run.blind}
    never = sorted({run.method for run in runs} - seen)
    lines = [
        f"{run.blind} ({run.method} on {run.scene}, seed {run.seed}): only its end is known, so there is no "
        "mean time over it and runs with probes"
        for run in runs
        if run.blind and run.method in seen
    ]
    lines += [run.blind for run in runs if run.method in never and "damaged" in run.blind]
    if never:
        lines.append(
            f"no probes in the timelines of {', '.join(never)}: of the way to a PSNR only the end is known"
        )
    return lines


def write_report(report: CostReport, folder: Path) -> list[Path]:
    """cost.json, cost.csv, time-to-psnr.csv, changes.csv and timelines.csv; returns what was written."""
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
    """Remove the files of an earlier report, and nothing else: old plots must not stay beside new tables."""
    try:
        ours = "time_to_psnr" in json.loads((folder / "cost.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, TypeError, RecursionError):
        return
    if ours:
        for name in FILES:
            (folder / name).unlink(missing_ok=True)


def plain_data(report: CostReport) -> dict[str, Any]:
    """The report for JSON; null = missing."""
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
    return dict(finite(data))


def _point_row(p: Point) -> dict[str, Any]:
    row: dict[str, Any] = {"curve": p.curve, "method": p.method, "length": p.length, "runs": p.runs}
    row |= _both("psnr", p.psnr) | _both("minutes", p.minutes)
    row |= {"minutes_low": p.low, "minutes_high": p.high, "not_ranked": p.unranked, "pareto_front": p.front}
    row |= _both("setup_s", p.setup_s)
    for name, value in p.numbers.items():
        row |= _both(name, value)
    return row


def _reach_row(r: Reach) -> dict[str, Any]:
    row: dict[str, Any] = {
        "scene": r.scene or "",
        "curve": r.curve,
        "length": r.length,
        "target": r.target,
        "psnr": r.psnr,
    }
    return (
        row
        | _both("minutes", r.minutes)
        | {"minutes_low": r.low, "minutes_high": r.high, "not_ranked": r.unranked}
        | {"upper_bound": r.bound, "reached": r.reached, "runs": r.runs, "missing": r.missing}
    )


def _change_row(c: Change) -> dict[str, Any]:
    row: dict[str, Any] = {
        "kind": c.kind,
        "name": c.name,
        "method": c.method,
        "before": c.before,
        "after": c.after,
    }
    row |= {"length": c.length, "scenes": " ".join(c.scenes), "pairs": c.pairs}
    row |= _both("db", c.db) | {"db_low": c.low, "db_high": c.high}
    row |= _both("minutes", c.minutes) | _both("ms_per_iteration", c.ms)
    return row | {"db_per_minute": c.per_minute, "same_time": c.same_time, "not_ranked": c.unranked}


def _timeline_rows(curves: Iterable[Curve]) -> Iterable[dict[str, Any]]:
    for curve in curves:
        for run in curve.runs:
            for at, psnr in run.points:
                yield {"curve": curve.name, "length": curve.length.text, "scene": run.scene, "seed": run.seed,
                       "train_s": at, "psnr": psnr}  # fmt: skip


def _both(name: str, value: Summary) -> dict[str, float]:
    return {name: value.mean, f"{name}_std": value.spread}


def finite(value: Any) -> Any:
    """NaN is null, as in a result file; infinity is the string it writes."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else ("inf" if value > 0 else "-inf")
    return value
