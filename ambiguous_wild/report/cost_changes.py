"""Measure what a single change brings: one effect or option, on pairs of runs that differ in nothing else.

The method, scene, seed, length, device and code of a pair are the same. Where the length is a budget, both
trained equally long: the gain in dB then includes what the effect costs, and dB per minute have no meaning.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.metrics import stats
from ambiguous_wild.report.cost_curves import MeanAndDeviation
from ambiguous_wild.report.cost_runs import CostRun, why_unranked

SAME_TIME = 0.01  # of the training: a smaller difference of times counts as none
ABSENT = "(absent)"

Kind = Literal["effect", "part", "resolution", "gaussians", "interval", "option"]
KINDS: tuple[Kind, ...] = ("effect", "part", "resolution", "gaussians", "interval", "option")
Key = tuple[Kind, str, str, str, str, str]  # kind, name, method, length, before, after
Pair = tuple[CostRun, CostRun]


@dataclass(frozen=True)
class Change:
    """Gain and cost of a change, over all pairs of runs that differ in it alone; a row of changes.csv."""

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
    db_low: float  # 95 % interval of the gain, over the test images of all pairs
    db_high: float
    minutes: MeanAndDeviation  # extra minutes of training, over pairs
    ms_per_iteration: MeanAndDeviation  # extra ms, of the reference machine if the minutes are
    db_per_minute: float  # NaN if it takes no longer, or a run was not alone
    same_time: bool
    not_ranked: str = ""  # why the minutes cannot be trusted; empty if they can

    @property
    def what(self) -> str:
        """The change in words."""
        if self.kind == "effect":
            return self.name
        before_after = f"{self.before} → {self.after}"
        return before_after if self.kind == "part" else f"{self.name} {before_after}"


def changes(runs: Sequence[CostRun]) -> list[Change]:
    """Measure every effect and option in which alone some pair of runs differs, by kind, name and method."""
    usable = [run for run in runs if not run.error]
    pairs: dict[Key, list[Pair]] = {}
    for group in grouped(usable, lambda r: (r.method, r.scene, r.seed, r.length, r.rest, r.options)).values():
        for key, pair in _effect_pairs(group):
            pairs.setdefault(key, []).append(pair)
    for group in grouped(usable, lambda r: (r.base, r.scene, r.seed, r.length, r.rest, r.effects)).values():
        for key, pair in (*_part_pairs(group), *_option_pairs(group)):
            pairs.setdefault(key, []).append(pair)
    measured = [_change(key, of) for key, of in sorted(pairs.items(), key=lambda item: item[0])]
    shown = {run.method: run.shown or run.method for run in usable}
    measured = [replace(c, method=shown.get(c.method, c.method)) for c in measured]
    return sorted(measured, key=lambda c: (KINDS.index(c.kind), c.name, c.method))


def _effect_pairs(group: Sequence[CostRun]) -> Iterator[tuple[Key, Pair]]:
    for a, b in combinations(sorted(group, key=lambda r: len(r.effects)), 2):
        if a.effects < b.effects and len(b.effects - a.effects) == 1:
            (name,) = b.effects - a.effects
            yield ("effect", name, a.method, a.length.text, "", ""), (a, b)


def _part_pairs(group: Sequence[CostRun]) -> Iterator[tuple[Key, Pair]]:
    """Pair each variant of an ablation with the unchanged method or, without a run of it, the first one."""
    plain = [run for run in group if run.method == run.base]
    if len(plain) > 1:  # with several settings it is unclear which one a variant belongs to
        return
    variants = sorted(
        (r for r in group if r.method != r.base and "=" not in r.method), key=lambda r: r.method
    )
    for of_part in grouped(variants, lambda run: run.part.partition("-")[0]).values():
        host, *others = [*plain, *of_part]
        for run in others:
            key: Key = ("part", run.part, run.base, run.length.text, host.part or "as it is", run.part)
            yield key, (host, run)


def _option_pairs(group: Sequence[CostRun]) -> Iterator[tuple[Key, Pair]]:
    kinds: dict[str, Kind] = {"resolution": "resolution", "max_gaussians": "gaussians"}
    for a, b in combinations(group, 2):
        one, two = dict(a.options), dict(b.options)
        names = [k for k in one.keys() | two.keys() if one.get(k, ABSENT) != two.get(k, ABSENT)]
        # pairs with a variant of an ablation are those of `_part_pairs`
        if a.method == b.method and len(names) == 1:
            (name,) = names
            kind = kinds.get(name, "interval" if name.rpartition(".")[2].endswith("_every") else "option")
            (before, a), (after, b) = sorted(((_value(r, name), r) for r in (a, b)), key=lambda item: item[0])
            yield (kind, name, a.base, a.length.text, before, after), (a, b)


def _value(run: CostRun, option: str) -> str:
    return str(dict(run.options).get(option, ABSENT))


def _change(key: Key, pairs: list[Pair]) -> Change:
    kind, name, method, length, before, after = key
    ms = [b.speed * b.numbers["ms_per_iteration"] - a.speed * a.numbers["ms_per_iteration"] for a, b in pairs]
    if kind not in ("effect", "part") and np.mean(ms) < 0.0:  # the change is towards the slower value
        before, after, pairs, ms = after, before, [(b, a) for a, b in pairs], [-extra for extra in ms]
    db = _summary([b.psnr - a.psnr for a, b in pairs])
    low, high = _interval(pairs)
    without = stats.mean([a.train_s for a, _ in pairs]) / 60.0
    minutes = _summary([(b.train_s - a.train_s) / 60.0 for a, b in pairs])
    same_time = without > 0.0 and abs(minutes.mean / without) < SAME_TIME
    why = why_unranked([run for pair in pairs for run in pair])
    per_minute = db.mean / minutes.mean if minutes.mean > 0.0 and not same_time and not why else math.nan
    scenes = tuple(sorted({a.scene for a, _ in pairs}))
    return Change(
        kind, name, method, before, after, length, scenes, len(pairs), db, low, high, minutes, _summary(ms),
        per_minute, same_time, why,
    )  # fmt: skip


def _interval(pairs: Sequence[Pair]) -> tuple[float, float]:
    """Return the interval of the gain over test images, paired by image, after a mean over seeds."""
    images: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for a, b in pairs:
        for name, psnr in a.images.items():
            images.setdefault((a.scene, name), []).append((b.images[name], psnr))
    if not images:
        return math.nan, math.nan
    means = np.array([np.mean(both, axis=0) for both in images.values()])
    interval = stats.paired_interval(means[:, 0], means[:, 1])
    return interval.low, interval.high


def _summary(values: Sequence[float]) -> MeanAndDeviation:
    return MeanAndDeviation(stats.mean(values), stats.sample_std(values))
