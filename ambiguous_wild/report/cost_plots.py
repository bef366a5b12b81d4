"""Draw the plots of the cost report: timelines, budgets, fronts and what each change brings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import plain
from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.palette import CATEGORIES, plot_colour
from ambiguous_wild.methods.registry import knows_truth
from ambiguous_wild.report.cost_changes import KINDS, Change
from ambiguous_wild.report.cost_curves import Curve, MeanAndDeviation, Point, pareto, summary, timeline
from ambiguous_wild.report.cost_report import PLOTS, CostReport, TimeUnit, per_minute

DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))  # when colours run out
GREY = "0.45"
PANEL = (4.6, 3.4)  # inches
DPI = 130
MAX_COLUMNS = 3
# Metadata by suffix: no dates, no versions.
UNDATED: dict[str, dict[str, None]] = {
    ".svg": {"Date": None, "Creator": None},
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
AXES = (
    ("minutes", "training time", True),
    ("model_mb", "model size (MB)", True),
    ("fps", "frames a second", False),
)


def new_figure(
    panels: int, *, panel: tuple[float, float] = PANEL, reading: str = ""
) -> tuple[Any, list[Any]]:
    """Make a figure without a screen; return it with the axes of its panels. `reading` is a line below it."""
    from matplotlib.figure import Figure

    columns = 2 if panels == 4 else min(MAX_COLUMNS, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(panel[0] * columns, panel[1] * rows), layout="constrained", dpi=DPI)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    if reading:
        figure.supxlabel(reading, fontsize=8, color=GREY)
    for spare in axes[panels:]:
        spare.set_axis_off()
    for used in axes[:panels]:
        used.spines[["top", "right"]].set_visible(False)
        used.tick_params(labelsize=8)
        used.grid(axis="y", color="0.92", linewidth=0.8)
        used.set_axisbelow(True)
    return figure, axes[:panels]


def save(figure: Any, stem: Path) -> list[Path]:
    """Write STEM.svg and STEM.png; equal figures give equal bytes."""
    paths = [stem.with_name(stem.name + suffix) for suffix in (".svg", ".png")]
    for path in paths:
        save_as(figure, path)
    return paths


def save_as(figure: Any, path: Path) -> None:
    """Write a figure as PDF, PNG or SVG, by the suffix; equal figures give equal bytes.

    A PDF embeds its fonts as TrueType (type 42), which publishers ask for; in an SVG letters are outlines.
    """
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": "aw", "pdf.fonttype": 42}), atomic_path(path) as temporary:
        suffix = path.suffix.lower()
        # a third of the time of Pillow's 6, a file 9 % larger
        fast = {"pil_kwargs": {"compress_level": 3}} if suffix == ".png" else {}
        figure.savefig(temporary, metadata=UNDATED[suffix], **fast)


class LineStyle(TypedDict):
    """Arguments of matplotlib's `plot`."""

    color: Any
    linestyle: Any


