"""Compute the time to reach a given PSNR, and one line for each scene on what accuracy costs.

The line takes the time of the method that is fastest, in the mean over its seeds. It leaves out references,
and runs that were not alone if others were.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.report.cost_curves import Curve, MeanAndDeviation, scenes_of, summary
from ambiguous_wild.report.cost_runs import CostRun, why_unranked

BELOW_BEST = (3.0, 1.0, 0.5)  # dB below the end of the best curve: the targets if none are given
MOST = 0.9  # of the best PSNR
LAST_DB = 1.0


@dataclass(frozen=True)
class PsnrTarget:
    """A PSNR to reach, relative to the best curve of each scene, or the same everywhere."""

    db: float  # below the best, or absolute
    relative: bool

    @property
    def text(self) -> str:
        return f"best - {self.db:g} dB" if self.relative else f"{self.db:g} dB"


@dataclass(frozen=True)
class Reach:
    """The time at which a curve reaches a target."""

    scene: str | None  # None: the mean over all scenes
    curve: str
    length: str
    target: str
    psnr: float  # dB of the target; NaN: it differs between scenes, or there is no best curve
    minutes: MeanAndDeviation  # of training; missing unless every run reaches the target
    reached: int  # number of runs that reach it
    runs: int
    bound: bool  # some runs had reached it by their first probe: the time is an upper bound
    unranked: str = ""  # why these times are not ranked; then they are shown from `low` to `high` minutes
    low: float = math.nan
    high: float = math.nan
    missing: str = ""  # why there is no mean: a scene without a run, or a run without probes


def times_to_reach(
    curves: Sequence[Curve], targets: Sequence[float] = (), *, setup: bool = False
) -> list[Reach]:
    """Compute the times for every scene, curve and target; first for the mean over several scenes.

    Among curves that differ only in length, the fastest is taken and its length given: a short training often
    reaches a target before a long one, whose schedule is slower.

    Args:
        curves: from `curves_of`.
        targets: in dB; empty = `BELOW_BEST` below the best curve of each scene that is no reference.
        setup: add the set-up before the first step to the time.
    """
    wanted = [PsnrTarget(t, False) for t in dict.fromkeys(targets)] or [
        PsnrTarget(t, True) for t in BELOW_BEST
    ]
    scenes = scenes_of(curves)
    lengths: dict[str, list[Curve]] = {}
    for curve in curves:
        lengths.setdefault(curve.name, []).append(curve)
    levels = {(t, scene): _level(t, curves, scene) for t in wanted for scene in scenes}
    rows = []
    groups: list[tuple[str | None, tuple[str, ...]]] = [(scene, (scene,)) for scene in scenes]
    if len(scenes) > 1:
        groups.insert(0, (None, scenes))
    for name, members in groups:
        for target in wanted:
            level = {scene: levels[target, scene] for scene in members}
            rows += [
                _soonest([_reach(c, target, name, level, setup) for c in same]) for same in lengths.values()
            ]
    return rows


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


def _level(target: PsnrTarget, curves: Sequence[Curve], scene: str) -> float:
    if not target.relative:
        return target.db
    # a reference sets no target for the other methods
    rivals = [curve for curve in curves if not all(knows_truth(run.method) for run in curve.runs)]
    ends = [summary(curve, (scene,), lambda run: run.psnr).mean for curve in rivals or curves]
    return max((end for end in ends if math.isfinite(end)), default=math.nan) - target.db


def _reach(
    curve: Curve, target: PsnrTarget, scene: str | None, level: dict[str, float], setup: bool
) -> Reach:
    runs = [run for name in level for run in curve.on(name)]
    times = {id(run): first_time(run, level[run.scene]) for run in runs}

    def minutes(run: CostRun) -> float:
        return (times[id(run)][0] + (run.setup_s if setup else 0.0)) / 60.0

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
        sum(math.isfinite(at) for at, _ in times.values()),
        len(runs),
        any(early for _, early in times.values()),
        why_unranked(runs),
        min((m for m in map(minutes, runs) if math.isfinite(m)), default=math.nan),
        max((m for m in map(minutes, runs) if math.isfinite(m)), default=math.nan),
        missing,
    )


def _missing(curve: Curve, scenes: Iterable[str], runs: Sequence[CostRun]) -> str:
    """Return why there can be no mean of these runs; empty if there can."""
    lacking = [scene for scene in scenes if not curve.on(scene)]
    if lacking:
        return f"no run on {', '.join(lacking)}"
    unprobed = [run.unprobed for run in runs if run.unprobed]
    # an unprobed run gives an upper bound at its end, and bounds and times are not averaged together
    return shortlist(unprobed, 2) if unprobed and len(unprobed) < len(runs) else ""


@dataclass(frozen=True)
class TargetRow:
    """The numbers in the line of one scene."""

    scene: str
    best: float  # dB, the highest mean over seeds at the end of a training
    best_curve: str
    most_s: float  # seconds until 90 % of the best PSNR; NaN if no training has a probe as low
    most_spread_s: float  # sample deviation over seeds; NaN for one seed
    most_curve: str
    bound: bool  # it was reached at the first probe: most_s is an upper bound
    last_s: float  # seconds from 1 dB below the best to the best
    ranked: bool  # False: some times are of runs that were not alone

    @property
    def text(self) -> str:
        """For example "on yard 90 % of the best PSNR (28.4 dB) takes 41 s (3dgs), the last dB 6 min"."""
        spread = "" if math.isnan(self.most_spread_s) else f" ± {self.most_spread_s:.1f} s"
        bound = "at most " if self.bound else ""
        most = f"takes {bound}{duration(self.most_s)}{spread} ({self.most_curve})"
        most = "not measured" if math.isnan(self.most_s) else most
        last = "not measured" if math.isnan(self.last_s) else f"{duration(self.last_s)} ({self.best_curve})"
        line = f"on {self.scene} 90 % of the best PSNR ({self.best:.1f} dB) {most}, the last dB {last}"
        return line if self.ranked else f"{line}; not all of these runs were alone on their machine"


def duration(seconds: float) -> str:
    """Return a time as seconds below two minutes, else as minutes."""
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.3g} min"


def answers(curves: Sequence[Curve], *, setup: bool = False) -> list[TargetRow]:
    """Compute the answer for each scene with a finished run.

    Args:
        curves: from `curves_of`.
        setup: add the set-up before the first step to the time.
    """
    rivals = [curve for curve in curves if not knows_truth(curve.method)]
    alone = [curve for curve in rivals if not why_unranked(curve.runs)]
    by_scene = (_answer(s, [c for c in alone or rivals if c.on(s)], setup) for s in scenes_of(rivals))
    return [answer for answer in by_scene if answer is not None]


def _answer(scene: str, curves: Sequence[Curve], setup: bool) -> TargetRow | None:
    ends = {id(c): summary(c, (scene,), lambda run: run.psnr).mean for c in curves}
    finished = [c for c in curves if math.isfinite(ends[id(c)])]
    if not finished:
        return None
    best_curve = max(finished, key=lambda c: ends[id(c)])
    best = ends[id(best_curve)]
    # seeds end above or below their mean, so the mean is reached at the end of the training
    end_s = summary(best_curve, (scene,), lambda run: run.train_s + (run.setup_s if setup else 0.0)).mean
    on_scene = [Curve(c.name, c.method, c.length, tuple(c.on(scene))) for c in finished]
    most = _first(on_scene, MOST * best, setup)
    own = [c for c in on_scene if c.name == best_curve.name and c.length == best_curve.length]
    before = _first(own, best - LAST_DB, setup)
    return TargetRow(
        scene,
        best,
        best_curve.name,
        math.nan if most is None else 60.0 * most.minutes.mean,
        math.nan if most is None else 60.0 * most.minutes.spread,
        "" if most is None else most.curve,
        most is not None and most.bound,
        math.nan if before is None or before.bound else end_s - 60.0 * before.minutes.mean,
        not any(why_unranked(c.runs) for c in on_scene),
    )


def _first(curves: Sequence[Curve], psnr: float, setup: bool) -> Reach | None:
    """Return the row of the curve that is first to reach `psnr` with all its seeds."""
    rows = [row for row in times_to_reach(curves, [psnr], setup=setup) if math.isfinite(row.minutes.mean)]
    return min(rows, key=lambda row: row.minutes.mean, default=None)
