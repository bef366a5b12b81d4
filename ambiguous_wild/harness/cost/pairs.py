"""Gain and cost of one effect or option, from pairs of runs that differ in nothing else.

Both runs of a pair have the same method, scene, seed, length, device and code. Where the length is a
budget, both trained equally long: what the effect costs is in its dB already, and dB a minute has no meaning.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from ambiguous_wild.harness.cost.curves import Summary
from ambiguous_wild.harness.cost.read import CostRun, why_unranked
from ambiguous_wild.metrics import stats

SAME_TIME = 0.01  # of the training: a smaller difference in minutes is no difference
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
    db: Summary  # gained; over pairs
    low: float  # 95 % bootstrap interval of the gain, over the test images of all pairs
    high: float
    minutes: Summary  # of training, more than without; over pairs
    ms: Summary  # an iteration, more than without
    share: float  # extra minutes over the training without
    unranked: str = ""  # why the minutes cannot be trusted; empty where they can

    @property
    def what(self) -> str:
        """The change in words."""
        if self.kind == "effect":
            return self.name
        before_after = f"{self.before} → {self.after}"
        return before_after if self.kind == "part" else f"{self.name} {before_after}"

    @property
    def per_minute(self) -> float:
        """dB an extra minute; NaN where it takes no longer, or a run was not alone."""
        if not self.minutes.mean > 0.0 or self.same_time or self.unranked:
            return math.nan
        return self.db.mean / self.minutes.mean

    @property
    def same_time(self) -> bool:
        return abs(self.share) < SAME_TIME


def changes(runs: Sequence[CostRun]) -> list[Change]:
    """Every effect and option that some pair of runs isolates, by kind, name and method."""
    usable = [run for run in runs if not run.error]
    found = [_change("effect", key, pairs) for key, pairs in sorted(_effect_pairs(usable).items())]
    found += [_change("part", key, pairs) for key, pairs in sorted(_part_pairs(usable).items())]
    for key, pairs in sorted(_option_pairs(usable).items()):
        found.append(_change(_kind(key[0]), key, _costlier_second(pairs)))
    return sorted(found, key=lambda c: (KINDS.index(c.kind), c.name, c.method))


def _kind(option: str) -> Kind:
    if option == "resolution":
        return "resolution"
    if option == "max_gaussians":
        return "gaussians"
    return "interval" if option.rpartition(".")[2].endswith("_every") else "option"


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
    """Each variant of an ablation against the method as it is; where that was not run, the first variant."""
    pairs: dict[Key, Pairs] = {}
    for group in _groups(runs, lambda r: (r.base, r.scene, r.seed, r.length, r.rest, r.effects)):
        plain = [run for run in group if run.method == run.base]
        variants = sorted((run for run in group if run.method != run.base and "=" not in run.method),
                          key=lambda run: run.method)  # fmt: skip
        if len(plain) > 1:  # several settings of it: not clear which one a variant belongs to
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
    """The pairs turned so that the second run is the one that takes longer, on average."""
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
    """Of the gain, over the test images: the same pictures with and without, seeds averaged before."""
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


def _summary(values: Sequence[float]) -> Summary:
    return Summary(stats.mean(values), stats.spread(values))
