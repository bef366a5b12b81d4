"""A stress test: a measured error, its tolerance, and the reason for the tolerance."""

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
    """The result of one case."""

    error: float  # worst relative error against float64, or the number of failed checks
    tolerance: float
    why: str  # reason for the tolerance
    comes_out: str  # the correct result
    condition: float | None = None  # condition number: relative change of the result over that of the input


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    row: int  # of docs/numerics.md
    name: str
    measure: Callable[[str], Measured]  # argument: the device
    devices: tuple[str, ...]  # that the case applies to

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
    failure: str = ""  # the error, if the case raised one

    def plain(self) -> dict[str, Any]:
        """Plain data for JSON: NaN and infinity become null."""
        missing = {k: None for k, v in asdict(self).items() if isinstance(v, float) and not math.isfinite(v)}
        return asdict(self) | missing


def case(
    row: int, name: str, *, devices: tuple[str, ...] = ("cpu",)
) -> Callable[[Callable[[str], Measured]], Case]:
    """Decorator that makes a case of a measuring function."""
    return lambda measure: Case(row, name, measure, devices)


def run(chosen: Case, device: str) -> Outcome:
    """Measure a case; an exception counts as its failure."""
    try:
        m = chosen.measure(device)
    except Exception as error:
        text = str(error) if isinstance(error, AwError) else traceback.format_exc(limit=-2)
        return Outcome(chosen.key, device, float("nan"), 0.0, "", "", None, False, text)
    passed = m.error <= m.tolerance  # false for NaN
    return Outcome(chosen.key, device, m.error, m.tolerance, m.why, m.comes_out, m.condition, bool(passed))


def failed_checks(checks: dict[str, bool], comes_out: str) -> Measured:
    """A case of exact checks: the error is the number of checks that fail; the tolerance is 0."""
    bad = [name for name, holds in checks.items() if not holds]
    why = "exact" + (f"; wrong: {', '.join(bad)}" if bad else f", {len(checks)} checks")
    return Measured(float(len(bad)), 0.0, why, comes_out)


def worst(parts: Iterable[Measured]) -> Measured:
    """The result with the largest ratio of error to tolerance."""

    def share(m: Measured) -> float:
        if m.error != m.error:
            return float("inf")
        return m.error / m.tolerance if m.tolerance > 0 else float("inf") if m.error > 0 else 0.0

    return max(parts, key=share)
