"""How long it takes to reach a given PSNR, and what accuracy costs on a scene, in one line.

The time of a PSNR is that of whichever method is there first, on the mean over its seeds. In the line,
references do not count, nor do runs that were not alone where others were.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.report.cost_curves import Curve, Summary, scenes_of, summary
from ambiguous_wild.report.cost_read import CostRun, why_unranked

BELOW_BEST = (3.0, 1.0, 0.5)  # dB below what the best curve ends at, where no target is given


@dataclass(frozen=True)
class Target:
    """A PSNR to reach; relative to the best curve of each scene, or the same everywhere."""

    db: float  # below the best, or absolute
    relative: bool

    @property
    def text(self) -> str:
        return f"best - {self.db:g} dB" if self.relative else f"{self.db:g} dB"


@dataclass(frozen=True)
class Reach:
    """When a curve reaches a target."""

    scene: str | None  # None: the mean over all scenes
    curve: str
    length: str
    target: str
    psnr: float  # dB to reach; NaN: differs from scene to scene, or nothing to be relative to
    minutes: Summary  # of training; missing unless every run reaches it
    reached: int  # runs that do
    runs: int
    bound: bool  # some had reached it by their first probe: the time is an upper bound
    unranked: str = ""  # why these times are not ranked; then they are shown from `low` to `high` minutes
    low: float = math.nan
    high: float = math.nan
    missing: str = ""  # why there is no mean, whatever the runs reached: a scene without a run, or no probes


def times_to_reach(
    curves: Sequence[Curve], targets: Sequence[float] = (), *, setup: bool = False
) -> list[Reach]:
    """For every scene, curve and target; then for the mean over scenes, where there are several.

    Of curves that differ in length alone the one that is there first counts, and its length is told: a
    short training is often there before the long one, whose schedule takes its time.

    Args:
        curves: from `curves_of`.
        targets: in dB; empty = `BELOW_BEST` below the best of each scene that is not shown the truth.
        setup: count what comes before the first step too.
    """
    wanted = [Target(t, False) for t in dict.fromkeys(targets)] or [Target(t, True) for t in BELOW_BEST]
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
    """Of several lengths the one that is there first; where none always is, the one that most often is."""
    there = [row for row in rows if math.isfinite(row.minutes.mean)]
    if there:
        return min(there, key=lambda row: row.minutes.mean)
    return max(
        reversed(rows), key=lambda row: (row.runs > 0, not row.missing, row.reached / max(row.runs, 1))
    )


def first_time(run: CostRun, psnr: float) -> tuple[float, bool]:
    """Seconds of training until the run reaches `psnr` dB, by a straight line between two probes.

    Returns:
        (seconds, whether it had reached it by its first probe); NaN if it never does.
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


def _level(target: Target, curves: Sequence[Curve], scene: str) -> float:
    if not target.relative:
        return target.db
    # a reference sets no target for the other methods
    rivals = [curve for curve in curves if not all(knows_truth(run.method) for run in curve.runs)]
    ends = [summary(curve, (scene,), lambda run: run.psnr).mean for curve in rivals or curves]
    return max((end for end in ends if math.isfinite(end)), default=math.nan) - target.db


def _reach(curve: Curve, target: Target, scene: str | None, level: dict[str, float], setup: bool) -> Reach:
    runs = [run for name in level for run in curve.on(name)]
    found = {id(run): first_time(run, level[run.scene]) for run in runs}

    def minutes(run: CostRun) -> float:
        return (found[id(run)][0] + (run.setup_s if setup else 0.0)) / 60.0

    missing, mean = _missing(curve, level, runs), Summary()
    if not missing:
        mean = summary(curve, tuple(level), minutes)
        if any(run.blind for run in runs):
            mean = Summary(mean.mean)  # the spread of upper bounds means nothing
    return Reach(
        scene,
        curve.name,
        curve.length.text,
        target.text,
        next(iter(level.values())) if len(level) == 1 or not target.relative else math.nan,
        mean,
        sum(math.isfinite(at) for at, _ in found.values()),
        len(runs),
        any(early for _, early in found.values()),
        why_unranked(runs),
        min((m for m in map(minutes, runs) if math.isfinite(m)), default=math.nan),
        max((m for m in map(minutes, runs) if math.isfinite(m)), default=math.nan),
        missing,
    )


