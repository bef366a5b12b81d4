"""Curves: the runs of one method with the same settings, over its scenes and seeds, and their front.

A mean is over seeds, then over scenes. A cell that failed, or a scene that a curve has no run on, makes
the mean missing, so that no method gains from a failure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ambiguous_wild.harness.cost.read import CostRun, Length, why_unranked
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats


@dataclass(frozen=True)
class Curve:
    """One line of a plot: a method, its settings, one length of training."""

    name: str  # the method, and settings that differ between curves except the length
    method: str
    length: Length
    runs: tuple[CostRun, ...]

    @property
    def scenes(self) -> tuple[str, ...]:
        return tuple(sorted({run.scene for run in self.runs}))

    @property
    def trained_s(self) -> float:
        """Seconds of the longest training; 0 where none is known."""
        return max((run.train_s for run in self.runs if math.isfinite(run.train_s)), default=0.0)

    def on(self, scene: str) -> list[CostRun]:
        return sorted((run for run in self.runs if run.scene == scene), key=lambda run: run.seed)


@dataclass(frozen=True)
class Summary:
    """A mean and the sample deviation over seeds; NaN = missing, or one seed."""

    mean: float = math.nan
    spread: float = math.nan


def curves_of(runs: Sequence[CostRun]) -> list[Curve]:
    """Runs gathered into curves, by name, the shortest training first."""
    names = _names(runs)
    groups: dict[tuple[str, Length], list[CostRun]] = {}
    for run, name in zip(runs, names):
        groups.setdefault((name, run.length), []).append(run)
    curves = [Curve(name, runs[0].method, length, tuple(runs)) for (name, length), runs in groups.items()]
    return sorted(curves, key=lambda curve: (curve.name, curve.trained_s, curve.length))


def scenes_of(curves: Iterable[Curve]) -> tuple[str, ...]:
    return tuple(sorted({scene for curve in curves for scene in curve.scenes}))


def longest(curves: Sequence[Curve]) -> list[Curve]:
    """Of each name the curve that trained longest."""
    best: dict[str, Curve] = {}
    for curve in curves:  # sorted by length
        best[curve.name] = curve
    return list(best.values())


def summary(curve: Curve, scenes: Sequence[str], value: Callable[[CostRun], float]) -> Summary:
    """Mean over seeds, then scenes; the spread is over seeds of the mean over scenes.

    Args:
        curve: whose runs.
        scenes: the mean is over these; one without a run makes it missing.
        value: of a run; NaN = missing.
    """
    by_scene = [{run.seed: value(run) for run in curve.on(scene)} for scene in scenes]
    if not all(by_scene):
        return Summary()
    mean = stats.mean([stats.mean(list(values.values())) for values in by_scene])
    seeds = by_scene[0].keys()
    if any(values.keys() != seeds for values in by_scene):
        return Summary(mean)  # seeds that are not everywhere: no mean over scenes of a seed
    return Summary(mean, stats.spread([stats.mean([v[seed] for v in by_scene]) for seed in sorted(seeds)]))


def psnr_at(run: CostRun, seconds: np.ndarray) -> np.ndarray:
    """PSNR of a run at times [n] s, by straight lines between its probes; NaN outside them."""
    if not run.points:
        return np.full(len(seconds), math.nan)
    at, psnr = np.array(run.points).T
    return np.interp(seconds, at, psnr, left=math.nan, right=math.nan)


def timeline(curve: Curve, scenes: Sequence[str], count: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Mean PSNR over training time, where every run of every scene has one.

    Returns:
        (seconds [n], dB [n]); both empty where a run is missing.
    """
    runs = [run for scene in scenes for run in curve.on(scene)]
    if not all(curve.on(scene) for scene in scenes) or not all(run.points for run in runs):
        return np.empty(0), np.empty(0)
    begin = max(run.points[0][0] for run in runs)
    end = min(run.points[-1][0] for run in runs)
    if end < begin:
        return np.empty(0), np.empty(0)
    seconds = np.linspace(begin, end, count)
    by_scene = [np.mean([psnr_at(run, seconds) for run in curve.on(scene)], axis=0) for scene in scenes]
    return seconds, np.mean(by_scene, axis=0)


def _names(runs: Sequence[CostRun]) -> list[str]:
    """The name of each run's curve: its method, and the settings that vary among its runs."""
    asked: dict[str, set[str]] = {}
    values: dict[str, dict[str, set[Any]]] = {}
    for run in runs:
        asked.setdefault(run.method, set()).add(run.asked)
        options = values.setdefault(run.method, {})
        for key, value in run.options:
            options.setdefault(key, set()).add(value)
    return [_name(run, asked[run.method], values[run.method]) for run in runs]


def _name(run: CostRun, asked: set[str], values: dict[str, set[Any]]) -> str:
    parts = [run.method]
    if len(asked) > 1:
        parts.append(f"+ {run.asked}" if run.asked else "plain")
    parts += [f"{key}={value}" for key, value in run.options if len(values[key]) > 1]
    return " ".join(parts)


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
    numbers: dict[str, Summary]  # ms an iteration, Gaussians, MB, frames a second, own metrics
    unranked: str = ""  # why its time is not ranked
    low: float = math.nan  # minutes of its fastest and its slowest run, shown where it is not ranked
    high: float = math.nan
    front: bool = False  # Pareto-optimal: no other curve reaches this PSNR in less time


def points(curves: Sequence[Curve], scenes: Sequence[str] = (), *, setup: bool = False) -> list[Point]:
    """One point a curve, with those on the Pareto front of training time and PSNR marked.

    References, and curves with a run that was not alone on its machine, are never on the front.

    Args:
        curves: from `curves_of`.
        scenes: the means are over these; empty = every scene that any curve has.
        setup: count what comes before the first step as time too.
    """
    scenes = tuple(scenes) or scenes_of(curves)
    names = dict.fromkeys(name for curve in curves for run in curve.runs for name in run.numbers)
    made = [_point(curve, scenes, setup, names) for curve in curves]
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


def _point(curve: Curve, scenes: Sequence[str], setup: bool, names: Iterable[str]) -> Point:
    def minutes(run: CostRun) -> float:
        return (run.train_s + (run.setup_s if setup else 0.0)) / 60.0

    def number(name: str) -> Summary:
        return summary(curve, scenes, lambda run: run.numbers.get(name, math.nan))

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
        {name: number(name) for name in names},
        why_unranked(runs),
        min(known, default=math.nan),
        max(known, default=math.nan),
    )
