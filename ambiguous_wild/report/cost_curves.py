"""Gather runs into curves, and say what each curve reaches: points, the Pareto front, the time to a PSNR.

A curve holds the runs of one method with the same settings, over scenes and seeds. A mean is over seeds, then
over scenes. A failed cell, or a scene without a run, makes the mean missing, so that no method gains from a
failure. Times are those of `CostRun.minutes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.harness.measures import measure
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats
from ambiguous_wild.report.cost_runs import CostRun, Length, why_unranked

BELOW_BEST = (3.0, 1.0, 0.5)  # dB below the end of the best curve: the targets if none are given


@dataclass(frozen=True)
class MeanAndDeviation:
    """A mean and the sample deviation over seeds; NaN = missing, or one seed."""

    mean: float = math.nan
    spread: float = math.nan


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
        """Seconds of the longest training; 0 if none is known."""
        return max((run.train_s for run in self.runs if math.isfinite(run.train_s)), default=0.0)

    def on(self, scene: str) -> list[CostRun]:
        return sorted((run for run in self.runs if run.scene == scene), key=lambda run: run.seed)

    def mixed(self, scenes: Iterable[str]) -> bool:
        """Return whether runs on one of the scenes differ beside the seed: they have no mean."""
        return any(len({run.rest for run in self.on(scene)}) > 1 for scene in scenes)

    def end(self, scene: str) -> float:
        """Return the PSNR in dB at the end of the training on a scene, mean over seeds."""
        return summary(self, (scene,), lambda run: run.psnr).mean


def curves_of(runs: Sequence[CostRun]) -> list[Curve]:
    """Gather runs into curves, in the order of methods, then by name and from the shortest training."""
    named = grouped(zip(_names(runs), runs), lambda item: (item[0], item[1].length))
    curves = [
        Curve(name, items[0][1].method, length, tuple(run for _, run in items))
        for (name, length), items in named.items()
    ]
    return sorted(curves, key=lambda curve: (curve.runs[0].place, curve.name, curve.trained_s, curve.length))


def _names(runs: Sequence[CostRun]) -> list[str]:
    """Return the name of each run's curve: its method, and the settings that vary among the method's runs.

    Where variants of an ablation vary a single option, they and the default are named by its value.
    """
    asked: dict[str, set[str]] = {}
    values: dict[tuple[str, str], set[Any]] = {}
    for run in runs:
        asked.setdefault(run.method, set()).add(run.asked)
        for key, value in run.options:
            values.setdefault((run.method, key), set()).add(value)
    swept, shown = _swept(runs), {run.method: run.shown for run in runs}
    names = []
    for run in runs:
        effects = f"+ {run.asked}" if run.asked else "plain"
        name, key = run.shown or run.method, swept.get(run.base, "")
        if key and name == run.method:  # a variant without a label of its own
            name = shown.get(run.base) or run.base
        parts = [name, effects] if len(asked[run.method]) > 1 else [name]
        varied = (f"{k}={value}" for k, value in run.options if k == key or len(values[run.method, k]) > 1)
        names.append(" ".join([*parts, *varied]))
    return names


def _swept(runs: Sequence[CostRun]) -> dict[str, str]:
    """Return by method the option in which alone the variants of its ablation and its default differ."""
    values: dict[str, dict[str, set[Any]]] = {run.base: {} for run in runs if run.part}
    for run in runs:
        for key, value in run.options if run.base in values else ():
            values[run.base].setdefault(key, set()).add(value)
    varied = {base: [key for key, of in options.items() if len(of) > 1] for base, options in values.items()}
    return {base: keys[0] for base, keys in varied.items() if len(keys) == 1}


def scenes_of(curves: Iterable[Curve]) -> tuple[str, ...]:
    return tuple(sorted({scene for curve in curves for scene in curve.scenes}))


def summary(curve: Curve, scenes: Sequence[str], value: Callable[[CostRun], float]) -> MeanAndDeviation:
    """Return the mean over seeds, then scenes; the spread is over seeds of the mean over scenes.

    Args:
        curve: the runs.
        scenes: scenes of the mean; if one has no run, or runs that differ beside the seed, it is missing.
        value: the number of a run; NaN = missing.
    """
    by_scene = [{run.seed: value(run) for run in curve.on(scene)} for scene in scenes]
    if not all(by_scene) or curve.mixed(scenes):
        return MeanAndDeviation()
    mean = stats.mean([stats.mean(list(values.values())) for values in by_scene])
    seeds = by_scene[0].keys()
    if any(values.keys() != seeds for values in by_scene):
        return MeanAndDeviation(mean)  # scenes have different seeds: no seed has a mean over all scenes
    return MeanAndDeviation(
        mean, stats.sample_std([stats.mean([v[seed] for v in by_scene]) for seed in sorted(seeds)])
    )


def timeline(curve: Curve, scenes: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean PSNR over training time, where every run of every scene has one.

    PSNR is interpolated linearly between probes.

    Returns:
        (seconds [n], dB [n]); both empty where a run is missing.
    """
    by_scene = [curve.on(scene) for scene in scenes]
    points = [run.points for runs in by_scene for run in runs]
    if not all(by_scene) or not all(points) or curve.mixed(scenes):
        return np.empty(0), np.empty(0)
    begin, end = max(p[0][0] for p in points), min(p[-1][0] for p in points)
    if end < begin:
        return np.empty(0), np.empty(0)
    seconds = np.linspace(begin, end, 120)
    means = [np.mean([np.interp(seconds, *np.array(r.points).T) for r in runs], axis=0) for runs in by_scene]
    return seconds, np.mean(means, axis=0)


