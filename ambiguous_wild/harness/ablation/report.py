"""From an ablation study's runs to ablation.json, .csv, .md and .png.

A mean is over images, then over all runs (scene, seed) of the variant; one missing value makes it missing.
The spread is the sample deviation over those runs. Differences to the default are taken run by run, on the
same scene with the same seed, so that the spread of a difference is not the spread between scenes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.harness.ablation.plan import (
    DIFFERENCES,
    METRICS,
    GroupFacts,
    Outcome,
    Planned,
    Study,
    StudyReport,
    Summary,
    VariantRow,
    read_outcomes,
)
from ambiguous_wild.harness.measures import Measure, measure
from ambiguous_wild.harness.tables.plain_formats import to_csv, to_markdown
from ambiguous_wild.harness.tables.table import BLANK, Cell, Column, Row, Table, ranks, text_table
from ambiguous_wild.io.atomic import atomic_path, write_json, write_text
from ambiguous_wild.methods.describe import BACK_ENDS
from ambiguous_wild.metrics import stats


def report(study: Study, output: Path, made_by: str = "") -> StudyReport:
    """The study as plain data: one entry a row, with its values, differences and runs.

    Args:
        study: planned, run or in part run.
        output: the folder of its runs.
        made_by: the command that makes it again.
    """
    default = read_outcomes(study.default, output)
    rows = [_row(row, read_outcomes(row.cells, output), default) for row in study.rows]
    return {
        "schema": 1,
        "made_by": made_by,
        "note": study.note,
        **study.facts(),
        "groups": [{"name": g.name, "title": g.title, "source": g.source} for g in study.groups],
        "rows": rows,
    }


def _row(row: Planned, outcomes: list[Outcome], default: list[Outcome]) -> VariantRow:
    failed = [o for o in outcomes if o.result is None]
    status: Literal["ok", "failed", "missing"] = "missing" if row.missing else "failed" if failed else "ok"
    reason = row.missing or "; ".join(dict.fromkeys(f"{o.scene}, seed {o.seed}: {o.error}" for o in failed))
    values = {key: _summary([o.value(key) for o in outcomes]) for key, _, _ in METRICS}
    differences = {}
    for key, _, _ in DIFFERENCES:
        pairs = [(o.value(key), d.value(key)) for o, d in zip(outcomes, default, strict=False)]
        differences[key] = _summary([None if a is None or b is None else a - b for a, b in pairs])
    return {
        "group": row.group,
        "variant": row.variant.name,
        "settings": [*row.variant.settings, *_networks(row)],
        "text": row.variant.text,
        "status": status,
        "reason": reason,
        "same_as": row.same_as,
        "values": values,
        "differences": differences,
        "runs": [
            {"scene": o.scene, "seed": o.seed, "folder": str(o.folder), "error": o.error or None}
            | {key: o.value(key) for key, _, _ in METRICS}
            for o in outcomes
        ],
    }


def _networks(row: Planned) -> list[str]:
    """Features and instances of a variant that is another method."""
    if not row.variant.method or not row.cells:
        return []
    options = to_plain(row.cells[0].options)
    return [f"{key}={options[key]}" for key in BACK_ENDS if key in options]


def _summary(values: list[float | None]) -> Summary:
    numbers = [math.nan if v is None else float(v) for v in values]
    mean, spread = stats.mean(numbers), stats.spread(numbers)
    return {"mean": _number(mean), "spread": _number(spread)}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def write_report(data: StudyReport, folder: Path) -> list[Path]:
    """ablation.json, .csv, .md and, where there is something to draw, .png; returns what was written."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"ablation.{kind}" for kind in ("json", "csv", "md")]
    write_json(paths[0], data)
    write_text(paths[1], csv_of(data))
    png = folder / "ablation.png"
    if draw(data, png):
        paths.append(png)
    write_text(paths[2], markdown_of(data, picture=png.name if png in paths else ""))
    return paths


def csv_of(data: StudyReport) -> str:
    """One line a row of the study; empty cells where a value is missing."""
    lines = []
    for row in data["rows"]:
        line: dict[str, Any] = {
            "group": row["group"],
            "variant": row["variant"],
            "status": row["status"],
            "reason": row["reason"],
            "same_as": row["same_as"],
        }
        line |= {"settings": " ".join(row["settings"]), "runs": len(row["runs"])}
        for key, entry in row["values"].items():
            line |= {key: entry["mean"], f"{key}_spread": entry["spread"]}
        for key, entry in row["differences"].items():
            line |= {f"difference_{key}": entry["mean"], f"difference_{key}_spread": entry["spread"]}
        lines.append(line)
    return to_csv(list(lines[0]), (line.values() for line in lines))


