"""Audit reported numbers: contradictions, means, ranks, digits and units; write what `aw audit` finds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from itertools import combinations

import numpy as np

from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import plain
from ambiguous_wild.report import audit_numbers
from ambiguous_wild.report.audit_numbers import (
    ALL,
    KINDS,
    MEAN,
    UNKNOWN,
    AuditFinding,
    Pair,
    PrintedNumber,
    finding,
    method_name,
    place_name,
)
from ambiguous_wild.report.plain_formats import markdown_text, to_csv

LOWER = ("lpips", "flip", "memory", "gpu_hours", "train_s", "ms", "model_mb", "peak", "gaussians")
HIGHER = ("psnr", "ssim", "fps", "mask_", "iou")
UNITLESS = ("memory", "time", "size")  # metrics that need a unit and a definition
FULL = 12  # digits of a number that was never rounded, whose last ones may be zeros


def contradictions(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find different numbers, beyond rounding, for the same method, setting, scene and metric."""
    results = grouped((n for n in numbers if n.known), lambda n: (*n.identity, n.metric))
    clashes = [
        (a, b)
        for group in results.values()
        for a, b in combinations(group, 2)
        if (a.variant == b.variant or UNKNOWN in (a.variant, b.variant))
        and abs(a.value - b.value) > a.half + b.half + 1e-12
    ]
    by_entry = grouped(clashes, lambda pair: (*pair[0].identity, pair[0].table, pair[1].table)).values()
    exchanged = list(_exchanged([pair for pairs in by_entry for pair in pairs]))
    findings = [f for f, _ in exchanged]
    explained = {id(n) for _, of in exchanged for n in of}
    for pairs in by_entry:
        left = [(a, b) for a, b in pairs if id(a) not in explained]
        if left:
            a, b = left[0]
            words = ", ".join(f"{x.metric} {x.text} against {y.text}" for x, y in left)
            text = f"{method_name(a)} on {place_name(a)}: {words} ({a.table}, {b.table})"
            findings.append(finding("contradiction", text, [n for p in left for n in p]))
    return findings


def _exchanged(clashes: list[Pair]) -> Iterator[tuple[AuditFinding, tuple[PrintedNumber, ...]]]:
    """Yield findings of two methods whose numbers are exchanged between two tables, and these numbers."""
    for (a, a2), (b, b2) in combinations(clashes, 2):
        alike = (a.place, a.metric, a.table, a2.table) == (b.place, b.metric, b.table, b2.table)
        if alike and a.method != b.method and a.value == b2.value and b.value == a2.value:
            text = (
                f"{a.method} and {b.method} on {place_name(a)}: {a.metric} {a.text} and {b.text} in "
                f"{a.table} are exchanged in {a2.table}"
            )
            yield finding("swapped", text, (a, b, a2, b2)), (a, b, a2, b2)


