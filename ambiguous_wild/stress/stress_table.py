"""Run and print the stress tests."""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterable, Sequence

from ambiguous_wild.core import AwError
from ambiguous_wild.stress import mask_cases, render_cases, training_cases
from ambiguous_wild.stress.case import REGISTERED, Case, StressLine, run

FILES = (render_cases, training_cases, mask_cases)  # each registers its cases when it is imported
CASES: tuple[Case, ...] = tuple(sorted(REGISTERED, key=lambda c: c.group))
HEAD = ("case", "device", "correct result", "worst error", "tolerance", "reason", "condition", "verdict")
WORDS = ("device", "correct result", "reason", "verdict")  # columns that hold text
HEADER = f"{'verdict':7} {'on':4}  {'error':>9} {'allowed':>9} {'condition':>9}  case"


def chosen(only: Sequence[str]) -> list[Case]:
    """Return the cases that match an entry: a group ("4"), a part of a key, or a pattern with * and ?.

    Raises:
        AwError: an entry matches no case.
    """
    if not only:
        return list(CASES)
    matching: dict[str, Case] = {}
    for wanted in only:
        if wanted.isdigit():
            hits = [c for c in CASES if c.group == int(wanted)]
        else:
            hits = [c for c in CASES if fnmatch.fnmatch(c.key, wanted) or wanted in c.key]
        if not hits:
            raise AwError(f"--only {wanted!r}: no such case; 'aw stress --list' shows them")
        matching |= {c.key: c for c in hits}
    return [c for c in CASES if c.key in matching]


def run_all(
    cases: Iterable[Case], devices: Sequence[str], each: Callable[[StressLine], None] | None = None
) -> list[StressLine]:
    """Run every case on every device it applies to."""
    outcomes = []
    for one in cases:
        for device in devices:
            if device in one.devices:
                outcomes.append(run(one, device))
                if each is not None:
                    each(outcomes[-1])
    return outcomes


def row(o: StressLine) -> tuple[str, ...]:
    """Return the cells of the outcome, in the columns of `HEAD`."""
    condition = "" if o.condition is None else f"{o.condition:.1e}"
    verdict = "passed" if o.passed else "FAILED"
    return (
        o.key, o.device, o.expected, _figure(o.error), _figure(o.tolerance), o.why, condition, verdict
    )  # fmt: skip


def to_line(o: StressLine) -> str:
    """Return one line for a terminal."""
    condition = "" if o.condition is None else f"{o.condition:8.1e}"
    verdict = "passed" if o.passed else "FAILED"
    text = (
        f"{verdict}  {o.device:4}  {_figure(o.error):>8}  {_figure(o.tolerance):>8}  {condition:>8}  {o.key}"
    )
    if not o.passed:
        text += f"\n        {o.failure or o.why}".rstrip()
    return text


def _figure(value: float) -> str:
    return "0" if value == 0 else f"{value:.1e}"
