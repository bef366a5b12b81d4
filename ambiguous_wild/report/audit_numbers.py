"""Read tables of reported numbers, and find unlikely ones: repeated, impossible, exchanged or out of line.

A table is a CSV file with one number per line. How often two numbers agree to the digit by chance depends on
how densely they lie. This is measured: pairs that are nearly equal (within `NEAR` units of the last digit)
give the expected number of exactly equal ones.
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.report.plain_formats import read_csv

REQUIRED = ("method", "scene", "metric", "value")
OPTIONAL = ("table", "setting", "options", "seed", "dataset", "variant", "mark", "printed")
UNKNOWN = "unknown"
MEAN, ALL = "mean", "all"  # in place of a scene: the mean over scenes; in place of a dataset: over datasets
LARGEST = 50_000_000  # bytes
REPORTED = Path(__file__).parent / "reported"  # the RefineSplat paper's tables, see docs/tables.md
# kind -> its meaning, in the order of the report
KINDS = {
    "repeated": "different results with equal digits",
    "contradiction": "another number for the same result in another place",
    "swapped": "numbers or columns that look exchanged",
    "mean": "a mean that differs from the mean of its parts",
    "out of place": "a number outside the range of its metric or of its neighbours",
    "rank": "a marked rank that contradicts the numbers",
    "digits": "another number of digits than in the rest of the column",
    "unit": "the unit, or what was counted, is not given",
}
SIZE = "model_mb"  # follows from the number of Gaussians, which many runs let grow to the same limit
NEAR, CLOSE = 25, 5  # units of the last digit; CLOSE is for numbers that lie in clusters
ODDS = 0.005  # largest probability of a coincidence, over all comparisons, at which something is reported
# metric family -> smallest and largest value; LPIPS has no upper limit, but no right value was above 1.5
LIMITS = {"psnr": (2.0, 100.0), "ssim": (-1.0, 1.0), "lpips": (0.0, 1.5)}
MARGIN = 0.5  # of the others' range: a value within this distance is not unusual
OTHERS = 4  # other methods that a scene needs, before one is compared with them
CLEARLY = 3.0  # an exchange must bring values this many times nearer to the others
FAR = 8.0  # robust deviations of a residual; in normal noise once in 10^15
USUAL = 4.0  # robust deviations that the other two metrics may have
FINEST = 0.0125  # smallest robust deviation that is used
SMALLEST = 4  # methods and scenes that a table needs for a fit


@dataclass(frozen=True)
class PrintedNumber:
    """One number as printed."""

    table: str  # name of the table
    method: str
    setting: str  # the difference from the published method; empty: none
    dataset: str
    scene: str  # MEAN for a mean over the dataset's scenes, UNKNOWN if the table does not say
    metric: str
    variant: str  # variant or unit of the metric; UNKNOWN if the table does not say
    value: float
    digits: int  # after the decimal point
    mark: int | None  # rank that the table gives it: 1, 2, 3
    where: str  # file and line

    @property
    def identity(self) -> tuple[str, str, str, str]:
        return (self.method, self.setting, self.dataset, self.scene)

    @property
    def place(self) -> tuple[str, str]:
        return (self.dataset, self.scene)

    @property
    def half(self) -> float:
        """Half a unit of the last printed digit: the rounding error."""
        return 0.5 * 10.0**-self.digits

    @property
    def text(self) -> str:
        return f"{self.value:.{self.digits}f}"

    @property
    def family(self) -> str:
        """The metric without its variant."""
        return self.metric.partition("_")[0]

    @property
    def known(self) -> bool:
        """True if the table says on what it was measured."""
        return UNKNOWN not in self.place


def read_tables(paths: Sequence[Path]) -> list[PrintedNumber]:
    """Read CSV files, or all *.csv in a folder; rows without a value are left out.

    Raises:
        AwError: there is no file, or one is unreadable, lacks a column or has an invalid number.
    """
    files: list[Path] = []
    for path in paths:
        inside = sorted(path.glob("*.csv")) if path.is_dir() else [path]
        if not inside:
            raise AwError(f"no *.csv in {path}: give tables as docs/tables.md describes them")
        files += inside
    numbers = [n for path in dict.fromkeys(files) for n in _read(path)]
    if not numbers:
        raise AwError(f"no number in {shortlist(map(str, files))}: nothing to audit")
    return numbers


def _read(path: Path) -> list[PrintedNumber]:
    advice = f"a table of results has {', '.join(REQUIRED)} and may have {', '.join(OPTIONAL)}"
    rows = read_csv(path, REQUIRED, LARGEST, advice)[1]
    return [n for line, row in rows if (n := _number(path, line, row)) is not None]


def _number(path: Path, line: int, row: dict[str, str]) -> PrintedNumber | None:
    where = f"{path.name}:{line}"
    cell = {k: row.get(k, "").strip() for k in (*REQUIRED, *OPTIONAL)}
    if not cell["value"]:
        return None
    for column in ("method", "scene", "metric"):
        if not cell[column]:
            raise AwError(f"{path} line {line} has no {column}")
    if not re.fullmatch(r"-?\d+(\.\d+)?([eE][+-]?\d+)?", cell["value"]) or math.isinf(float(cell["value"])):
        raise AwError(
            f"{path} line {line}: {cell['value'][:40]!a} is no number; leave the cell empty for none"
        )
    if cell["mark"] not in ("", "1", "2", "3"):
        raise AwError(f"{path} line {line}: mark {cell['mark'][:40]!a} is none of 1, 2, 3")
    return PrintedNumber(
        cell["table"] or path.stem,
        cell["method"],
        ", ".join(
            filter(None, (cell["setting"], *(f"{k} {cell[k]}" for k in ("options", "seed") if cell[k])))
        ),
        cell["dataset"] or UNKNOWN if "dataset" in row else path.stem,
        cell["scene"],
        cell["metric"],
        cell["variant"] or UNKNOWN,
        float(cell["value"]),
        6 if "e" in cell["value"].lower() else len(cell["value"].partition(".")[2]),
        int(cell["mark"]) if cell["mark"] else None,
        where,
    )


@dataclass(frozen=True)
class AuditFinding:
    """Something that is unlikely or wrong in reported numbers."""

    kind: str  # a key of `KINDS`
    text: str  # one line
    tables: tuple[str, ...]
    where: tuple[str, ...]  # file:line of every number involved


def finding(kind: str, text: str, numbers: Iterable[PrintedNumber]) -> AuditFinding:
    """Make a finding about these numbers."""
    involved = list(numbers)
    return AuditFinding(
        kind,
        text,
        tuple(dict.fromkeys(n.table for n in involved)),
        tuple(dict.fromkeys(n.where for n in involved)),
    )


def place_name(number: PrintedNumber) -> str:
    """Return where the number was measured, as text."""
    if number.scene == "mean":
        return f"the mean of {number.dataset}"
    if number.scene == "all":
        return f"all of {number.dataset}"
    return number.scene if number.scene != "unknown" else "a scene not named"


def method_name(number: PrintedNumber) -> str:
    return f"{number.method} ({number.setting})" if number.setting else number.method


Key = tuple[str, ...]
Line = dict[Key, PrintedNumber]
Entry = dict[str, PrintedNumber]  # by metric, or by its family
Pair = tuple[PrintedNumber, PrintedNumber]


def repeated(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find scenes and methods whose lines repeat, then entries (all metrics of a method on a scene)."""
    plain = [n for n in numbers if n.known and n.scene != MEAN and "+" not in n.scene and n.metric != SIZE]
    by_scene: dict[Key, Line] = defaultdict(dict)
    by_method: dict[Key, Line] = defaultdict(dict)
    for n in plain:
        by_scene[n.place].setdefault((n.method, n.setting, n.metric), n)
        by_method[n.method, n.setting].setdefault((*n.place, n.metric), n)
    findings, covered = [], set[frozenset[str]]()
    for lines, kind in ((by_scene, "scenes"), (by_method, "methods")):
        for pairs in _repeating(lines):
            involved = [n for pair in pairs for n in pair]
            covered |= {frozenset((a.where, b.where)) for a, b in pairs}
            findings.append(finding("repeated", _words(kind, pairs), involved))
    # a mean is printed in several tables, but its repetition is reported once
    entries = grouped(_entries(numbers, covered), lambda f: f.text)
    return findings + [of[0] for of in entries.values()]