@dataclass(frozen=True)
class Point:
    """A curve as one point, over all scenes of the report; a row of cost.csv."""

    curve: str
    method: str
    length: str
    runs: int
    psnr: MeanAndDeviation  # dB
    minutes: MeanAndDeviation
    minutes_low: float = math.nan  # of the fastest run; shown if the time is not ranked
    minutes_high: float = math.nan  # of the slowest run
    not_ranked: str = ""  # why its time is not ranked
    pareto_front: bool = False  # no other curve reaches this PSNR in less time
    setup_s: MeanAndDeviation = MeanAndDeviation()
    # ms per iteration, Gaussians, MB, frames per second, the user's metrics; times only if they are ranked
    numbers: dict[str, MeanAndDeviation] = field(default_factory=dict)


def points(curves: Sequence[Curve]) -> list[Point]:
    """Return one point for each curve, and mark those on the Pareto front of training time and PSNR.

    References, and curves with a run that was not alone on its machine, are never on the front.
    """
    scenes = scenes_of(curves)
    names = dict.fromkeys(name for curve in curves for run in curve.runs for name in run.numbers)
    all_points = [_point(curve, scenes, names) for curve in curves]
    rivals = [p for p in all_points if not knows_truth(p.method) and not p.not_ranked]
    best = set(map(id, pareto(rivals, [p.minutes.mean for p in rivals])))
    return [replace(p, pareto_front=id(p) in best) for p in all_points]


def _point(curve: Curve, scenes: Sequence[str], names: Iterable[str]) -> Point:
    unranked = why_unranked(curve.runs)

    def number(name: str) -> MeanAndDeviation:
        if unranked and measure(name).timed:
            return MeanAndDeviation()
        return summary(curve, scenes, lambda run: run.numbers.get(name, math.nan))

    return Point(
        curve.name,
        curve.method,
        curve.length.text,
        len(curve.runs),
        summary(curve, scenes, lambda run: run.psnr),
        summary(curve, scenes, lambda run: run.minutes),
        *_range(run.minutes for run in curve.runs),
        unranked,
        setup_s=summary(curve, scenes, lambda run: run.setup_s),
        numbers={name: number(name) for name in names},
    )


def _range(values: Iterable[float]) -> tuple[float, float]:
    """Return the least and the greatest finite value; NaN without any."""
    finite = [value for value in values if math.isfinite(value)]
    return min(finite, default=math.nan), max(finite, default=math.nan)


def pareto(among: Sequence[Point], costs: Sequence[float]) -> list[Point]:
    """Return the Pareto-optimal points in order of cost; points with a missing number are left out."""
    known = [(c, p) for c, p in zip(costs, among) if not math.isnan(c) and not math.isnan(p.psnr.mean)]
    front: list[Point] = []
    for _, point in sorted(known, key=lambda item: (item[0], -item[1].psnr.mean)):
        if not front or point.psnr.mean > front[-1].psnr.mean:
            front.append(point)
    return front


@dataclass(frozen=True)
class PsnrTarget:
    """A PSNR to reach, relative to the best curve of each scene, or the same everywhere."""

    db: float  # below the best, or absolute
    relative: bool

    @property
    def text(self) -> str:
        return f"best - {self.db:g} dB" if self.relative else f"{self.db:g} dB"

    def level(self, curves: Sequence[Curve], scene: str) -> float:
        """Return the PSNR in dB on a scene; NaN without a finished run."""
        if not self.relative:
            return self.db
        # a reference sets no target for the other methods
        rivals = [curve for curve in curves if not all(knows_truth(run.method) for run in curve.runs)]
        ends = [curve.end(scene) for curve in rivals or curves]
        return max((end for end in ends if math.isfinite(end)), default=math.nan) - self.db