def line_styles(names: Sequence[str]) -> dict[str, LineStyle]:
    """Return colour and line of every name, the same in every plot."""
    return {
        name: {
            "color": plot_colour(CATEGORIES[i % len(CATEGORIES)]),
            "linestyle": DASHES[(i // len(CATEGORIES)) % len(DASHES)],
        }
        for i, name in enumerate(sorted(set(names)))
    }


def spread_out(heights: Sequence[float], gap: float) -> list[float]:
    """Return heights for labels at least `gap` apart, near the given ones; overlapping labels are centred."""
    order = sorted(range(len(heights)), key=lambda i: heights[i])
    pools: list[tuple[float, list[int]]] = []  # (middle, members)
    for i in order:
        pools.append((heights[i], [i]))
        while len(pools) > 1:
            (a, one), (b, two) = pools[-2:]
            if b - a >= (len(one) + len(two)) * gap / 2:
                break
            pools[-2:] = [((a * len(one) + b * len(two)) / (len(one) + len(two)), one + two)]
    placed = [0.0] * len(heights)
    for pool in pools:
        for k, i in enumerate(pool[1]):
            placed[i] = pool[0] + (k - (len(pool[1]) - 1) / 2) * gap
    return placed


def label_right(axes: Any, ends: Sequence[tuple[str, float, float, Any]]) -> None:
    """Write names in the right margin, at the ends of their lines; each end is (name, x, y, colour)."""
    if not ends:
        return
    low, high = axes.get_ylim()
    line = 0.062 * (high - low)
    heights = spread_out([y for _, _, y, _ in ends], line)
    for (name, x, y, colour), height in zip(ends, heights):
        axes.annotate(
            plain(name), (x, y), xytext=(1.03, (height - low) / (high - low)), textcoords="axes fraction",
            color=colour, fontsize=8, va="center", ha="left", parse_math=False, annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "alpha": 0.35, "linewidth": 0.7, "shrinkA": 1,
                        "shrinkB": 3},
        )  # fmt: skip


def label_points(axes: Any, points: Sequence[tuple[str, float, float, float, Any]]) -> None:
    """Write names beside points and their error bars, on the side with more room.

    Args:
        axes: the panel.
        points: (name, x, half the length of its horizontal bar, y, colour) of each.
    """
    low, high = axes.get_ylim()
    to_axes = axes.transData + axes.transAxes.inverted()
    heights = spread_out([y for _, _, _, y, _ in points], 0.062 * (high - low))
    for (name, x, bar, y, colour), height in zip(points, heights):
        left, right = (to_axes.transform((end, y))[0] for end in (x - bar, x + bar))
        on_right = left > 1 - right
        axes.annotate(
            plain(name), (x - bar if on_right else x + bar, height), xytext=(-8 if on_right else 8, 0),
            textcoords="offset points", color=colour, fontsize=8, va="center",
            ha="right" if on_right else "left", parse_math=False,
        )  # fmt: skip


def ticks_of_time(axes: Any, times: Sequence[float]) -> None:
    """Make the x axis logarithmic, with a tick at each of the few times."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(sorted(times)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def finite(*values: float) -> bool:
    return all(math.isfinite(v) for v in values)


def draw_all(report: CostReport, folder: Path) -> list[Path]:
    """Draw every plot that the runs have data for, as SVG and PNG; return the paths written."""
    written = []
    for name, draw in zip(PLOTS, (draw_timelines, draw_budgets, draw_front, draw_changes)):
        figure = draw(report)
        written += [] if figure is None else save(figure, folder / name)
    return written


def _panels(report: CostReport) -> list[tuple[str, tuple[str, ...]]]:
    """Return (title, scenes) of each panel; with several scenes, the mean comes first."""
    panels: list[tuple[str, tuple[str, ...]]] = [(scene, (scene,)) for scene in report.scenes]
    return [(f"mean over {len(panels)} scenes", report.scenes), *panels] if len(panels) > 1 else panels


def draw_timelines(report: CostReport) -> Any | None:
    """Draw test PSNR over training time: thin lines for seeds, thick for their mean, bars for the spread."""
    longest = {curve.name: curve for curve in report.curves}.values()  # they are sorted by length
    curves = [c for c in longest if any(len(run.points) > 1 for run in c.runs)]
    if not curves:
        return None
    panels, styles, unit = _panels(report), line_styles([c.name for c in report.curves]), report.unit
    figure, axes = new_figure(
        len(panels), reading="thick: mean over seeds; thin: each seed; bars: sample deviation over seeds"
    )
    for panel, (title, scenes) in zip(axes, panels):
        ends = [end for c in curves if (end := _timeline(panel, c, scenes, styles[c.name], unit)) is not None]
        _finish(panel, title, f"training time ({unit.name})")
        label_right(panel, ends)
        panel.set_xlim(left=0.0)
    return figure


def _timeline(
    axes: Any, curve: Curve, scenes: tuple[str, ...], style: LineStyle, unit: TimeUnit
) -> Any | None:
    scale = unit.per_minute / 60.0
    if len(scenes) == 1:
        for run in curve.on(scenes[0]):
            at = np.array(run.points).reshape(-1, 2)
            axes.plot(at[:, 0] * scale, at[:, 1], **style, linewidth=0.7, alpha=0.45)
    seconds, psnr = timeline(curve, scenes)
    x, y = _end(curve, scenes, unit)
    seconds = seconds * scale
    if finite(x.mean, y.mean) and len(seconds) and x.mean >= seconds[-1]:  # the dot belongs to its curve
        seconds, psnr = np.append(seconds, x.mean), np.append(psnr, y.mean)
    axes.plot(seconds, psnr, **style, linewidth=2.0)
    if not finite(x.mean, y.mean):
        return None
    _dot(axes, x, y, style["color"])
    return curve.name, x.mean, y.mean, style["color"]


def _end(curve: Curve, scenes: tuple[str, ...], unit: TimeUnit) -> tuple[MeanAndDeviation, MeanAndDeviation]:
    """Return the length of the training, and its PSNR."""
    minutes = summary(curve, scenes, lambda run: run.train_s / 60.0)
    return unit.of(minutes), summary(curve, scenes, lambda run: run.psnr)


def _dot(axes: Any, x: MeanAndDeviation, y: MeanAndDeviation, colour: Any, *, hollow: bool = False) -> None:
    xerr, yerr = (e if finite(e) else None for e in (x.spread, y.spread))
    axes.errorbar(x.mean, y.mean, xerr=xerr, yerr=yerr, fmt="o", color=colour, markersize=5.5, elinewidth=1.2,
                  capsize=2.5, zorder=3, markerfacecolor="white" if hollow else colour)  # fmt: skip


def draw_budgets(report: CostReport) -> Any | None:
    """Draw the final PSNR of runs of several lengths; each dot is a separate training."""
    lengths = grouped(report.curves, lambda curve: curve.name)
    if all(len(curves) < 2 for curves in lengths.values()):
        return None
    panels, styles, unit = _panels(report), line_styles(list(lengths)), report.unit
    figure, axes = new_figure(
        len(panels), reading="every dot is a training of that length; bars: sample deviation over seeds"
    )
    for panel, (title, scenes) in zip(axes, panels):
        ends, times = [], []
        for name, curves in lengths.items():
            ends_of = _joined(panel, curves, scenes, styles[name], unit)
            times += [x for x, _ in ends_of]
            ends += [(name, *ends_of[-1], styles[name]["color"])] if ends_of else []
        _finish(panel, title, f"training time ({unit.name})")
        label_right(panel, ends)
        if times:
            ticks_of_time(panel, _few(times))
    return figure


def _joined(
    axes: Any, curves: Sequence[Curve], scenes: tuple[str, ...], style: LineStyle, unit: TimeUnit
) -> list[tuple[float, float]]:
    ends = []
    for curve in curves:
        x, y = _end(curve, scenes, unit)
        if finite(x.mean, y.mean):
            ends.append((x.mean, y.mean))
            _dot(axes, MeanAndDeviation(x.mean), y, style["color"])
    ends.sort()
    axes.plot([x for x, _ in ends], [y for _, y in ends], **style, linewidth=2.0)
    return ends


def _few(times: Sequence[float]) -> list[float]:
    """Return times rounded to two digits, without those whose labels would overlap."""
    kept: list[float] = []
    for time in sorted({float(f"{t:.2g}") for t in times}):
        if not kept or time > 1.3 * kept[-1]:
            kept.append(time)
    return kept


def draw_front(report: CostReport) -> Any | None:
    """Draw PSNR against time, megabytes and frames per second; the grey line is the Pareto front."""
    styles, unit = line_styles([p.curve for p in report.points]), report.unit
    panels = [
        axis for axis in AXES if any(finite(_x(p, axis[0], unit).mean, p.psnr.mean) for p in report.points)
    ]
    if not panels:
        return None
    figure, axes = new_figure(
        len(panels),
        reading="grey: Pareto front; hollow: time not ranked; bars: sample deviation over seeds",
    )
    for panel, (key, label, less_is_better) in zip(axes, panels):
        timed = key != "model_mb"
        known = [(p, _x(p, key, unit).mean) for p in report.points]
        known = [(p, x) for p, x in known if finite(x, p.psnr.mean)]
        at = {id(p): x for p, x in known}
        # a time that is not ranked is drawn, and never on the front
        rivals = [p for p, _ in known if not knows_truth(p.method) and not (p.not_ranked and timed)]
        front = pareto(rivals, [at[id(p)] if less_is_better else -at[id(p)] for p in rivals])
        # the ring shows a front of one point, which has no line
        panel.step([at[id(p)] for p in front], [p.psnr.mean for p in front], where="post", color="0.82",
                   linewidth=5.0, solid_capstyle="round", marker="o", markersize=13, zorder=1)  # fmt: skip
        for p, _ in known:
            hollow = bool(p.not_ranked) and timed
            _dot(panel, _x(p, key, unit), p.psnr, styles[p.curve]["color"], hollow=hollow)
        lines = grouped(known, lambda item: item[0].curve)  # trainings of several lengths
        for name, line in lines.items():
            panel.plot([x for _, x in line], [p.psnr.mean for p, _ in line], **styles[name], linewidth=1.0,
                       alpha=0.6)  # fmt: skip
        # of a curve of several lengths, the longest has the name
        ends = []
        for c, line in lines.items():
            point, x = line[-1]
            spread = _x(point, key, unit).spread
            ends.append((c, x, spread if finite(spread) else 0.0, point.psnr.mean, styles[c]["color"]))
        if key == "minutes":
            label = f"{label}{' and set-up' if report.setup else ''} ({unit.name})"
        panel.margins(x=0.08, y=0.1)
        _finish(panel, report.over, f"{label}, {'less' if less_is_better else 'more'} is better")
        times = list(at.values())
        if key == "minutes" and max(times) > 5.0 * min(times) > 0.0:
            ticks_of_time(panel, _few(times))
        label_points(panel, ends)
    return figure


def _x(point: Point, key: str, unit: TimeUnit) -> MeanAndDeviation:
    return unit.of(point.minutes) if key == "minutes" else point.numbers[key]


def draw_changes(report: CostReport) -> Any | None:
    """Draw a row for each change: the gain in dB with its interval, and its cost beside it."""
    rows = [c for c in report.changes if finite(c.db.mean)]
    if not rows:
        return None
    unit = report.unit
    figure, (axes,) = new_figure(1, panel=(8.6, 1.1 + 0.36 * len(rows)))
    for height, change in enumerate(reversed(rows)):
        colour = plot_colour(CATEGORIES[KINDS.index(change.kind)])
        if finite(change.db_low, change.db_high):
            axes.plot([change.db_low, change.db_high], [height, height], color=colour, linewidth=2.0)
        axes.plot([change.db.mean], [height], "o", color=colour, markersize=6)
        axes.annotate(_price(change, unit), (1.02, height), xycoords=("axes fraction", "data"), fontsize=8,
                      va="center", color=GREY, annotation_clip=False)  # fmt: skip
    axes.axvline(0.0, color="0.6", linewidth=0.8)
    axes.set_yticks(range(len(rows)), [plain(_what(c)) for c in reversed(rows)], fontsize=8, parse_math=False)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.grid(axis="x", color="0.92")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel("PSNR gained (dB), bar: 95 % interval over the test images", fontsize=8)
    return figure


def _what(change: Change) -> str:
    plus = "+ " if change.kind == "effect" else ""
    return f"{change.method}: {plus}{change.what}, {change.length}"


def _price(change: Change, unit: TimeUnit) -> str:
    if not finite(change.minutes.mean):
        return "time unknown"
    if change.same_time:
        return "in the same time"
    extra, rate = unit.of(change.minutes).mean, per_minute(change)
    return f"{extra:+.{unit.digits}f} {unit.name}" + (f", {rate} dB a minute" if extra > 0.0 else "")


def _finish(axes: Any, title: str, x_label: str) -> None:
    # names may hold formulas and control characters
    axes.set_title(plain(title), fontsize=9, loc="left", parse_math=False)
    axes.set_xlabel(plain(x_label), fontsize=8, parse_math=False)
    axes.set_ylabel("test PSNR (dB)", fontsize=8)