def _repeating(lines: dict[Key, Line]) -> Iterator[list[Pair]]:
    """Yield pairs of numbers of two lines that share too many, compared metric by metric."""
    from scipy.special import pdtrc  # scipy.stats takes 0.5 s to import

    trials = []
    for (_, a), (_, b) in combinations(sorted(lines.items()), 2):
        shared = grouped(((a[cell], b[cell]) for cell in a.keys() & b.keys()), lambda pair: pair[0].metric)
        trials.append([sorted(pairs, key=lambda p: p[0].where) for _, pairs in sorted(shared.items())])
    tested = sum(map(len, trials))
    for metrics in trials:
        equal = []
        for pairs in metrics:
            same = [(a, b) for a, b in pairs if a.value == b.value]
            # several methods with the same value (0.99 for all) are a single coincidence
            distinct = len({a.value for a, _ in same})
            if distinct < 3:
                continue
            near, close = (
                sum(a.value != b.value and _near(a, b, w) for a, b in pairs) for w in (NEAR, CLOSE)
            )
            expected = max((near + 1) / (2 * NEAR), close / (2 * CLOSE))
            if pdtrc(distinct - 1, expected) * tested < ODDS:
                equal += same
        if equal:
            yield equal


def _words(kind: str, pairs: list[Pair]) -> str:
    a, b = pairs[0]
    metrics = ", ".join(dict.fromkeys(p[0].metric for p in pairs))
    if kind == "scenes":
        methods = ", ".join(dict.fromkeys(method_name(p[0]) for p in pairs))
        places = f"{place_name(a)} ({a.dataset}) and {place_name(b)} ({b.dataset})"
        return f"{places}: the same {metrics} for {methods}"
    scenes = ", ".join(dict.fromkeys(place_name(p[0]) for p in pairs))
    return f"{method_name(a)} and {method_name(b)}: the same {metrics} on {scenes}"