def _missing(curve: Curve, scenes: Iterable[str], runs: Sequence[CostRun]) -> str:
    """Why there is no mean of these runs; empty where there may be one."""
    gone = [scene for scene in scenes if not curve.on(scene)]
    if gone:
        return f"no run on {', '.join(gone)}"
    blind = [run.blind for run in runs if run.blind]
    # The end of a run is a bound on when it got there, and no mean is taken of bounds and times.
    return shortlist(blind, 2) if blind and len(blind) < len(runs) else ""


MOST = 0.9  # of the best PSNR
LAST_DB = 1.0


@dataclass(frozen=True)
class Answer:
    """The line of one scene, as numbers."""

    scene: str
    best: float  # dB, the highest mean over seeds at the end of a training
    best_curve: str
    most_s: float  # seconds until 90 % of it; NaN where no training was probed so low
    most_spread_s: float  # sample deviation over seeds; NaN for one seed
    most_curve: str
    bound: bool  # it was there at the first probe: most_s is an upper bound
    last_s: float  # seconds from 1 dB below the best to the best
    ranked: bool  # False: some times are of runs that were not alone

    @property
    def text(self) -> str:
        """ "on yard 90 % of the best PSNR (28.4 dB) takes 41 s (3dgs), the last dB 6 min (refinesplat)"."""
        spread = "" if math.isnan(self.most_spread_s) else f" ± {self.most_spread_s:.1f} s"
        most = (
            "not measured" if math.isnan(self.most_s) else f"takes {self._most}{spread} ({self.most_curve})"
        )
        last = "not measured" if math.isnan(self.last_s) else f"{duration(self.last_s)} ({self.best_curve})"
        line = f"on {self.scene} 90 % of the best PSNR ({self.best:.1f} dB) {most}, the last dB {last}"
        return line if self.ranked else f"{line}; not all of these runs were alone on their machine"

    @property
    def _most(self) -> str:
        return f"{'at most ' if self.bound else ''}{duration(self.most_s)}"


def duration(seconds: float) -> str:
    """Seconds below two minutes, else minutes."""
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.3g} min"


def answers(curves: Sequence[Curve], *, setup: bool = False) -> list[Answer]:
    """One a scene with a finished run.

    Args:
        curves: from `curves_of`.
        setup: count what comes before the first step too.
    """
    rivals = [curve for curve in curves if not knows_truth(curve.method)]
    alone = [curve for curve in rivals if not why_unranked(curve.runs)]
    found = []
    for scene in scenes_of(rivals):
        here = [c for c in alone or rivals if c.on(scene)]
        answer = _answer(scene, here, setup)
        if answer is not None:
            found.append(answer)
    return found


def _answer(scene: str, curves: Sequence[Curve], setup: bool) -> Answer | None:
    ends = {id(c): summary(c, (scene,), lambda run: run.psnr).mean for c in curves}
    known = [c for c in curves if math.isfinite(ends[id(c)])]
    if not known:
        return None
    best_curve = max(known, key=lambda c: ends[id(c)])
    best = ends[id(best_curve)]
    # each of its seeds ends above or below their mean: the end of the training is when the mean is there
    there = summary(best_curve, (scene,), lambda run: run.train_s + (run.setup_s if setup else 0.0)).mean
    here = [Curve(c.name, c.method, c.length, tuple(c.on(scene))) for c in known]
    most = _first(here, MOST * best, setup)
    own = [c for c in here if c.name == best_curve.name and c.length == best_curve.length]
    before = _first(own, best - LAST_DB, setup)
    return Answer(
        scene,
        best,
        best_curve.name,
        math.nan if most is None else 60.0 * most.minutes.mean,
        math.nan if most is None else 60.0 * most.minutes.spread,
        "" if most is None else most.curve,
        most is not None and most.bound,
        math.nan if before is None or before.bound else there - 60.0 * before.minutes.mean,
        not any(why_unranked(c.runs) for c in here),
    )


def _first(curves: Sequence[Curve], psnr: float, setup: bool) -> Reach | None:
    """The row of whichever curve reaches it first with all its seeds."""
    rows = [row for row in times_to_reach(curves, [psnr], setup=setup) if math.isfinite(row.minutes.mean)]
    return min(rows, key=lambda row: row.minutes.mean, default=None)