def markdown_of(data: StudyReport, picture: str = "") -> str:
    """One table a group: quality and cost of each variant."""
    shown = [m for m in METRICS if any(r["values"][m[0]]["mean"] is not None for r in data["rows"])]
    lines = [f"# Ablations of {data['method']}", "", _subtitle(data), ""]
    if data.get("note"):
        lines += [f"{data['method']}: {data['note']}", ""]
    if picture:
        lines += [f"![quality against cost]({picture})", ""]
    for group in data["groups"]:
        rows = [row for row in data["rows"] if row["group"] == group["name"]]
        lines += [f"## {group['name']}: {group['title']}", ""]
        if group["source"]:
            lines += [f"Paper: {group['source']}.", ""]
        lines += [*to_markdown([_table(rows, shown)]).splitlines(), ""]
        lines += [f"- {r['variant']} {r['status']}: {r['reason']}" for r in rows if r["status"] != "ok"]
        lines += [""] if lines[-1] else []
    if data["made_by"]:
        lines += [f"command: `{data['made_by']}`", ""]
    return "\n".join(lines)


def _table(rows: Sequence[VariantRow], shown: Sequence[tuple[str, str, int]]) -> Table:
    head = ["variant", *(label for _, label, _ in DIFFERENCES), *(label for _, label, _ in shown), "what"]
    lines: list[list[str | Cell]] = []
    for row in rows:
        if row["status"] == "ok":
            cells = [_cell(row, "differences", key, digits, sign=True) for key, _, digits in DIFFERENCES]
            cells += [_cell(row, "values", key, digits) for key, _, digits in shown]
        else:  # the reason stands below the table
            cells = [row["status"], *[""] * (len(head) - 3)]
        lines.append([row["variant"], *cells, _what(row)])
    return text_table("", head, lines, words=("what",))


def _subtitle(data: StudyReport) -> str:
    train = data["train"]
    budget = train["budget_s"]
    length = f"{train['iterations']} iterations" if budget is None else f"{budget:g} s of training"
    base = f"; in every row of the method: {' '.join(data['settings'])}" if data["settings"] else ""
    return (
        f"{', '.join(data['scenes'])}; seeds {', '.join(map(str, data['seeds']))}; {length}{base}. "
        "Differences are to the default, on the same scene with the same seed; +- is the sample deviation "
        "over runs."
    )


def _what(row: VariantRow) -> Cell:
    parts = [row["text"], f"`{' '.join(row['settings'])}`" if row["settings"] else ""]
    parts.append(f"same runs as {row['same_as']}" if row["same_as"] else "")
    text = "; ".join(part for part in parts if part)
    return Cell(printed=text, markdown=text) if text else BLANK


def _cell(
    row: VariantRow, kind: Literal["values", "differences"], key: str, digits: int, sign: bool = False
) -> str:
    entry = row[kind][key]
    if row["variant"] == "default" and kind == "differences":
        return ""
    if entry["mean"] is None:
        return "missing"
    text = f"{entry['mean']:{'+' if sign else ''},.{digits}f}"
    return text if entry["spread"] is None else f"{text} +- {entry['spread']:,.{digits}f}"


def draw(data: StudyReport, path: Path) -> bool:
    """Draw PSNR against ms per iteration, a panel a group; False where no group has two points."""
    groups = [(g, _points(data, g["name"])) for g in data["groups"]]
    groups = [(g, points) for g, points in groups if len(points) > 1]  # one point compares nothing
    if not groups:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(3, len(groups))
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(5.2 * columns, 3.9 * rows), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for panel, (group, points) in zip(axes.flat, groups, strict=False):
        _panel(panel, group, points)
    for panel in list(axes.flat)[len(groups) :]:
        panel.set_axis_off()
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})
    return True