def means(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find means over scenes, and over datasets, that differ from their parts by more than rounding."""
    wrong = []
    for n in numbers:
        if n.scene != MEAN or n.setting:
            continue
        parts = _of_datasets(n, numbers) if n.dataset == ALL else _of_scenes(n, numbers)
        value = float(np.mean([p.value for p in parts])) if len(parts) > 1 else n.value
        if abs(value - n.value) > n.half + max((p.half for p in parts), default=0.0) + 1e-9:
            wrong.append((n, value, parts))
    findings = []
    for cases in grouped(wrong, lambda case: (case[0].table, case[0].method, case[0].dataset)).values():
        first, _, parts = cases[0]
        what = "datasets" if first.dataset == ALL else f"scenes of {first.dataset}"
        words = ", ".join(
            f"{n.metric} {n.text}, but the parts give {value:.{n.digits + 1}f}" for n, value, _ in cases
        )
        text = f"{first.method}, mean over the {len(parts)} {what}: {words} ({first.table})"
        findings.append(finding("mean", text, [m for n, _, parts in cases for m in (n, *parts)]))
    return findings


def _of_datasets(mean: PrintedNumber, numbers: list[PrintedNumber]) -> list[PrintedNumber]:
    """Return the means over single datasets in the same line of the same table."""
    line = (mean.table, mean.method, mean.setting, mean.metric, MEAN)
    return [
        n for n in numbers if (n.table, n.method, n.setting, n.metric, n.scene) == line and n.dataset != ALL
    ]


def _of_scenes(mean: PrintedNumber, numbers: list[PrintedNumber]) -> list[PrintedNumber]:
    """Return the method's numbers on every scene of the dataset; empty if one is missing."""
    of_dataset = [
        n
        for n in numbers
        if n.dataset == mean.dataset
        and n.metric == mean.metric
        and not n.setting
        and n.scene not in (MEAN, UNKNOWN, ALL)
        and "+" not in n.scene
    ]
    inside = [n for n in of_dataset if n.table == mean.table]
    of_dataset = inside or of_dataset
    size = Counter(n.table for n in of_dataset)
    best: dict[str, PrintedNumber] = {}
    for n in of_dataset:
        # an ablation repeats one scene of the main table; means come from the larger table
        if n.method == mean.method and (n.scene not in best or size[n.table] > size[best[n.scene].table]):
            best[n.scene] = n
    scenes = {n.scene for n in of_dataset}
    return [best[s] for s in sorted(scenes)] if scenes == best.keys() else []


def ranks(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find marks for first, second and third that contradict the numbers of the column."""
    findings = []
    columns = grouped((n for n in numbers if not n.setting), lambda n: (n.table, *n.place, n.metric))
    for column in columns.values():
        metric = column[0].metric
        better = 1 if metric.startswith(HIGHER) else -1 if metric.startswith(LOWER) else 0
        wrong = [n for n in column if n.mark and better and n.mark not in _places(n, column, better)]
        if wrong:
            order = sorted(column, key=lambda n: -better * n.value)
            right = ", ".join(f"{i} {n.method} {n.text}" for i, n in enumerate(order[:3], start=1))
            marks = ", ".join(f"{n.method} {n.text} as {n.mark}" for n in wrong)
            text = f"{metric} on {place_name(column[0])}: marks {marks}, but the order is {right}"
            findings.append(finding("rank", text, wrong))
    return findings


def _places(n: PrintedNumber, column: list[PrintedNumber], better: int) -> range:
    """Return the ranks that a number may be marked as; equal numbers may share a rank or take several."""
    ahead = {m.value for m in column if better * (m.value - n.value) > 0}
    before = sum(better * (m.value - n.value) > 0 for m in column)
    return range(1 + len(ahead), 1 + before + sum(m.value == n.value for m in column))


def digits(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find quality metrics printed with another number of digits than most of their column."""
    quality = (n for n in numbers if n.metric.startswith(("psnr", "ssim", "lpips")))
    findings = []
    for (table, metric), column in grouped(quality, lambda n: (n.table, n.metric)).items():
        usual, count = Counter(n.digits for n in column).most_common(1)[0]
        odd = [n for n in column if n.digits != usual]
        if odd and usual < FULL and count >= 0.8 * len(column):
            words = ", ".join(f"{n.method} on {place_name(n)} {n.text}" for n in odd)
            findings.append(finding("digits", f"{metric} has {usual} digits in {table}, but {words}", odd))
    return findings


def units(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Find quantities without a unit, one finding for each metric."""
    bare = (n for n in numbers if n.metric in UNITLESS and n.variant == UNKNOWN)
    findings = []
    for metric, of in sorted(grouped(bare, lambda n: n.metric).items()):
        tables = ", ".join(dict.fromkeys(n.table for n in of))
        text = f"{len(of)} values of {metric} have neither unit nor definition ({tables})"
        findings.append(finding("unit", text, of))
    return findings


CHECKS = (
    audit_numbers.repeated, contradictions, audit_numbers.exchanged, means,
    audit_numbers.out_of_place, audit_numbers.unlike, ranks, digits, units,
)  # fmt: skip


def audit(numbers: list[PrintedNumber]) -> list[AuditFinding]:
    """Run all checks; return the findings by kind. The same numbers give the same findings."""
    findings = [f for check in CHECKS for f in check(numbers)]
    order = list(KINDS)
    return sorted(findings, key=lambda f: order.index(f.kind))


def text_of(findings: list[AuditFinding]) -> str:
    """Return the findings by kind, as text for a terminal."""
    lines = []
    for kind, of in grouped(findings, lambda f: f.kind).items():
        lines += [f"{kind}: {KINDS[kind]} ({len(of)})", *(f"  {plain(f.text)}" for f in of), ""]
    return "\n".join(lines)


def markdown_of(findings: list[AuditFinding]) -> str:
    """Return the findings by kind, as Markdown lists."""
    lines = []
    for kind, of in grouped(findings, lambda f: f.kind).items():
        lines += [f"**{kind}** ({KINDS[kind]}):", "", *(f"- {markdown_text(f.text)}" for f in of), ""]
    return "\n".join(lines)


def csv_of(findings: list[AuditFinding]) -> str:
    """Return the findings as CSV, one per row."""
    rows = ((f.kind, f.text, "; ".join(f.tables), "; ".join(f.where)) for f in findings)
    return to_csv(("kind", "finding", "tables", "where"), rows)
