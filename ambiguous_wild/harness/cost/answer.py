"""What accuracy costs on a scene, in one line: most of the best PSNR, and the last dB.

The time of a PSNR is that of whichever method is there first, on the mean over its seeds. Oracles do not
count, nor do runs that were not alone where others were.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from ambiguous_wild.harness.cost.curves import Curve, scenes_of, summary
from ambiguous_wild.harness.cost.reach import Reach, times_to_reach
from ambiguous_wild.harness.cost.read import why_unranked
from ambiguous_wild.methods.registry import knows_truth

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
