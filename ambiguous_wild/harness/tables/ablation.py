"""The study of `aw ablate` as tables: a table a group, a row a variant."""

from __future__ import annotations

import json
import math
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.ablation.records import GroupFacts, StudyReport, VariantRow
from ambiguous_wild.harness.measures import Measure, measure
from ambiguous_wild.harness.tables.table import Cell, Column, Row, Table, ranks

FILE = "ablation.json"
SHOWN = ("psnr", "ssim", "lpips_alex", "lpips_vgg", "mask_iou", "ms_per_iteration", "gaussians", "model_mb")


def ablation(folder: Path, metrics: tuple[str, ...] = ()) -> list[Table]:
    """The tables of a study.

    Args:
        folder: the output of `aw ablate`.
        metrics: columns; empty = those of `SHOWN` that any row has.

    Raises:
        AwError: no study there, a damaged one, or a metric that it does not have.
    """
    path = folder / FILE
    try:
        data: StudyReport = json.loads(path.read_text(encoding="utf-8"))
        rows, groups = data["rows"], data["groups"]
        known = list(dict.fromkeys(key for row in rows for key in row["values"]))
        for name in metrics:
            if name not in known:
                raise AwError(f"{path} has no {name!r}: it has {', '.join(known)}")
        keys = metrics or tuple(k for k in SHOWN if any(_mean(row, k) is not None for row in rows))
        columns = [measure(key) for key in keys]
        return [_group(group, rows, columns, data) for group in groups]
    except FileNotFoundError:
        raise AwError(f"no {FILE} in {folder}: 'aw ablate -o {folder}' writes it") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise AwError(f"{path} is damaged ({error!r}): run 'aw ablate' again") from None


def _group(group: GroupFacts, rows: list[VariantRow], columns: list[Measure], data: StudyReport) -> Table:
    members = [row for row in rows if row["group"] == group["name"]]
    by_column = [ranks([_number(_mean(row, c.key)) for row in members], c) for c in columns]
    lines = []
    for k, row in enumerate(members):
        cells = [_cell(row, c, rank[k]) for c, rank in zip(columns, by_column)]
        lines.append(Row(str(row["variant"]), tuple(cells), note=str(row["text"])))
    notes = [f"{row['variant']} {row['status']}: {row['reason']}" for row in members if row["status"] != "ok"]
    source = f" (paper: {group['source']})" if group["source"] else ""
    notes.append(f"{', '.join(data['scenes'])}; seeds {', '.join(map(str, data['seeds']))}")
    notes += [f"{data['method']}: {data['note']}"] if data.get("note") else []
    notes += [f"command of the runs: {data['made_by']}"] if data["made_by"] else []
    title = f"{data['method']}, {group['name']}: {group['title']}{source}"
    over = "seeds" if len(data["scenes"]) == 1 else "scenes and seeds"
    return Table(title, tuple(Column("", c) for c in columns), tuple(lines), tuple(notes), over)


def _cell(row: VariantRow, column: Measure, rank: int | None) -> Cell:
    if row["status"] == "failed":
        return Cell(state="failed")
    value = _number(_mean(row, column.key))
    if math.isnan(value):
        return Cell(state="missing")
    return Cell(value, _number(row["values"][column.key]["spread"]), rank=rank)


def _mean(row: VariantRow, key: str) -> float | None:
    return row["values"][key].get("mean") if key in row["values"] else None


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