def _entries(numbers: list[PrintedNumber], covered: set[frozenset[str]]) -> Iterator[AuditFinding]:
    entries: dict[Key, Entry] = defaultdict(dict)
    for n in numbers:
        entries[(n.table, *n.identity)].setdefault(n.metric, n)
    wide = [e for e in entries.values() if len(e) >= 2]
    # related pairs are tested apart, because a coincidence is less likely among fewer pairs
    families: dict[bool, list[tuple[Entry, Entry]]] = defaultdict(list)
    for i, j in _near_pairs(wide):
        a, b = wide[i], wide[j]
        first, second = next(iter(a.values())), next(iter(b.values()))
        if not _may_be_one(first, second):
            related = first.method == second.method or (first.known and first.place == second.place)
            families[related].append((a, b))
    for pairs in families.values():
        equal = [(a, b) for a, b in pairs if all(a[m].value == b[m].value for m in a.keys() & b.keys())]
        near = len(pairs) - len(equal)
        close = sum(all(_near(a[m], b[m], CLOSE) for m in a.keys() & b.keys()) for a, b in pairs) - len(equal)
        for a, b in equal:
            shared = sorted(a.keys() & b.keys())
            odds = max((near + 3) / (2 * NEAR + 1) ** len(shared), close / (2 * CLOSE + 1) ** len(shared))
            reported = all(frozenset((a[m].where, b[m].where)) in covered for m in shared)
            if odds < ODDS and not reported:
                yield _entry(a, b, shared)


def _near_pairs(entries: list[Entry]) -> list[tuple[int, int]]:
    """Return pairs of entries that share three metrics or more and are near in all of them."""
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


