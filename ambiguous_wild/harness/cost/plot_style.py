"""What the plots of the cost report share: colours, labels beside the lines, files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ambiguous_wild.harness.tables.plain_formats import plain
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.io.palette import CATEGORIES, plot_colour

DASHES = ("-", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))  # when colours run out
GREY = "0.45"
PANEL = (4.6, 3.4)  # inches
DPI = 130
MOST_COLUMNS = 3


def new_figure(
    panels: int, *, panel: tuple[float, float] = PANEL, reading: str = ""
) -> tuple[Any, list[Any]]:
    """A figure of so many panels and their axes, without the screen; `reading` says below how to read it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = 2 if panels == 4 else min(MOST_COLUMNS, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(panel[0] * columns, panel[1] * rows), layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
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
    """Write STEM.svg and STEM.png; the same figure gives the same bytes."""
    import matplotlib

    paths = [stem.with_name(stem.name + suffix) for suffix in (".svg", ".png")]
    with matplotlib.rc_context({"svg.hashsalt": "aw"}):
        for path, metadata in zip(paths, ({"Date": None, "Creator": None}, {"Software": None})):
            with atomic_path(path) as temporary:
                figure.savefig(temporary, metadata=metadata)
    return paths


def looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour and line of every name; the same names look the same in every plot."""
    return {
        name: {
            "color": plot_colour(CATEGORIES[i % len(CATEGORIES)]),
            "linestyle": DASHES[(i // len(CATEGORIES)) % len(DASHES)],
        }
        for i, name in enumerate(sorted(set(names)))
    }


def text(axes: Any, what: str, **kw: Any) -> None:
    """A title or a label from others' names: neither formula nor control character."""
    getattr(axes, f"set_{what}")(plain(kw.pop("label")), parse_math=False, **kw)


def spread_out(heights: Sequence[float], gap: float) -> list[float]:
    """Heights for labels at least `gap` apart, near where they belong; those that overlap share a middle."""
    order = sorted(range(len(heights)), key=lambda i: heights[i])
    pools: list[tuple[float, list[int]]] = []  # (middle, members)
    for i in order:
        pools.append((heights[i], [i]))
        while len(pools) > 1 and _top(pools[-2], gap) > _bottom(pools[-1], gap):
            (a, one), (b, two) = pools[-2:]
            pools[-2:] = [((a * len(one) + b * len(two)) / (len(one) + len(two)), one + two)]
    placed = [0.0] * len(heights)
    for pool in pools:
        for k, i in enumerate(pool[1]):
            placed[i] = pool[0] + (k - (len(pool[1]) - 1) / 2) * gap
    return placed


def _top(pool: tuple[float, list[int]], gap: float) -> float:
    return pool[0] + len(pool[1]) * gap / 2


def _bottom(pool: tuple[float, list[int]], gap: float) -> float:
    return pool[0] - len(pool[1]) * gap / 2


def label_right(axes: Any, ends: Sequence[tuple[str, float, float, Any]]) -> None:
    """Names in the right margin, at the height where their lines end; (name, x, y, colour) each."""
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


def ticks_of_time(axes: Any, times: Sequence[float]) -> None:
    """A logarithmic axis with a tick at every one of the few times."""
    from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

    axes.set_xscale("log")
    axes.xaxis.set_major_locator(FixedLocator(sorted(times)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def finite(*values: float) -> bool:
    return all(math.isfinite(v) for v in values)
