"""The report's picture: photos with their masks, residual and cosine maps, and the scene's distributions.

Colours are the paper's: green is alike (small residual, high cosine), red is different.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import Scene
from ambiguous_wild.harness.ambiguity.measure import BINS, Look, Measured, cosine_map, load_photo
from ambiguous_wild.harness.ambiguity.sources import Background, Masks
from ambiguous_wild.io.atomic import atomic_path
from ambiguous_wild.io.palette import ADDED, LOCAL, MASKED, NEUTRAL, faded, plot_colour, ramp, tint
from ambiguous_wild.metrics import ambiguity as am
from ambiguous_wild.metrics import semantic as sem

PHOTOS = 4
SIDE = 480  # px a picture in the figure at most


def chosen(measured: list[Measured], most: int = PHOTOS) -> list[int]:
    """Indices spread over the range of occlusion rather than the first few: what is easy and what is hard."""
    order = sorted(range(len(measured)), key=lambda i: measured[i].counts.occlusion)
    return [order[round(k)] for k in np.linspace(0, len(order) - 1, min(most, len(order)))]


def overlay(photo: np.ndarray, distractor: np.ndarray) -> np.ndarray:
    """The photo [H, W, 3] in [0, 1] with its distractors tinted, uint8."""
    return tint((255 * photo + 0.5).astype(np.uint8), distractor, MASKED)


def residual_picture(
    photo: np.ndarray, behind: np.ndarray | None, known: np.ndarray | None, distractor: np.ndarray
) -> np.ndarray:
    """Residual of the distractors in the palette from 0 to 1 on the faded photo; dark grey = unknown."""
    shown = faded((255 * photo + 0.5).astype(np.uint8))
    use = np.zeros_like(distractor) if behind is None else distractor & (True if known is None else known)
    residual = np.full(distractor.shape, np.nan)
    if behind is not None:
        residual[use] = am.colour_residual(photo, behind)[use]
    shown[distractor] = ramp(residual, 0.0, 1.0)[distractor]
    return shown


def cosine_picture(look: Look, index: int, photo: np.ndarray, distractor: np.ndarray) -> np.ndarray | None:
    """Cosine of every cell to the photo's largest distractor in the palette, the distractors outlined."""
    import cv2

    cosines = cosine_map(look, index, photo)
    if cosines is None:
        return None
    size = (photo.shape[1], photo.shape[0])
    shown = cv2.resize(ramp(1.0 - cosines, 0.0, 1.0), size, interpolation=cv2.INTER_NEAREST)
    edges, _ = cv2.findContours(distractor.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(shown, edges, -1, (20, 20, 20), max(1, photo.shape[1] // 240)))


def write_figure(
    scene: Scene, masks: Masks, background: Background, measured: list[Measured], look: Look, path: Path
) -> None:
    """Write the picture as PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    picks = chosen(measured)
    columns = max(len(picks), 3)
    figure = Figure(figsize=(3.6 * columns, 9.2), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(4, 12)
    for column, index in enumerate(picks):
        view = scene.train[index]
        photo, distractor = load_photo(view), masks.load(view)
        behind, known = background.load(index, view)
        pictures = [
            overlay(photo, distractor),
            residual_picture(photo, behind, known, distractor) if behind is not None else None,
            cosine_picture(look, index, photo, distractor),
        ]
        name = view.name if len(view.name) <= 28 else f"…{view.name[-27:]}"
        captions = [
            f"{name}: {100 * distractor.mean():.0f} % covered",
            "residual to the background",
            "cosine to the largest distractor",
        ]
        span = slice(12 * column // len(picks), 12 * (column + 1) // len(picks))
        for line, (picture, caption) in enumerate(zip(pictures, captions)):
            _panel(figure.add_subplot(grid[line, span]), picture, caption)
    _histograms(figure, grid, measured, look)
    _legend(figure)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})


def _panel(axes: Any, picture: np.ndarray | None, caption: str) -> None:
    import cv2

    axes.set_xticks([])
    axes.set_yticks([])
    # A scene's photo may be called $x$: not to be read as a formula.
    axes.set_title(caption, fontsize=9, parse_math=False)
    if picture is None:
        why = "background unknown" if "residual" in caption else "no distractor to compare"
        axes.text(0.5, 0.5, why, ha="center", va="center", transform=axes.transAxes, fontsize=9)
        return
    scale = SIDE / max(picture.shape[:2])
    if scale < 1:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    axes.imshow(picture)


def _legend(figure: Any) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap

    colours = ListedColormap(ramp(np.linspace(0, 1, 64), 0.0, 1.0) / 255.0)
    bar = figure.colorbar(
        ScalarMappable(cmap=colours),
        ax=figure.axes[: -3 or None],
        location="right",
        shrink=0.4,
        aspect=30,
        pad=0.01,
    )
    bar.set_ticks(
        [0, 1], labels=["alike: residual 0,\ncosine 1", "different: residual 1,\ncosine 0"], fontsize=8
    )


def _histograms(figure: Any, grid: Any, measured: list[Measured], seen: Look) -> None:
    colour, cover, look = (figure.add_subplot(grid[3, s]) for s in (slice(0, 4), slice(4, 8), slice(8, 12)))
    counts = np.sum([m.histogram for m in measured], axis=0)
    colour.stairs(counts / max(counts.sum(), 1), BINS, fill=True, color=plot_colour(ADDED))
    colour.axvline(am.COLOUR_THRESHOLD, color="k", ls="--", lw=1)
    colour.set_xlabel(f"colour difference (close: below {am.COLOUR_THRESHOLD})", fontsize=9)
    colour.set_ylabel("share of distractor px", fontsize=9)
    cover.hist([100 * m.counts.occlusion for m in measured], bins=12, color=plot_colour(LOCAL))
    cover.set_xlabel("% of a photo covered", fontsize=9)
    cosines = [c for m in measured if not math.isnan(c := sem.photo_cosine(m.matches))]
    look.hist(cosines, bins=24, range=(-0.2, 1.0), color=plot_colour(NEUTRAL))
    limit = seen.usual if seen.whitened else sem.AMBIGUOUS_ABOVE
    if not math.isnan(limit):
        look.axvline(limit, color="k", ls="--", lw=1)
    what = "95 % of static regions reach" if seen.whitened else "limit"
    look.set_xlabel(f"cosine of the most similar distractor ({what} {limit:.2f})", fontsize=9)
    for axes in (cover, look):
        axes.set_ylabel("photos", fontsize=9)
    for axes in (colour, cover, look):
        axes.tick_params(labelsize=8)
