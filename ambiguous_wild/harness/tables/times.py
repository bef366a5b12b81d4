"""Which times of a comparison may be ranked, and the lines that say why others may not."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.harness.measures import Measure

REFERENCE = "reference_s"  # compares machines; other times compare runs of one machine


def untimed(frame: pd.DataFrame) -> dict[tuple[str, str], str]:
    """(method, scene) -> why its times are not ranked: one of its runs was not alone, or not calibrated.

    Args:
        frame: `Runs.runs`.
    """
    done = frame[frame["status"] == "ok"]
    found: dict[tuple[str, str], str] = {}
    for row in done[done["timing"] != "alone"].itertuples():
        found.setdefault((str(row.method), str(row.scene)), f"{row.timing}: {row.timing_reason}")
    return found


def incomparable(frame: pd.DataFrame, columns: Sequence[Measure]) -> frozenset[str]:
    """Keys of timed columns whose values come from machines, or calibrations, that differ."""
    alone = frame[(frame["status"] == "ok") & (frame["timing"] == "alone")]
    differ = {
        REFERENCE: alone["timing_kernel"].nunique() > 1,
        "": alone["hardware"].nunique() > 1,
    }
    return frozenset(c.key for c in columns if c.timed and differ[REFERENCE if c.key == REFERENCE else ""])


def time_notes(frame: pd.DataFrame, columns: Sequence[Measure]) -> list[str]:
    """One line a reason for times that are not ranked."""
    if not any(c.timed for c in columns):
        return []
    reasons: dict[str, list[str]] = {}
    for (method, scene), reason in untimed(frame).items():
        reasons.setdefault(reason, []).append(f"{method} on {scene}")
    total = len(frame[frame["status"] == "ok"].groupby(["method", "scene"]))
    lines = [
        f"times not ranked, lowest to highest run: {'all' if len(who) == total else shortlist(who)}: {reason}"
        for reason, who in reasons.items()
    ]
    unranked = incomparable(frame, columns)
    if unranked - {REFERENCE}:
        machines = sorted(set(frame[frame["timing"] == "alone"]["hardware"]))
        lines.append(
            f"times of different machines, ranked by reference seconds alone: {shortlist(machines, 4)}"
        )
    if REFERENCE in unranked:
        lines.append("reference seconds of CPU and GPU are not ranked against each other")
    return lines
