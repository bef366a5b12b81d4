"""All checks, in order, and their findings as text, CSV and JSON."""

from __future__ import annotations

from ambiguous_wild.harness.audit import place, repeats, values
from ambiguous_wild.harness.audit.finding import KINDS, Finding
from ambiguous_wild.harness.audit.table import Number
from ambiguous_wild.harness.tables.plain_formats import markdown_text, plain, to_csv

CHECKS = (
    repeats.repeated, values.contradictions, place.exchanged, values.means,
    place.out_of_place, place.unlike, values.ranks, values.digits, values.units,
)  # fmt: skip


def audit(numbers: list[Number]) -> list[Finding]:
    """Everything that cannot be right, by kind; the same numbers give the same findings."""
    found = [f for check in CHECKS for f in check(numbers)]
    order = list(KINDS)
    return sorted(found, key=lambda f: order.index(f.kind))


def text_of(findings: list[Finding]) -> str:
    """Grouped by kind, for a terminal."""
    lines = []
    for kind, meaning in KINDS.items():
        of_kind = [f for f in findings if f.kind == kind]
        if of_kind:
            lines += [f"{kind}: {meaning} ({len(of_kind)})", *(f"  {plain(f.text)}" for f in of_kind), ""]
    return "\n".join(lines)


def markdown_of(findings: list[Finding]) -> str:
    """A list by kind."""
    lines = []
    for kind, meaning in KINDS.items():
        of_kind = [f for f in findings if f.kind == kind]
        if of_kind:
            lines += [f"**{kind}** ({meaning}):", "", *(f"- {markdown_text(f.text)}" for f in of_kind), ""]
    return "\n".join(lines)


def csv_of(findings: list[Finding]) -> str:
    """One finding a row."""
    rows = ((f.kind, f.text, "; ".join(f.tables), "; ".join(f.where)) for f in findings)
    return to_csv(("kind", "finding", "tables", "where"), rows)