def _points(data: StudyReport, group: str) -> list[tuple[str, float, float, float]]:
    """(variant, ms an iteration, PSNR, its spread), variants of the same runs under one name."""
    merged: dict[tuple[float, float], tuple[list[str], float]] = {}
    for row in data["rows"]:
        ms, psnr = row["values"]["ms_per_iteration"]["mean"], row["values"]["psnr"]["mean"]
        if row["group"] == group and ms is not None and psnr is not None:
            names = merged.setdefault((ms, psnr), ([], row["values"]["psnr"]["spread"] or 0.0))[0]
            names.append(row["variant"])
    return [(" = ".join(names), ms, psnr, spread) for (ms, psnr), (names, spread) in merged.items()]


def _panel(axes: Any, group: GroupFacts, points: list[tuple[str, float, float, float]]) -> None:
    for index, (name, ms, psnr, spread) in enumerate(points):
        is_default = name.split(" = ")[0] == "default"
        colour = "k" if is_default else f"C{index % 10}"
        axes.errorbar(ms, psnr, yerr=spread or None, fmt="*" if is_default else "o", color=colour,
                      ms=13 if is_default else 7, elinewidth=1, capsize=2)  # fmt: skip
    _labels(axes, points)
    axes.set_title(f"{group['name']}: {group['title']}", fontsize=8)
    axes.set_xlabel("ms per iteration", fontsize=8)
    axes.set_ylabel("PSNR (dB)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.25)


def _labels(axes: Any, points: list[tuple[str, float, float, float]]) -> None:
    """Name every point, each at least a line from the next and all of them inside the frame."""
    axes.margins(0.12)
    low, high = axes.get_ylim()
    middle, line = sum(axes.get_xlim()) / 2, 0.05 * (high - low)
    width = axes.get_xlim()[1] - axes.get_xlim()[0]
    order = sorted(range(len(points)), key=lambda index: points[index][2])
    heights, last = {}, -math.inf
    for index in order:
        last = heights[index] = max(points[index][2], last + line)
    above = high + 0.4 * line
    for index in reversed(order):  # labels that left the frame move down again
        above = heights[index] = min(heights[index], above - line)
    for index, (name, ms, psnr, _) in enumerate(points):
        left = ms <= middle
        axes.annotate(
            name,
            (ms, psnr),
            xytext=(ms + (0.03 if left else -0.03) * width, heights[index]),
            fontsize=7,
            color="k" if name.split(" = ")[0] == "default" else f"C{index % 10}",
            ha="left" if left else "right",
            va="center",
            arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "0.6"},
        )


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
        keys = metrics or tuple(k for k in SHOWN if any(_value(row, k) is not None for row in rows))
        columns = [measure(key) for key in keys]
        return [_group_table(group, rows, columns, data) for group in groups]
    except FileNotFoundError:
        raise AwError(f"no {FILE} in {folder}: 'aw ablate -o {folder}' writes it") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise AwError(f"{path} is damaged ({error!r}): run 'aw ablate' again") from None


def _group_table(
    group: GroupFacts, rows: list[VariantRow], columns: list[Measure], data: StudyReport
) -> Table:
    members = [row for row in rows if row["group"] == group["name"]]
    by_column = [ranks([_or_nan(_value(row, c.key)) for row in members], c) for c in columns]
    lines = []
    for k, row in enumerate(members):
        cells = [_table_cell(row, c, rank[k]) for c, rank in zip(columns, by_column)]
        lines.append(Row(str(row["variant"]), tuple(cells), note=str(row["text"])))
    notes = [f"{row['variant']} {row['status']}: {row['reason']}" for row in members if row["status"] != "ok"]
    source = f" (paper: {group['source']})" if group["source"] else ""
    notes.append(f"{', '.join(data['scenes'])}; seeds {', '.join(map(str, data['seeds']))}")
    notes += [f"{data['method']}: {data['note']}"] if data.get("note") else []
    notes += [f"command of the runs: {data['made_by']}"] if data["made_by"] else []
    title = f"{data['method']}, {group['name']}: {group['title']}{source}"
    over = "seeds" if len(data["scenes"]) == 1 else "scenes and seeds"
    return Table(title, tuple(Column("", c) for c in columns), tuple(lines), tuple(notes), over)


def _table_cell(row: VariantRow, column: Measure, rank: int | None) -> Cell:
    if row["status"] == "failed":
        return Cell(state="failed")
    value = _or_nan(_value(row, column.key))
    if math.isnan(value):
        return Cell(state="missing")
    return Cell(value, _or_nan(row["values"][column.key]["spread"]), rank=rank)


def _value(row: VariantRow, key: str) -> float | None:
    return row["values"][key].get("mean") if key in row["values"] else None


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else float(value)