@dataclass(frozen=True)
class Reach:
    """The time at which a curve reaches a target; a row of time-to-psnr.csv."""

    scene: str  # empty: the mean over all scenes
    curve: str
    length: str
    target: str
    psnr: float  # dB of the target; NaN: it differs between scenes, or there is no best curve
    minutes: MeanAndDeviation  # missing unless every run reaches the target
    minutes_low: float  # shown instead where times are not ranked
    minutes_high: float
    not_ranked: str  # why these times are not ranked
    upper_bound: bool  # some runs had reached it by their first probe
    reached: int  # number of runs that reach it
    runs: int
    missing: str  # why there is no mean: a scene without a run, or a run without probes


def times_to_reach(curves: Sequence[Curve], targets: Sequence[float] = ()) -> list[Reach]:
    """Compute the times for every scene, curve and target; first for the mean over several scenes.

    Among curves that differ only in length, the fastest is taken and its length given: a short training often
    reaches a target before a long one, whose schedule is slower.

    Args:
        curves: from `curves_of`.
        targets: in dB; empty = `BELOW_BEST` below the best curve of each scene that is no reference.
    """
    wanted = [PsnrTarget(t, False) for t in dict.fromkeys(targets)]
    wanted = wanted or [PsnrTarget(t, True) for t in BELOW_BEST]
    scenes = scenes_of(curves)
    levels = {(t, scene): t.level(curves, scene) for t in wanted for scene in scenes}
    means = [("", scenes)] if len(scenes) > 1 else []
    return [
        _soonest([_reach(c, target, name, {s: levels[target, s] for s in members}) for c in same])
        for name, members in (*means, *((scene, (scene,)) for scene in scenes))
        for target in wanted
        for same in grouped(curves, lambda curve: curve.name).values()
    ]


def _soonest(rows: Sequence[Reach]) -> Reach:
    """Return the fastest of several lengths; if none always reaches the target, the one most often does."""
    complete = [row for row in rows if math.isfinite(row.minutes.mean)]
    if complete:
        return min(complete, key=lambda row: row.minutes.mean)
    return max(
        reversed(rows), key=lambda row: (row.runs > 0, not row.missing, row.reached / max(row.runs, 1))
    )


def first_time(run: CostRun, psnr: float) -> tuple[float, bool]:
    """Return the seconds until the run reaches `psnr` dB, interpolated linearly between two probes.

    Returns:
        (seconds, whether its first probe had reached it already); NaN if it never does.
    """
    if math.isnan(psnr):
        return math.nan, False
    before: tuple[float, float] | None = None
    for at, value in run.points:
        if value >= psnr:
            if before is None:
                return at, True
            share = (psnr - before[1]) / (value - before[1])
            return before[0] + (share if math.isfinite(share) else 1.0) * (at - before[0]), False
        before = (at, value)
    return math.nan, False


def _reach(curve: Curve, target: PsnrTarget, scene: str, level: dict[str, float]) -> Reach:
    runs = [run for name in level for run in curve.on(name)]
    times = {id(run): first_time(run, level[run.scene]) for run in runs}

    def minutes(run: CostRun) -> float:
        return (times[id(run)][0] + run.added_s) / 60.0

    missing, mean = _missing(curve, level, runs), MeanAndDeviation()
    if not missing:
        mean = summary(curve, tuple(level), minutes)
        if any(run.unprobed for run in runs):
            mean = MeanAndDeviation(mean.mean)  # the spread of upper bounds has no meaning
    return Reach(
        scene,
        curve.name,
        curve.length.text,
        target.text,
        next(iter(level.values())) if len(level) == 1 or not target.relative else math.nan,
        mean,
        *_range(map(minutes, runs)),
        why_unranked(runs),
        any(early for _, early in times.values()),
        sum(math.isfinite(at) for at, _ in times.values()),
        len(runs),
        missing,
    )


def _missing(curve: Curve, scenes: Iterable[str], runs: Sequence[CostRun]) -> str:
    """Return why there can be no mean of these runs; empty if there can."""
    lacking = [scene for scene in scenes if not curve.on(scene)]
    if lacking:
        return f"no run on {', '.join(lacking)}"
    if curve.mixed(scenes):
        return "runs differ beside the seed (scene, code, device, start or settings)"
    unprobed = [run.unprobed for run in runs if run.unprobed]
    # an unprobed run gives an upper bound at its end, and bounds and times are not averaged together
    return shortlist(unprobed, 2) if unprobed and len(unprobed) < len(runs) else ""


def duration(seconds: float) -> str:
    """Return a time as seconds below two minutes, else as minutes."""
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.3g} min"
