"""What an audit finds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from ambiguous_wild.harness.audit.table import Number

# kind -> what it means, in the order they are listed
KINDS = {
    "repeated": "numbers equal to the digit where they must not be",
    "contradiction": "the same thing with another number elsewhere",
    "swapped": "numbers or columns that look exchanged",
    "mean": "a mean that does not follow from what it is the mean of",
    "out of place": "a number its metric, or its neighbours, do not allow",
    "rank": "a marked rank that the numbers do not give",
    "digits": "another number of digits than the rest of its column",
    "unit": "it is not said what was counted",
}


@dataclass(frozen=True)
class Finding:
    kind: str  # of `KINDS`
    text: str  # one line
    tables: tuple[str, ...]
    where: tuple[str, ...]  # file:line of every number involved


def finding(kind: str, text: str, numbers: Iterable[Number]) -> Finding:
    """A finding about these numbers."""
    involved = list(numbers)
    return Finding(
        kind,
        text,
        tuple(dict.fromkeys(n.table for n in involved)),
        tuple(dict.fromkeys(n.where for n in involved)),
    )


def place_name(number: Number) -> str:
    """Where it was measured, for people."""
    if number.scene == "mean":
        return f"the mean of {number.dataset}"
    if number.scene == "all":
        return f"all of {number.dataset}"
    return number.scene if number.scene != "unknown" else "a scene not named"


def method_name(number: Number) -> str:
    return f"{number.method} ({number.setting})" if number.setting else number.method
