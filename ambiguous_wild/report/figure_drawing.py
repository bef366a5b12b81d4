"""Draw a figure of runs: columns of methods, rows of photos, each with its zoom and its error maps.

All lengths are whole pixels of one grid, in which a photo's pixel is a whole number of pixels wide where that
is possible, so that a PNG shows renders unsmoothed too. PDF and SVG embed the pictures as they are.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.core.names import plain
from ambiguous_wild.io.palette import CATEGORIES, plot_colour, ramp
from ambiguous_wild.report.cost_plots import save_as
from ambiguous_wild.report.figure_rows import PHOTO, FigureRow, RunsFigure, cut

# Inches of a paper: a column of text, the width of both, and the height that leaves room for a caption.
COLUMN, TEXT_WIDTH, TEXT_HEIGHT = 3.3, 7.0, 8.5
FEW = 3  # columns of pictures that fit one column of text
GAP, ROW_GAP = 0.03, 0.06  # inches between pictures and between rows
LINE = 1.35  # height of a line of text, in its size
HEAD, CAPTION, SMALLEST = 8.0, 7.0, 5.0  # points
NARROWEST = 0.4  # inches of a picture, however many rows there are
LEAST_DPI, MOST_DPI = 300, 600
BOX = plot_colour(CATEGORIES[4])  # outline of the zoom
OUTLINE = 1.0  # points
POINT = 1 / 72  # inches


@dataclass(frozen=True)
class _Layout:
    """Lengths of a figure, px of the grid."""

    dpi: float
    cell: int  # width of a picture
    gap: int
    row_gap: int
    strip: int  # at the left, for names of scenes
    head: tuple[str, ...]
    head_size: float  # points
    caption_size: float

    def px(self, inches: float) -> int:
        return round(inches * self.dpi)

    @property
    def line(self) -> int:
        """Height of a caption."""
        return self.px(self.caption_size * LINE * POINT)

    @property
    def head_height(self) -> int:
        lines = max(text.count("\n") for text in self.head) + 1
        return self.px(lines * self.head_size * LINE * POINT)

    def x(self, column: int) -> int:
        return self.strip + column * (self.cell + self.gap)

    def width(self) -> int:
        return self.x(len(self.head)) - self.gap

    def height_of(self, picture: np.ndarray) -> int:
        return max(round(self.cell * picture.shape[0] / picture.shape[1]), 1)

    def row(self, row: FigureRow) -> int:
        """Height of a row: picture, zoom, captions, error maps."""
        full = self.height_of(row.pictures[0])
        height = full + self.line
        if row.box is not None:
            height += self.gap + self.height_of(cut(row.pictures[0], row.box))
        return height + (self.gap + full if row.errors else 0)

    def height(self, rows: Sequence[FigureRow]) -> int:
        return self.head_height + sum(map(self.row, rows)) + self.row_gap * (len(rows) - 1)


def fitted(figure: RunsFigure, width: float | None = None) -> RunsFigure:
    """Leave out the last rows of a scene while it has several and the figure is higher than a page."""
    while True:
        layout = _layout(figure, width)
        sizes = figure.group_sizes
        if layout.height(figure.rows) <= layout.px(TEXT_HEIGHT) or max(sizes.values()) == 1:
            return figure
        longest = max(sizes, key=lambda group: sizes[group])
        last = max(k for k, row in enumerate(figure.rows) if (row.scene, row.masks) == longest)
        figure = replace(figure, rows=figure.rows[:last] + figure.rows[last + 1 :])


def write_figure(figure: RunsFigure, path: Path, *, width: float | None = None) -> tuple[float, float]:
    """Draw a figure and write it as PDF, PNG or SVG, by the suffix.

    Args:
        figure: the figure.
        path: the file.
        width: inches; None: one column of text for up to three columns of pictures, else the whole width.
            A figure that would be higher than a page is drawn narrower.

    Returns:
        Width and height in inches.
    """
    layout, shrink = _layout(figure, width), 1.0
    while (over := layout.height(figure.rows) / layout.px(TEXT_HEIGHT)) > 1.0:
        shrink, cell = shrink * over, layout.cell / layout.dpi
        layout = _layout(figure, width, shrink)
        if layout.cell / layout.dpi >= cell:  # the narrowest that can be read
            break
    drawing = _Drawing(figure, layout)
    drawing.draw()
    save_as(drawing.figure, path)
    return drawing.width / layout.dpi, drawing.height / layout.dpi


def _layout(figure: RunsFigure, width: float | None, shrink: float = 1.0) -> _Layout:
    """Return the lengths; `shrink`: how many times too high the figure is."""
    columns = 1 + len(figure.methods)
    if width is None:
        width = COLUMN if columns <= FEW else TEXT_WIDTH
    several = len({row.scene for row in figure.rows}) > 1
    strip = HEAD * LINE * POINT if several else 0.0
    cell = (width - strip - GAP * (columns - 1)) / columns
    cell = max(cell / shrink, min(cell, NARROWEST))
    photo = max(row.pictures[0].shape[1] for row in figure.rows)
    dpi = max(math.ceil(LEAST_DPI * cell / photo), 1) * photo / cell
    dpi = min(dpi, MOST_DPI)
    head, size = _head((PHOTO, *figure.methods), cell)
    captions = [text for row in figure.rows for text in row.texts]
    return _Layout(
        dpi, round(cell * dpi), round(GAP * dpi), round(ROW_GAP * dpi), round(strip * dpi), head, size,
        _size_that_fits(captions, cell, min(size, CAPTION)),
    )  # fmt: skip


def _head(names: Sequence[str], cell: float) -> tuple[tuple[str, ...], float]:
    """Return the names, broken into lines where they are wider than a column, and their size in points."""
    names = [plain(name) for name in names]
    size = _size_that_fits(names, cell, HEAD)
    if size >= CAPTION - 1:
        return tuple(names), size
    size = CAPTION - 1
    broken = []
    for name in names:
        letters = len(name)
        while letters > 1 and any(_width(line, size) > cell for line in textwrap.wrap(name, letters)):
            letters -= 1
        broken.append("\n".join(textwrap.wrap(name, letters)))
    return tuple(broken), size


def _size_that_fits(texts: Sequence[str], cell: float, size: float) -> float:
    """Return the largest size in points, at most `size`, at which all texts are as narrow as a column."""
    widest = max((_width(text, size) for text in texts), default=0.0)
    return size if widest <= cell else max(size * cell / widest, SMALLEST)


def _width(text: str, size: float) -> float:
    """Return the width of a line in inches, at most: PNG letters stand on whole pixels."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    width, _, _ = text_to_path.get_text_width_height_descent(text, FontProperties(size=size), ismath=False)
    return 1.04 * float(width) * POINT


