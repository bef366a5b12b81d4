"""Numbers that repeat more often than chance allows.

How often two numbers agree to the digit by chance depends on how densely they lie, which is measured: pairs
that are nearly equal (within `NEAR` units of the last digit) say how many exactly equal ones to expect.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from itertools import combinations

import numpy as np

from ambiguous_wild.harness.audit.finding import Finding, finding, method_name, place_name
from ambiguous_wild.harness.audit.table import MEAN, UNKNOWN, Number

NEAR, CLOSE = 25, 5  # units of the last digit; the narrower where numbers lie in heaps
ODDS = 0.005  # of an accident, over everything looked at; above it nothing is said
Key = tuple[str, ...]
Line = dict[Key, Number]


def repeated(numbers: list[Number]) -> list[Finding]:
    """Scenes and methods whose lines repeat, then single entries (all metrics of a method on a scene)."""
    plain = [n for n in numbers if n.known and n.scene != MEAN and "+" not in n.scene]
    by_scene = _lines(plain, lambda n: n.place, lambda n: (n.method, n.setting, n.metric))
    by_method = _lines(plain, lambda n: (n.method, n.setting), lambda n: (*n.place, n.metric))
    found, covered = [], set[frozenset[str]]()
    for lines, kind in ((by_scene, "scenes"), (by_method, "methods")):
        for pairs in _repeating(lines):
            involved = [n for pair in pairs for n in pair]
            covered |= {frozenset((a.where, b.where)) for a, b in pairs}
            found.append(finding("repeated", _words(kind, pairs), involved))
    # A mean stands in several tables: what repeats it is said once.
    said: dict[str, Finding] = {}
    for f in _entries(numbers, covered):
        said.setdefault(f.text, f)
    return found + list(said.values())


def _lines(
    numbers: list[Number], line: Callable[[Number], Key], cell: Callable[[Number], Key]
) -> dict[Key, Line]:
    lines: dict[Key, Line] = defaultdict(dict)
    for n in numbers:
        lines[line(n)].setdefault(cell(n), n)
    return lines


def _repeating(lines: dict[Key, Line]) -> Iterator[list[tuple[Number, Number]]]:
    """Pairs of lines that share too many numbers in the same cells; metric by metric."""
    from scipy.stats import poisson

    trials = []
    for (_, a), (_, b) in combinations(sorted(lines.items()), 2):
        shared: dict[str, list[tuple[Number, Number]]] = defaultdict(list)
        for cell in a.keys() & b.keys():
            shared[cell[-1]].append((a[cell], b[cell]))
        trials.append([sorted(pairs, key=lambda p: p[0].where) for _, pairs in sorted(shared.items())])
    tested = sum(map(len, trials))
    for metrics in trials:
        equal = []
        for pairs in metrics:
            same = [(a, b) for a, b in pairs if a.value == b.value]
            # Several methods at the same value (0.99 for all) are one coincidence, not several.
            distinct = len({a.value for a, _ in same})
            if distinct < 3:
                continue
            near, close = (
                sum(a.value != b.value and _near(a, b, w) for a, b in pairs) for w in (NEAR, CLOSE)
            )
            expected = max((near + 1) / (2 * NEAR), close / (2 * CLOSE))
            if poisson.sf(distinct - 1, expected) * tested < ODDS:
                equal += same
        if equal:
            yield equal


def _words(kind: str, pairs: list[tuple[Number, Number]]) -> str:
    a, b = pairs[0]
    metrics = ", ".join(dict.fromkeys(p[0].metric for p in pairs))
    if kind == "scenes":
        methods = ", ".join(dict.fromkeys(method_name(p[0]) for p in pairs))
        places = f"{place_name(a)} ({a.dataset}) and {place_name(b)} ({b.dataset})"
        return f"{places}: the same {metrics} for {methods}"
    scenes = ", ".join(dict.fromkeys(place_name(p[0]) for p in pairs))
    return f"{method_name(a)} and {method_name(b)}: the same {metrics} on {scenes}"


def _entries(numbers: list[Number], covered: set[frozenset[str]]) -> Iterator[Finding]:
    entries: dict[Key, dict[str, Number]] = defaultdict(dict)
    for n in numbers:
        entries[(n.table, *n.identity)].setdefault(n.metric, n)
    wide = [e for e in entries.values() if len(e) >= 2]
    # By how they are related: chance is rarer where fewer pairs are looked at.
    families: dict[str, list[tuple[dict[str, Number], dict[str, Number]]]] = defaultdict(list)
    for i, j in _near_pairs(wide):
        a, b = wide[i], wide[j]
        first, second = next(iter(a.values())), next(iter(b.values()))
        if not _may_be_one(first, second):
            related = first.method == second.method or (first.known and first.place == second.place)
            families["related" if related else "unrelated"].append((a, b))
    for pairs in families.values():
        equal = [(a, b) for a, b in pairs if _all(a, b, lambda x, y: x.value == y.value)]
        near = len(pairs) - len(equal)
        close = sum(_all(a, b, lambda x, y: _near(x, y, CLOSE)) for a, b in pairs) - len(equal)
        for a, b in equal:
            shared = sorted(a.keys() & b.keys())
            odds = max((near + 3) / (2 * NEAR + 1) ** len(shared), close / (2 * CLOSE + 1) ** len(shared))
            known = all(frozenset((a[m].where, b[m].where)) in covered for m in shared)
            if odds < ODDS and not known:
                yield _entry(a, b, shared)


def _near_pairs(entries: list[dict[str, Number]]) -> list[tuple[int, int]]:
    """Pairs that share three metrics or more and are near in all they share."""
    metrics = sorted({m for e in entries for m in e})
    value, unit = (np.full((len(entries), len(metrics)), np.nan) for _ in range(2))
    for i, e in enumerate(entries):
        for m, n in e.items():
            value[i, metrics.index(m)], unit[i, metrics.index(m)] = n.value, 2 * n.half
    pairs = []
    for i in range(len(entries) - 1):
        apart = np.abs(value[i + 1 :] - value[i])
        shared = ~np.isnan(apart)
        far = shared & (apart > NEAR * np.fmin(unit[i + 1 :], unit[i]) + 1e-12)
        hits = np.flatnonzero((shared.sum(axis=1) >= 3) & ~far.any(axis=1))
        pairs += [(i, i + 1 + int(j)) for j in hits]
    return pairs


def _entry(a: dict[str, Number], b: dict[str, Number], shared: list[str]) -> Finding:
    first, second = a[shared[0]], b[shared[0]]
    values = " / ".join(a[m].text for m in a if m in shared)
    left = f"{method_name(first)} on {place_name(first)}"
    right = f"{method_name(second)} on {place_name(second)}"
    return finding("repeated", f"{left} and {right}: the same {values}", [*_of(a, shared), *_of(b, shared)])


def _of(entry: dict[str, Number], metrics: Iterable[str]) -> list[Number]:
    return [entry[m] for m in metrics]


def _may_be_one(a: Number, b: Number) -> bool:
    """The same thing, as far as the tables say: then equality is as it should be."""
    if (a.method, a.setting) != (b.method, b.setting):
        return False
    return all(x == y or UNKNOWN in (x, y) for x, y in zip(a.place, b.place))


def _all(a: dict[str, Number], b: dict[str, Number], holds: Callable[[Number, Number], bool]) -> bool:
    return all(holds(a[m], b[m]) for m in a.keys() & b.keys())


def _near(a: Number, b: Number, units: int) -> bool:
    return abs(a.value - b.value) <= units * 10.0 ** -max(a.digits, b.digits) + 1e-12