def _entry(a: Entry, b: Entry, shared: list[str]) -> AuditFinding:
    first, second = a[shared[0]], b[shared[0]]
    values = " / ".join(a[m].text for m in a if m in shared)
    left = f"{method_name(first)} on {place_name(first)}"
    right = f"{method_name(second)} on {place_name(second)}"
    return finding(
        "repeated", f"{left} and {right}: the same {values}", [entry[m] for entry in (a, b) for m in shared]
    )


def _may_be_one(a: PrintedNumber, b: PrintedNumber) -> bool:
    """Return whether both may be the same result, as far as the tables say; then equality is expected."""
    if (a.method, a.setting) != (b.method, b.setting):
        return False
    return all(x == y or UNKNOWN in (x, y) for x, y in zip(a.place, b.place))


def _near(a: PrintedNumber, b: PrintedNumber, units: int) -> bool:
    return abs(a.value - b.value) <= units * 10.0 ** -max(a.digits, b.digits) + 1e-12


Scenes = dict[tuple[str, str, str], dict[str, Entry]]  # (table, dataset, scene) -> method -> entry


def out_of_place(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find values outside the range of the metric."""
    findings = []
    for n in numbers:
        low, high = LIMITS.get(n.family, (-np.inf, np.inf))
        if not low <= n.value <= high:
            text = f"{n.method} on {place_name(n)}: {n.metric} {n.text} is impossible ({low:g} to {high:g})"
            findings.append(finding("out of place", text, [n]))
    return findings


def exchanged(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find exchanges of SSIM and LPIPS, for one method or for a whole scene of a table."""
    scenes = _scenes(numbers)
    columns = list(_columns(scenes))
    done = {n for f in columns for n in f.where}
    return columns + [f for place in scenes for f in _cells(scenes, place) if f.where[0] not in done]


def _cells(scenes: Scenes, place: tuple[str, str, str]) -> Iterator[AuditFinding]:
    entries = scenes[place]
    for method, entry in entries.items():
        if _unusual(scenes, place, method) is False:
            continue  # the method has similar values on other scenes: it is weak, not exchanged
        others = [e for m, e in entries.items() if m != method]
        if len(others) < OTHERS:
            continue
        psnr, ssim, lpips = (np.array([e[f].value for e in others]) for f in ("psnr", "ssim", "lpips"))
        s, d = entry["ssim"].value, entry["lpips"].value
        usual = float(np.median(ssim)), float(np.median(lpips))
        printed = abs(s - usual[0]) + abs(d - usual[1])
        turned = abs(d - usual[0]) + abs(s - usual[1])
        among = _among(s, ssim) or _among(d, lpips)
        # a method that failed on this scene has a bad PSNR too; then both may be unusual
        worst = psnr.min() - MARGIN * (psnr.max() - psnr.min())
        if not among and CLEARLY * turned < printed and entry["psnr"].value >= worst:
            text = (
                f"{method} on {place_name(entry['ssim'])}: SSIM {entry['ssim'].text} and LPIPS "
                f"{entry['lpips'].text} look exchanged (others: SSIM {ssim.min():g} to {ssim.max():g}, LPIPS "
                f"{lpips.min():g} to {lpips.max():g})"
            )
            yield finding("swapped", text, (entry["ssim"], entry["lpips"]))


def _unusual(scenes: Scenes, place: tuple[str, str, str], method: str) -> bool | None:
    """Return whether SSIM and LPIPS, exchanged, fit the method's other scenes better; None without any."""
    rest = [e[method] for p, e in scenes.items() if p != place and method in e]
    if not rest:
        return None
    ssim, lpips = (float(np.median([e[f].value for e in rest])) for f in ("ssim", "lpips"))
    s, d = (scenes[place][method][f].value for f in ("ssim", "lpips"))
    return abs(s - ssim) + abs(d - lpips) > abs(d - ssim) + abs(s - lpips)


def _columns(scenes: Scenes) -> Iterator[AuditFinding]:
    for place, entries in scenes.items():
        if len(entries) < OTHERS:
            continue
        votes = [v for m in entries if (v := _unusual(scenes, place, m)) is not None]
        if len(votes) < OTHERS or not all(votes):
            continue
        from scipy.stats import spearmanr  # seldom reached, and it takes 0.5 s to import

        psnr, ssim, lpips = ([e[f].value for e in entries.values()] for f in ("psnr", "ssim", "lpips"))
        if len(set(psnr)) > 1 and spearmanr(psnr, ssim)[0] < spearmanr(psnr, lpips)[0]:
            involved = [e[f] for e in entries.values() for f in ("ssim", "lpips")]
            text = f"SSIM and LPIPS of {place_name(involved[0])} in {place[0]} look exchanged for all methods"
            yield finding("swapped", text, involved)


def unlike(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find SSIM or LPIPS far from the value predicted from method and scene, while the other metrics are not.

    A method that failed on a scene is bad in all three metrics, which is no misprint.
    """
    reported = {n for f in exchanged(numbers) for n in f.where}
    grids: dict[str, dict[tuple[str, str], Entry]] = defaultdict(dict)
    for (_, dataset, scene), entries in _scenes(numbers).items():
        for method, entry in entries.items():
            grids[dataset].setdefault((method, scene), entry)
    findings = []
    for grid in grids.values():
        rests = {family: _residuals(grid, family) for family in LIMITS}
        for key, entry in grid.items():
            far = {family: abs(rest[key][0]) for family, rest in rests.items() if key in rest}
            for family in ("ssim", "lpips"):
                others = [v for f, v in far.items() if f != family]
                n = entry[family]
                if far and far[family] > FAR and max(others) < USUAL and n.where not in reported:
                    fits = rests[family][key][1]
                    text = f"{n.method} on {place_name(n)}: {family.upper()} {n.text}, {fits:.2f} would fit"
                    findings.append(finding("out of place", text, [n]))
    return findings


def _residuals(grid: dict[tuple[str, str], Entry], family: str) -> dict[tuple[str, str], tuple[float, float]]:
    """Return (residual in robust deviations, expected value) by method and scene; empty for a small table."""
    methods, scenes = (sorted({key[i] for key in grid}) for i in (0, 1))
    table = np.full((len(methods), len(scenes)), np.nan)
    for (method, scene), entry in grid.items():
        table[methods.index(method), scenes.index(scene)] = entry[family].value
    if min(table.shape) < SMALLEST or np.isnan(table).mean() > 0.5:
        return {}
    fit = np.zeros_like(table)
    for _ in range(10):  # Tukey's median polish
        fit += np.nanmedian(table - fit, axis=1, keepdims=True)
        fit += np.nanmedian(table - fit, axis=0, keepdims=True)
    rest = table - fit
    # The mean, not the median, as many residuals of a polished table are zero by construction. The largest
    # is left out, because it would raise the limit that it is compared with.
    spread = 1.2533 * np.mean(np.sort(np.abs(rest[~np.isnan(rest)]))[:-1])
    # The fit uses the degrees of freedom of a row and a column. Numbers with three digits allow no less.
    typical = max(spread * np.sqrt(table.size / ((len(methods) - 1) * (len(scenes) - 1))), FINEST)
    return {
        (m, s): (float(rest[i, j] / typical), float(fit[i, j]))
        for i, m in enumerate(methods)
        for j, s in enumerate(scenes)
        if not np.isnan(rest[i, j])
    }


def _scenes(numbers: list[PrintedNumber]) -> Scenes:
    """Return PSNR, SSIM and LPIPS of every method on every scene that has all three."""
    scenes: dict[tuple[str, str, str], dict[str, Entry]] = defaultdict(lambda: defaultdict(dict))
    for n in numbers:
        if n.known and not n.setting and n.family in LIMITS:
            scenes[n.table, n.dataset, n.scene][n.method].setdefault(n.family, n)
    return {k: {m: e for m, e in v.items() if len(e) == len(LIMITS)} for k, v in scenes.items()}


def _among(value: float, others: np.ndarray) -> bool:
    low, high = others.min(), others.max()
    return bool(low - MARGIN * (high - low) <= value <= high + MARGIN * (high - low))
