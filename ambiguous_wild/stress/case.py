"""A hard case: what it measures, what it may be, and where that bound comes from."""

from __future__ import annotations

import math
import re
import traceback
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

from ambiguous_wild.core import AwError

UNIT = 2.0**-24  # relative rounding error of one float32 operation (Higham's u)


@dataclass(frozen=True)
class Measured:
    """What one case gave."""

    error: float  # worst relative error against float64, or the number of things that are wrong
    tolerance: float
    why: str  # where the tolerance comes from
    comes_out: str  # what the right answer is
    condition: float | None = None  # relative change of the result over that of the input; None = no meaning


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    row: int  # of docs/numerics.md
    name: str
    measure: Callable[[str], Measured]  # argument: the device
    devices: tuple[str, ...]  # where it says anything

    @property
    def key(self) -> str:
        return f"{self.row:02d}-{re.sub(r'[^a-z0-9.]+', '-', self.name.lower()).strip('-')}"


@dataclass(frozen=True)
class Outcome:
    """One line of `aw stress`."""

    key: str
    device: str
    error: float
    tolerance: float
    why: str
    comes_out: str
    condition: float | None
    passed: bool
    failure: str = ""  # of the case itself, where it raised

    def plain(self) -> dict[str, Any]:
        """For JSON, which has no NaN and no infinity: a figure that is none is missing."""
        missing = {k: None for k, v in asdict(self).items() if isinstance(v, float) and not math.isfinite(v)}
        return asdict(self) | missing


def case(
    row: int, name: str, *, devices: tuple[str, ...] = ("cpu",)
) -> Callable[[Callable[[str], Measured]], Case]:
    """Make a case of a function that measures; the module's other cases stand beside it."""
    return lambda measure: Case(row, name, measure, devices)


def run(chosen: Case, device: str) -> Outcome:
    """Measure; an exception is a failure of the case and not of the caller."""
    try:
        m = chosen.measure(device)
    except Exception as error:
        text = str(error) if isinstance(error, AwError) else traceback.format_exc(limit=-2)
        return Outcome(chosen.key, device, float("nan"), 0.0, "", "", None, False, text)
    passed = m.error <= m.tolerance  # NaN is on no side of it: that fails
    return Outcome(chosen.key, device, m.error, m.tolerance, m.why, m.comes_out, m.condition, bool(passed))


def wrong(checks: dict[str, bool], comes_out: str) -> Measured:
    """A case of yes and no: the error is how many of the checks do not hold; none may."""
    bad = [name for name, holds in checks.items() if not holds]
    why = "exact" + (f"; wrong: {', '.join(bad)}" if bad else f", {len(checks)} checks")
    return Measured(float(len(bad)), 0.0, why, comes_out)


def worst(parts: Iterable[Measured]) -> Measured:
    """The one of several that is furthest beyond, or least below, its tolerance."""

    def share(m: Measured) -> float:
        if m.error != m.error:
            return float("inf")
        return m.error / m.tolerance if m.tolerance > 0 else float("inf") if m.error > 0 else 0.0

    return max(parts, key=share)
