"""PSNR and cost of each curve, and which curves are Pareto-optimal."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ambiguous_wild.harness.cost.curves import Curve, Summary, scenes_of, summary
from ambiguous_wild.harness.cost.read import NUMBERS, CostRun, why_unranked
from ambiguous_wild.methods.registry import knows_truth


@dataclass(frozen=True)
class Point:
    """A curve as one point, over all scenes of the report."""

    curve: str
    method: str
    length: str
    runs: int
    psnr: Summary  # dB
    minutes: Summary  # of training; with the set-up before it where `setup` is set
    setup_s: Summary
    numbers: dict[str, Summary]  # ms an iteration, Gaussians, MB, frames a second
    unranked: str = ""  # why its time is not ranked
    low: float = math.nan  # minutes of its fastest and its slowest run, shown where it is not ranked
    high: float = math.nan
    front: bool = False  # Pareto-optimal: no other curve reaches this PSNR in less time


def points(curves: Sequence[Curve], scenes: Sequence[str] = (), *, setup: bool = False) -> list[Point]:
    """One point a curve, with those on the Pareto front of training time and PSNR marked.

    Oracles, and curves with a run that was not alone on its machine, are never on the front.

    Args:
        curves: from `curves_of`.
        scenes: the means are over these; empty = every scene that any curve has.
        setup: count what comes before the first step as time too.
    """
    scenes = tuple(scenes) or scenes_of(curves)
    made = [_point(curve, scenes, setup) for curve in curves]
    best = {id(p) for p in pareto([p for p in made if not knows_truth(p.method) and not p.unranked])}
    return [replace(p, front=id(p) in best) for p in made]


def pareto(among: Sequence[Point]) -> list[Point]:
    """Pareto-optimal points in order of time; a point with a missing number is never one."""
    known = [p for p in among if not math.isnan(p.psnr.mean) and not math.isnan(p.minutes.mean)]
    front: list[Point] = []
    for point in sorted(known, key=lambda p: (p.minutes.mean, -p.psnr.mean)):
        if not front or point.psnr.mean > front[-1].psnr.mean:
            front.append(point)
    return front


def _point(curve: Curve, scenes: Sequence[str], setup: bool) -> Point:
    def minutes(run: CostRun) -> float:
        return (run.train_s + (run.setup_s if setup else 0.0)) / 60.0

    def number(name: str) -> Summary:
        return summary(curve, scenes, lambda run: run.numbers[name])

    runs = [run for run in curve.runs if run.scene in scenes]
    known = [m for m in map(minutes, runs) if math.isfinite(m)]
    return Point(
        curve.name,
        curve.method,
        curve.length.text,
        len(runs),
        summary(curve, scenes, lambda run: run.psnr),
        summary(curve, scenes, minutes),
        summary(curve, scenes, lambda run: run.setup_s),
        {name: number(name) for name in NUMBERS},
        why_unranked(runs),
        min(known, default=math.nan),
        max(known, default=math.nan),
    )
