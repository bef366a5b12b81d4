"""Gather runs into curves and points, find the Pareto front, and measure what a single change brings.

A curve holds the runs of one method with the same settings, over scenes and seeds. A mean is over seeds, then
over scenes. A failed cell, or a scene without a run, makes the mean missing, so that no method gains from a
failure.

A change is one effect or option. Its gain and cost come from pairs of runs that differ in nothing else: the
method, scene, seed, length, device and code are the same. Where the length is a budget, both trained equally
long: the gain in dB then includes what the effect costs, and dB per minute have no meaning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Literal

import numpy as np

from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.metrics import stats
from ambiguous_wild.report.cost_runs import CostRun, Length, why_unranked

SAME_TIME = 0.01  # of the training: a smaller difference of times counts as none
_ABSENT = "(absent)"

Kind = Literal["effect", "part", "resolution", "gaussians", "interval", "option"]
KINDS: tuple[Kind, ...] = ("effect", "part", "resolution", "gaussians", "interval", "option")


@dataclass(frozen=True)
class Change:
    """Gain and cost of a change, over all pairs of runs that differ in it alone."""

    # "interval": an option called *_every, how often something is refreshed; "part": a variant of an ablation
    kind: Kind
    name: str
    method: str
    before: str  # value of the option; empty for an effect
    after: str
    length: str
    scenes: tuple[str, ...]
    pairs: int
    db: MeanAndDeviation  # gain in PSNR, over pairs
    low: float  # 95 % bootstrap interval of the gain, over the test images of all pairs
    high: float
    minutes: MeanAndDeviation  # extra minutes of training, over pairs
    ms: MeanAndDeviation  # extra ms per iteration
    share: float  # extra minutes, as a share of the training without the change
    unranked: str = ""  # why the minutes cannot be trusted; empty if they can

    @property
    def what(self) -> str:
        """The change in words."""
        if self.kind == "effect":
            return self.name
        before_after = f"{self.before} → {self.after}"
        return before_after if self.kind == "part" else f"{self.name} {before_after}"

    @property
    def per_minute(self) -> float:
        """Gain in dB per extra minute; NaN if it takes no longer, or a run was not alone."""
        if not self.minutes.mean > 0.0 or self.same_time or self.unranked:
            return math.nan
        return self.db.mean / self.minutes.mean

    @property
    def same_time(self) -> bool:
        return abs(self.share) < SAME_TIME


def changes(runs: Sequence[CostRun]) -> list[Change]:
    """Measure every effect and option in which alone some pair of runs differs, by kind, name and method."""
    usable = [run for run in runs if not run.error]
    measured = [_change("effect", key, pairs) for key, pairs in sorted(_effect_pairs(usable).items())]
    measured += [_change("part", key, pairs) for key, pairs in sorted(_part_pairs(usable).items())]
    for key, pairs in sorted(_option_pairs(usable).items()):
        measured.append(_change(_kind(key[0]), key, _costlier_second(pairs)))
    return sorted(measured, key=lambda c: (KINDS.index(c.kind), c.name, c.method))


def _kind(option: str) -> Kind:
    own: dict[str, Kind] = {"resolution": "resolution", "max_gaussians": "gaussians"}
    return own.get(option, "interval" if option.rpartition(".")[2].endswith("_every") else "option")


Key = tuple[str, ...]  # name, method, length, and for options the two values
Pairs = list[tuple[CostRun, CostRun]]


def _groups(runs: Iterable[CostRun], key: Callable[[CostRun], Any]) -> list[list[CostRun]]:
    groups: dict[Any, list[CostRun]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())


def _effect_pairs(runs: Sequence[CostRun]) -> dict[Key, Pairs]:
    pairs: dict[Key, Pairs] = {}
    for group in _groups(runs, lambda r: (r.method, r.scene, r.seed, r.length, r.rest, r.options)):
        for a, b in combinations(sorted(group, key=lambda r: len(r.effects)), 2):
            if len(b.effects - a.effects) == 1 and a.effects < b.effects:
                (name,) = b.effects - a.effects
                pairs.setdefault((name, a.method, a.length.text), []).append((a, b))
    return pairs


def _part_pairs(runs: Sequence[CostRun]) -> dict[Key, Pairs]:
    """Pair each variant of an ablation with the unchanged method or, without a run of it, the first one."""
    pairs: dict[Key, Pairs] = {}
    for group in _groups(runs, lambda r: (r.base, r.scene, r.seed, r.length, r.rest, r.effects)):
        plain = [run for run in group if run.method == run.base]
        variants = sorted((run for run in group if run.method != run.base and "=" not in run.method),
                          key=lambda run: run.method)  # fmt: skip
        if len(plain) > 1:  # with several settings it is unclear which one a variant belongs to
            continue
        for of_group in _groups(variants, lambda run: run.method.partition("@")[2].partition("-")[0]):
            host, *others = [*plain, *of_group]
            for run in others:
                name = run.method.partition("@")[2]
                key = (name, run.base, run.length.text, _part(host), name)
                pairs.setdefault(key, []).append((host, run))
    return pairs


def _part(run: CostRun) -> str:
    return run.method.partition("@")[2] or "as it is"


def _option_pairs(runs: Sequence[CostRun]) -> dict[Key, Pairs]:
    pairs: dict[Key, Pairs] = {}
    for group in _groups(runs, lambda r: (r.base, r.scene, r.seed, r.length, r.rest, r.effects)):
        for a, b in combinations(group, 2):
            if a.method != b.method:
                continue  # a variant of an ablation: see `_part_pairs`
            one, two = dict(a.options), dict(b.options)
            keys = [k for k in one.keys() | two.keys() if one.get(k, _ABSENT) != two.get(k, _ABSENT)]
            if len(keys) != 1:
                continue
            values = sorted(((str(o.get(keys[0], _ABSENT)), run) for o, run in ((one, a), (two, b))),
                            key=lambda item: item[0])  # fmt: skip
            key = (keys[0], a.base, a.length.text, values[0][0], values[1][0])
            pairs.setdefault(key, []).append((values[0][1], values[1][1]))
    return pairs


def _costlier_second(pairs: Pairs) -> Pairs:
    """Return the pairs in the order in which the second runs take longer, on average."""
    extra = np.mean([_ms(b) - _ms(a) for a, b in pairs])
    return [(b, a) for a, b in pairs] if extra < 0.0 else pairs


def _ms(run: CostRun) -> float:
    return run.numbers["ms_per_iteration"]


def _change(kind: Kind, key: Key, pairs: Pairs) -> Change:
    name, method, length = key[:3]
    before, after = ("", "") if kind == "effect" else (_value(pairs[0][0], name), _value(pairs[0][1], name))
    if kind == "part":
        before, after = key[3:]
    without = stats.mean([a.train_s for a, _ in pairs]) / 60.0
    minutes = _summary([(b.train_s - a.train_s) / 60.0 for a, b in pairs])
    interval = _interval(pairs)
    return Change(
        kind,
        name,
        method,
        before,
        after,
        length,
        tuple(sorted({a.scene for a, _ in pairs})),
        len(pairs),
        _summary([b.psnr - a.psnr for a, b in pairs]),
        interval.low,
        interval.high,
        minutes,
        _summary([_ms(b) - _ms(a) for a, b in pairs]),
        minutes.mean / without if without > 0.0 else math.nan,
        why_unranked([run for pair in pairs for run in pair]),
    )


def _interval(pairs: Pairs) -> stats.Interval:
    """Return the interval of the gain over test images, paired by image, after a mean over seeds."""
    images: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for a, b in pairs:
        for name, psnr in a.images.items():
            images.setdefault((a.scene, name), []).append((b.images[name], psnr))
    if not images:
        return stats.Interval(math.nan, math.nan, math.nan, 0)
    means = np.array([np.mean(both, axis=0) for both in images.values()])
    return stats.paired_interval(means[:, 0], means[:, 1])


def _value(run: CostRun, option: str) -> str:
    return str(dict(run.options).get(option, _ABSENT))


def _summary(values: Sequence[float]) -> MeanAndDeviation:
    return MeanAndDeviation(stats.mean(values), stats.spread(values))


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


@dataclass(frozen=True)
class MeanAndDeviation:
    """A mean and the sample deviation over seeds; NaN = missing, or one seed."""

    mean: float = math.nan
    spread: float = math.nan


def curves_of(runs: Sequence[CostRun]) -> list[Curve]:
    """Gather runs into curves, sorted by name, then from the shortest training."""
    names = _names(runs)
    groups: dict[tuple[str, Length], list[CostRun]] = {}
    for run, name in zip(runs, names):
        groups.setdefault((name, run.length), []).append(run)
    curves = [Curve(name, runs[0].method, length, tuple(runs)) for (name, length), runs in groups.items()]
    return sorted(curves, key=lambda curve: (curve.name, curve.trained_s, curve.length))


def scenes_of(curves: Iterable[Curve]) -> tuple[str, ...]:
    return tuple(sorted({scene for curve in curves for scene in curve.scenes}))


def longest(curves: Sequence[Curve]) -> list[Curve]:
    """Return the curve that trained longest, for each name."""
    best: dict[str, Curve] = {}
    for curve in curves:  # sorted by length
        best[curve.name] = curve
    return list(best.values())


def summary(curve: Curve, scenes: Sequence[str], value: Callable[[CostRun], float]) -> MeanAndDeviation:
    """Return the mean over seeds, then scenes; the spread is over seeds of the mean over scenes.

    Args:
        curve: the runs.
        scenes: scenes of the mean; if one has no run, the mean is missing.
        value: the number of a run; NaN = missing.
    """
    by_scene = [{run.seed: value(run) for run in curve.on(scene)} for scene in scenes]
    if not all(by_scene):
        return MeanAndDeviation()
    mean = stats.mean([stats.mean(list(values.values())) for values in by_scene])
    seeds = by_scene[0].keys()
    if any(values.keys() != seeds for values in by_scene):
        return MeanAndDeviation(mean)  # scenes have different seeds: no seed has a mean over all scenes
    return MeanAndDeviation(
        mean, stats.spread([stats.mean([v[seed] for v in by_scene]) for seed in sorted(seeds)])
    )


def psnr_at(run: CostRun, seconds: np.ndarray) -> np.ndarray:
    """Return the PSNR of a run at times [n] s, interpolated linearly between probes; NaN outside of them."""
    if not run.points:
        return np.full(len(seconds), math.nan)
    at, psnr = np.array(run.points).T
    return np.interp(seconds, at, psnr, left=math.nan, right=math.nan)


def timeline(curve: Curve, scenes: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean PSNR over training time, where every run of every scene has one.

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
    seconds = np.linspace(begin, end, 120)
    by_scene = [np.mean([psnr_at(run, seconds) for run in curve.on(scene)], axis=0) for scene in scenes]
    return seconds, np.mean(by_scene, axis=0)


def _names(runs: Sequence[CostRun]) -> list[str]:
    """Return the name of each run's curve: its method, and the settings that vary among the method's runs."""
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
    psnr: MeanAndDeviation  # dB
    minutes: MeanAndDeviation  # of training; with the set-up if `setup` was asked for
    setup_s: MeanAndDeviation
    numbers: dict[
        str, MeanAndDeviation
    ]  # ms per iteration, Gaussians, MB, frames per second, the user's metrics
    unranked: str = ""  # why its time is not ranked
    low: float = math.nan  # minutes of the fastest run; shown if the time is not ranked
    high: float = math.nan  # minutes of the slowest run
    front: bool = False  # Pareto-optimal: no other curve reaches this PSNR in less time


def points(curves: Sequence[Curve], scenes: Sequence[str] = (), *, setup: bool = False) -> list[Point]:
    """Return one point for each curve, and mark those on the Pareto front of training time and PSNR.

    References, and curves with a run that was not alone on its machine, are never on the front.

    Args:
        curves: from `curves_of`.
        scenes: scenes of the means; empty = every scene that any curve has.
        setup: add the set-up before the first step to the time.
    """
    scenes = tuple(scenes) or scenes_of(curves)
    names = dict.fromkeys(name for curve in curves for run in curve.runs for name in run.numbers)
    all_points = [_point(curve, scenes, setup, names) for curve in curves]
    best = {id(p) for p in pareto([p for p in all_points if not knows_truth(p.method) and not p.unranked])}
    return [replace(p, front=id(p) in best) for p in all_points]


def pareto(among: Sequence[Point]) -> list[Point]:
    """Return the Pareto-optimal points in order of time; points with a missing number are left out."""
    complete = [p for p in among if not math.isnan(p.psnr.mean) and not math.isnan(p.minutes.mean)]
    front: list[Point] = []
    for point in sorted(complete, key=lambda p: (p.minutes.mean, -p.psnr.mean)):
        if not front or point.psnr.mean > front[-1].psnr.mean:
            front.append(point)
    return front


def _point(curve: Curve, scenes: Sequence[str], setup: bool, names: Iterable[str]) -> Point:
    def minutes(run: CostRun) -> float:
        return (run.train_s + (run.setup_s if setup else 0.0)) / 60.0

    def number(name: str) -> MeanAndDeviation:
        return summary(curve, scenes, lambda run: run.numbers.get(name, math.nan))

    runs = [run for run in curve.runs if run.scene in scenes]
    finite = [m for m in map(minutes, runs) if math.isfinite(m)]
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
        min(finite, default=math.nan),
        max(finite, default=math.nan),
    )
