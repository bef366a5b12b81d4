"""Plans as JSON files."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.planning.decide import SCHEMA, Cost, Decision, Plan

_NUMBERS = ("cost_ms", "gain_db", "error_db")
_TEXTS = ("effect", "evidence", "unit", "why", "how")


def read_plan(path: Path) -> Plan:
    """A plan that `aw plan` wrote.

    Raises:
        AwError: no such file, or it is none.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["schema"] != SCHEMA:
            raise ValueError(f"schema {data['schema']!r}, not {SCHEMA}")
        lines = tuple(_decision(row) for row in data["decisions"])
        cost = None if data.get("cost") is None else _cost(data["cost"])
        if not isinstance(data["scene"], str):
            raise ValueError("scene is no text")
    except FileNotFoundError:
        raise AwError(f"there is no plan {path}; 'aw plan SCENE' makes one") from None
    except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        raise AwError(f"{path} is no plan of 'aw plan' ({error}); make it again") from None
    return Plan(data["scene"], lines, bool(data.get("probed")), cost)


def _decision(row: object) -> Decision:
    if not isinstance(row, dict):
        raise ValueError("a decision is no object")
    values = {f.name: row.get(f.name) for f in fields(Decision)}
    if row.get("decision") not in ("on", "off", "unknown"):
        raise ValueError(f"decision {row.get('decision')!r}")
    for name in _TEXTS:
        if not isinstance(values[name], str):
            raise ValueError(f"{name} is no text")
    for name in _NUMBERS:
        values[name] = None if values[name] is None else float(values[name])  # type: ignore[arg-type]
    values["value"] = math.nan if values["value"] is None else float(values["value"])
    values["threshold"] = float(values["threshold"])  # type: ignore[arg-type]
    return Decision(**values)  # type: ignore[arg-type]


def _cost(row: object) -> Cost:
    if not isinstance(row, dict):
        raise ValueError("cost is no object")
    return Cost(int(row["iterations"]), float(row["seconds"]), float(row["share"]))
