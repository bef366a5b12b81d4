"""Write the report of an ablation study, ablation.json, .csv, .md and .png, and read its tables.

A mean is over images, then over all runs (scene, seed) of the variant; one missing value makes it missing.
The spread is the sample deviation over those runs. Differences to the default are taken run by run, on the
same scene with the same seed, so that the spread of a difference is not the spread between scenes.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.ablation_records import (
    DIFFERENCES,
    METRICS,
    REPORT,
    GroupFacts,
    StudyReport,
    VariantRow,
)
from ambiguous_wild.harness.measures import Measure, measure
from ambiguous_wild.io.files import write_json, write_text
from ambiguous_wild.methods.ablation_groups import DEFAULT
from ambiguous_wild.report.cost_plots import label_points, new_figure, save_as
from ambiguous_wild.report.plain_formats import to_csv, to_markdown
from ambiguous_wild.report.table_layout import BLANK, Column, Row, Table, TableCell, ranks

LOGARITHMIC = 20.0  # ratio of the values of an option from which their axis is logarithmic
SHOWN = ("psnr", "ssim", "lpips_alex", "iou", "ms_per_iteration", "gaussians", "model_mb")


def write_report(data: StudyReport, folder: Path) -> list[Path]:
    """Write ablation.json, .csv, .md and, if a group has two points, .png; return the paths written."""
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
    """Return one line for each variant; cells are empty where a value is missing."""
    lines = []
    for row in data["rows"]:
        line: Facts = {key: row[key] for key in ("group", "variant", "status", "reason", "same_as")}
        line |= {"settings": " ".join(row["settings"]), "runs": len(row["runs"])}
        for begin, entries in (("", row["values"]), ("difference_", row["differences"])):
            for key, entry in entries.items():
                line |= {f"{begin}{key}": entry["mean"], f"{begin}{key}_spread": entry["spread"]}
        lines.append(line)
    return to_csv(list(lines[0]), (line.values() for line in lines))


def markdown_of(data: StudyReport, picture: str = "") -> str:
    """Return one table for each group: differences to the default, quality, cost and meaning of variants."""
    lines = [f"# Ablations of {data['method']}", "", _subtitle(data), ""]
    lines += [f"![quality against cost]({picture})", ""] if picture else []
    shown = [m for m in METRICS if any(row["values"][m.key]["mean"] is not None for row in data["rows"])]
    return "\n".join(lines) + "\n" + to_markdown(_tables(data, shown, differences=True))


def _subtitle(data: StudyReport) -> str:
    train = data["train"]
    budget = train["budget_s"]
    length = f"{train['iterations']} iterations" if budget is None else f"{budget:g} s of training"
    base = f"; settings of all rows: {' '.join(data['settings'])}" if data["settings"] else ""
    return (
        f"{', '.join(data['scenes'])}; seeds {', '.join(map(str, data['seeds']))}; {length}{base}. "
        "Differences are to the default, on the same scene with the same seed; ± is the sample deviation "
        "over runs."
    )


def _what(row: VariantRow) -> TableCell:
    parts = [row["text"], f"`{' '.join(row['settings'])}`" if row["settings"] else ""]
    parts.append(f"same runs as {row['same_as']}" if row["same_as"] else "")
    text = "; ".join(part for part in parts if part)
    return TableCell(printed=text, markdown=text) if text else BLANK


def draw(data: StudyReport, path: Path) -> bool:
    """Draw PSNR against ms per iteration, a panel for each group; return False if no group has two points."""
    groups = [(g, _points(data, g["name"])) for g in data["groups"]]
    groups = [(g, points) for g, points in groups if len(points) > 1]  # one point compares nothing
    if not groups:
        return False
    figure, axes = new_figure(len(groups))
    for panel, (group, points) in zip(axes, groups):
        key, at = _swept([row for row in data["rows"] if row["group"] == group["name"]])
        _panel(panel, group, _over_values(data, group["name"], at) if key else points, key)
    save_as(figure, path)
    return True


def _points(data: StudyReport, group: str) -> list[tuple[str, float, float, float]]:
    """Return (variant, ms per iteration, PSNR, spread); variants with the same runs share one entry."""
    merged: dict[tuple[float, float], tuple[list[str], float]] = {}
    for row in data["rows"]:
        ms, psnr = row["values"]["ms_per_iteration"]["mean"], row["values"]["psnr"]["mean"]
        if row["group"] == group and ms is not None and psnr is not None:
            names = merged.setdefault((ms, psnr), ([], row["values"]["psnr"]["spread"] or 0.0))[0]
            names.append(row["variant"])
    return [(" = ".join(names), ms, psnr, spread) for (ms, psnr), (names, spread) in merged.items()]


def _swept(rows: Sequence[VariantRow]) -> tuple[str, dict[str, float]]:
    """Return the option whose values the variants are, and its value by variant; "" if they are others."""
    key, at = "", {}
    for row in rows:
        name, _, text = row["settings"][0].partition("=") if len(row["settings"]) == 1 else ("", "", "")
        try:
            at[row["variant"]] = float(text)
        except ValueError:
            return "", {}
        if not name or (key and name != key) or not math.isfinite(at[row["variant"]]):
            return "", {}
        key = name
    return (key, at) if len(set(at.values())) > 1 else ("", {})


def _over_values(
    data: StudyReport, group: str, at: dict[str, float]
) -> list[tuple[str, float, float, float]]:
    """Return (variant, value of the option, PSNR, spread) in the order of values, the default once."""
    rows = [row for row in data["rows"] if row["group"] == group and row["same_as"] != DEFAULT]
    quality = [(row["variant"], at[row["variant"]], row["values"]["psnr"]) for row in rows]
    known = [(name, x, y["mean"], y["spread"] or 0.0) for name, x, y in quality if y["mean"] is not None]
    return sorted(known, key=lambda point: point[1])


def _panel(
    axes: Any, group: GroupFacts, points: list[tuple[str, float, float, float]], swept: str = ""
) -> None:
    """Draw PSNR against ms per iteration, or against the values of the option that was swept."""
    ends = []
    if swept:
        low, high = points[0][1], points[-1][1]
        axes.plot(
            [x for _, x, _, _ in points], [y for _, _, y, _ in points], color="0.75", linewidth=1.0, zorder=0
        )
        if low > 0.0 and high >= LOGARITHMIC * low:
            axes.set_xscale("log")
    for index, (name, ms, psnr, spread) in enumerate(points):
        is_default = name.split(" = ")[0] == DEFAULT
        colour = "k" if is_default else f"C{index % 10}"
        axes.errorbar(ms, psnr, yerr=spread or None, fmt="*" if is_default else "o", color=colour,
                      ms=13 if is_default else 7, elinewidth=1, capsize=2)  # fmt: skip
        if is_default or not swept:  # the axis names the others
            ends.append((f"{DEFAULT} ({ms:g})" if swept else name, ms, 0.0, psnr, colour))
    axes.margins(0.12)
    label_points(axes, ends)
    axes.set_title(f"{group['name']}: {group['title']}", fontsize=8)
    axes.set_xlabel(plain(swept) or "ms per iteration", fontsize=8, parse_math=False)
    axes.set_ylabel("PSNR (dB)", fontsize=8)


def ablation(folder: Path, metrics: tuple[str, ...] = ()) -> list[Table]:
    """Read the tables of a study: a table for each group, a row for each variant.

    Args:
        folder: the output of `aw ablate`.
        metrics: keys of the columns; empty = those of `SHOWN` that any row has.

    Raises:
        AwError: the folder has no study or a damaged one, or the study lacks a metric.
    """
    path = folder / REPORT
    try:
        data: StudyReport = json.loads(path.read_text(encoding="utf-8"))
        keys = list(dict.fromkeys(key for row in data["rows"] for key in row["values"]))
        for name in metrics:
            if name not in keys:
                raise AwError(f"{path} has no {name!r}: it has {', '.join(keys)}")
        columns = {m.key: m for m in METRICS}
        present = (k for k in SHOWN if any(not math.isnan(_mean(row, "values", k)) for row in data["rows"]))
        shown = metrics or list(present)
        return _tables(data, [columns.get(key, measure(key)) for key in shown])
    except FileNotFoundError:
        raise AwError(
            f"no {REPORT} in {folder}: 'aw ablate -o {shlex.quote(str(folder))}' writes it"
        ) from None
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise AwError(f"{path} is damaged ({error!r}): run 'aw ablate' again") from None


def _tables(data: StudyReport, columns: Sequence[Measure], *, differences: bool = False) -> list[Table]:
    """Return a table for each group.

    With `differences`, the first columns are those to the default, and the last is the meaning of a variant.
    """
    tables = []
    for group in data["groups"]:
        members = [row for row in data["rows"] if row["group"] == group["name"]]
        untimed = {
            r["variant"]: why for r in members for run in r.get("runs", ()) if (why := run.get("untimed"))
        }
        by_column = []
        for c in columns:
            ranked = (not c.timed or row["variant"] not in untimed for row in members)
            values = [_mean(row, "values", c.key) if ok else math.nan for row, ok in zip(members, ranked)]
            by_column.append(ranks(values, c))
        lines = []
        for k, row in enumerate(members):
            cells = [_cell(row, c, rank[k]) for c, rank in zip(columns, by_column)]
            if differences:
                cells = [*(_difference(row, c) for c in DIFFERENCES), *cells, _what(row)]
            lines.append(Row(str(row["variant"]), tuple(cells), note=str(row["text"])))
        notes = [f"{r['variant']} {r['status']}: {r['reason']}" for r in members if r["status"] != "ok"]
        for reason, of in grouped(untimed.items(), lambda item: item[1]).items():
            notes.append(f"times not ranked: {shortlist(name for name, _ in of)} ({reason})")
        heads = [Column("", c) for c in columns]
        if differences:
            first = (Column("", replace(c, label=f"d {c.label}", better=None)) for c in DIFFERENCES)
            heads = [*first, *heads, Column("", Measure("what", "what", None, 0), words=True)]
        source = f" (paper: {group['source']})" if group["source"] else ""
        title = f"{data['method']}, {group['name']}: {group['title']}{source}"
        over = "seeds" if len(data["scenes"]) == 1 else "scenes and seeds"
        tables.append(Table(title, tuple(heads), tuple(lines), tuple(notes), over))
    common = [f"{', '.join(data['scenes'])}; seeds {', '.join(map(str, data['seeds']))}"]
    common += [f"{data['method']}: {data['note']}"] if data.get("note") else []
    common += [f"command of the runs: {data['made_by']}"] if data["made_by"] else []
    return [*tables[:-1], tables[-1].with_notes(*common)]


def _cell(row: VariantRow, column: Measure, rank: int | None) -> TableCell:
    if row["status"] == "failed":
        return TableCell(state="failed")
    value = _mean(row, "values", column.key)
    if math.isnan(value):
        return TableCell(state="missing")
    spread = row["values"][column.key]["spread"]
    return TableCell(value, math.nan if spread is None else float(spread), rank=rank)


def _difference(row: VariantRow, column: Measure) -> TableCell:
    value, spread = _mean(row, "differences", column.key), row["differences"][column.key]["spread"]
    if row["variant"] == DEFAULT or math.isnan(value):
        return BLANK
    text = f"{value:+.{column.digits}f}"
    return TableCell(printed=text if spread is None else f"{text} ± {spread:.{column.digits}f}")


def _mean(row: VariantRow, kind: Literal["values", "differences"], key: str) -> float:
    """Return the mean of a row; NaN if it is missing."""
    value = row[kind][key]["mean"] if key in row[kind] else None
    return math.nan if value is None else float(value)