class _Drawing:
    """The drawing of a figure, from its top to its bottom."""

    def __init__(self, figure: RunsFigure, layout: _Layout) -> None:
        from matplotlib.figure import Figure

        self.content, self.layout = figure, layout
        self.width, self.height = layout.width(), layout.height(figure.rows)
        self.figure = Figure(figsize=(self.width / layout.dpi, self.height / layout.dpi), dpi=layout.dpi)
        self.top_error = _round_up(figure.rows)
        self.first_errors = next((row for row in figure.rows if row.errors), None)

    def draw(self) -> None:
        layout, rows = self.layout, self.content.rows
        for column, name in enumerate(layout.head):
            x = layout.x(column) + layout.cell / 2
            self._text(x, layout.head_height, name, layout.head_size, above=True)
        several = len({row.scene for row in rows}) > 1
        y = layout.head_height
        begin = y
        for k, row in enumerate(rows):
            self._row(row, y)
            y += layout.row(row)
            if k + 1 == len(rows) or rows[k + 1].scene != row.scene:
                if several:
                    middle = (begin + y - layout.line) / 2
                    self._text(layout.strip / 2, middle, plain(row.scene), layout.head_size, upright=True)
                begin = y + layout.row_gap
            y += layout.row_gap

    def _row(self, row: FigureRow, y: int) -> None:
        layout = self.layout
        full = layout.height_of(row.pictures[0])
        for column, (picture, text) in enumerate(zip(row.pictures, row.texts)):
            x, below = layout.x(column), y + full
            axes = self._picture(picture, x, y, full)
            if row.box is not None:
                self._outline(axes, row.box, picture)
                zoom = cut(picture, row.box)
                high = layout.height_of(zoom)
                self._frame(self._picture(zoom, x, below + layout.gap, high))
                below += layout.gap + high
            self._text(x + layout.cell / 2, below, text, layout.caption_size)
            if row.errors:
                below += layout.line
                if column == 0 and row is self.first_errors:  # all error maps have one scale
                    self._scale(x, below, full)
                elif column > 0:
                    colours = ramp(row.errors[column - 1], 0.0, self.top_error)
                    self._picture(colours, x, below + layout.gap, full)

    def _picture(self, picture: np.ndarray, x: int, y: int, high: int) -> Any:
        """Draw a picture at columns from x and rows from y; one of more pixels than the grid is averaged."""
        wide = self.layout.cell
        if picture.shape[1] > wide:
            picture = cv2.resize(picture, (wide, high), interpolation=cv2.INTER_AREA)
        place = (x / self.width, 1 - (y + high) / self.height, wide / self.width, high / self.height)
        axes = self.figure.add_axes(place)
        axes.set_axis_off()
        axes.imshow(picture, interpolation="none", aspect="auto", extent=(0, 1, 1, 0))
        return axes

    def _outline(self, axes: Any, box: tuple[int, int, int, int], picture: np.ndarray) -> None:
        height, width = picture.shape[:2]
        left, top, wide, high = box
        self._rectangle(axes, left / width, top / height, wide / width, high / height)

    def _frame(self, axes: Any) -> None:
        self._rectangle(axes, 0.0, 0.0, 1.0, 1.0)

    def _rectangle(self, axes: Any, left: float, top: float, wide: float, high: float) -> None:
        from matplotlib.patches import Rectangle

        axes.add_patch(
            Rectangle(
                (left, top), wide, high, fill=False, edgecolor=BOX, linewidth=OUTLINE, joinstyle="miter"
            )
        )

    def _scale(self, x: int, y: int, high: int) -> None:
        """Draw the colours of the error maps, with their least and greatest value."""
        layout, size = self.layout, self.layout.caption_size
        bar = max(layout.line // 2, 1)
        top = y + layout.gap + max((high - bar) // 2, 0)
        colours = ramp(np.linspace(0.0, 1.0, 64)[None], 0.0, 1.0)
        self._picture(colours, x, top, bar)
        self._text(x + layout.cell / 2, top, "error", size, above=True)
        self._text(x, top + bar, "0", size, align="left")
        self._text(x + layout.cell, top + bar, f"{self.top_error:g}", size, align="right")

    def _text(
        self, x: float, y: float, text: str, size: float, *, above: bool = False, upright: bool = False,
        align: str = "center",
    ) -> None:  # fmt: skip
        """Write text below the row y of the grid, above it, or upright in its middle."""
        down = 0.25 * size * POINT * self.layout.dpi  # from a letter's foot to the end of its line
        rise = 1.0 * size * POINT * self.layout.dpi
        y = y - down if above else y if upright else y + rise
        self.figure.text(
            x / self.width, 1 - y / self.height, text, fontsize=size, ha=align, parse_math=False,
            va="center" if upright else "baseline", rotation=90 if upright else 0, linespacing=LINE / 1.2,
        )  # fmt: skip


def _round_up(rows: Sequence[FigureRow]) -> float:
    """Return the error that is drawn red: the 99th percentile of all, rounded up to one digit."""
    errors = [error.ravel() for row in rows for error in row.errors]
    if not errors:
        return 1.0
    top = float(np.percentile(np.concatenate(errors), 99))
    digit = 10.0 ** math.floor(math.log10(top)) if top > 0.0 else 0.01
    return max(math.ceil(round(top / digit, 6)), 1) * digit
