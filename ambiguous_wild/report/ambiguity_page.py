"""Write the ambiguity report's folder: one page that needs no other file, the picture, CSV and JSON."""

from __future__ import annotations

import html
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.harness.sheets import evenly_spaced
from ambiguous_wild.io.files import (
    atomic_dir,
    atomic_path,
    refuse_file,
    refuse_files_there,
    refuse_foreign_files,
    write_json,
    write_text,
)
from ambiguous_wild.io.images import load_image_float
from ambiguous_wild.io.page_parts import data_uri, jpeg_bytes, narrowed
from ambiguous_wild.io.palette import ADDED, LOCAL, MASKED, NEUTRAL, faded, plot_colour, ramp, tint
from ambiguous_wild.metrics import ambiguity as am
from ambiguous_wild.metrics import semantic as sem
from ambiguous_wild.report.ambiguity_measure import BINS, MeasuredScene, PhotoMeasures
from ambiguous_wild.report.ambiguity_summary import (
    NO_DISTRACTORS,
    PhotoRow,
    Summary,
    cosine_column,
    describe,
    doubts,
    row,
)
from ambiguous_wild.report.plain_formats import to_csv
from ambiguous_wild.report.table_layout import text_table
from ambiguous_wild.report.typeset import html_table

PHOTOS = 4
SIDE = 480  # px a picture in the figure at most
FILES = ("ambiguity.json", "ambiguity.png", "index.html", "photos.csv")
SHOWN = 8  # photos with maps on the page
WIDTH = 420  # px of a picture on the page
PAGE = Path(__file__).parent / "page"
_CLASSES = {
    "both": "ambiguous in colour and semantically",
    "colour": "ambiguous in colour",
    "semantic": "semantically ambiguous",
    "neither": "neither ambiguous in colour nor semantically",
    NO_DISTRACTORS: "no distractors",
}
_HEADS = {
    "photo": "photo",
    "occlusion": "covered",
    am.COLOUR_METRIC: "colour: close share",
    "mean_residual": "mean residual",
    "distractor_px": "distractor px",
    "unknown_px": "unknown px",
    "regions": "distractors",
    "told_by": "each revealed by",
}


def chosen(measured: list[PhotoMeasures], most: int = PHOTOS) -> list[int]:
    """Return indices of photos spread evenly over the range of occlusion, from little to much."""
    order = sorted(range(len(measured)), key=lambda i: measured[i].counts.occlusion)
    return evenly_spaced(order, most)


def overlay(photo: np.ndarray, distractor: np.ndarray) -> np.ndarray:
    """Return the photo [H, W, 3] in [0, 1] with its distractors tinted, as uint8."""
    return tint((255 * photo + 0.5).astype(np.uint8), distractor, MASKED)


def residual_picture(
    photo: np.ndarray, behind: np.ndarray, known: np.ndarray | None, distractor: np.ndarray
) -> np.ndarray:
    """Draw the residual of the distractors from 0 to 1 on the faded photo; dark grey = unknown."""
    shown = faded((255 * photo + 0.5).astype(np.uint8))
    residual = np.where(True if known is None else known, am.colour_residual(photo, behind), np.nan)
    shown[distractor] = ramp(residual, 0.0, 1.0)[distractor]
    return shown


def cosine_picture(cosines: np.ndarray | None, distractor: np.ndarray) -> np.ndarray | None:
    """Draw the cosine of every cell with the photo's largest distractor; distractors are outlined."""
    import cv2

    if cosines is None:
        return None
    height, width = distractor.shape
    shown = cv2.resize(ramp(1.0 - cosines, 0.0, 1.0), (width, height), interpolation=cv2.INTER_NEAREST)
    edges, _ = cv2.findContours(distractor.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(shown, edges, -1, (20, 20, 20), max(1, width // 240)))


def _maps(
    measured: MeasuredScene, index: int
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray | None, ...]]:
    """Return a photo, its mask, and three pictures of it: overlay, residual, cosine; None where unknown."""
    view = measured.scene.train[index]
    photo, distractor = load_image_float(view.image_path), measured.masks.load(view)
    behind, known = measured.background.load(index, view)
    residual = None if behind is None else residual_picture(photo, behind, known, distractor)
    cosine = cosine_picture(measured.cosine_map(index, photo), distractor)
    return photo, distractor, (overlay(photo, distractor), residual, cosine)


def write_figure(measured: MeasuredScene, path: Path) -> None:
    """Write the figure with photos, maps and histograms as PNG."""
    from matplotlib.figure import Figure

    picks = chosen(measured.photos)
    columns = max(len(picks), 3)
    figure = Figure(figsize=(3.6 * columns, 9.2), layout="constrained", dpi=110)
    grid = figure.add_gridspec(4, 12)
    for column, index in enumerate(picks):
        name = measured.scene.train[index].name
        _, distractor, pictures = _maps(measured, index)
        name = name if len(name) <= 28 else f"…{name[-27:]}"
        captions = [
            f"{name}: {100 * distractor.mean():.0f} % covered",
            "residual to the background",
            "cosine to the largest distractor",
        ]
        span = slice(12 * column // len(picks), 12 * (column + 1) // len(picks))
        for line, (picture, caption) in enumerate(zip(pictures, captions)):
            _panel(figure.add_subplot(grid[line, span]), picture, caption)
    _histograms(figure, grid, measured)
    _legend(figure)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})


def _panel(axes: Any, picture: np.ndarray | None, caption: str) -> None:
    import cv2

    axes.set_xticks([])
    axes.set_yticks([])
    # a photo may be called $x$, which is no formula
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


def _histograms(figure: Any, grid: Any, measured: MeasuredScene) -> None:
    colour, cover, look = (figure.add_subplot(grid[3, s]) for s in (slice(0, 4), slice(4, 8), slice(8, 12)))
    counts = np.sum([m.histogram for m in measured.photos], axis=0)
    colour.stairs(counts / max(counts.sum(), 1), BINS, fill=True, color=plot_colour(ADDED))
    colour.axvline(am.COLOUR_THRESHOLD, color="k", ls="--", lw=1)
    colour.set_xlabel(f"colour difference (close: below {am.COLOUR_THRESHOLD})", fontsize=9)
    colour.set_ylabel("share of distractor px", fontsize=9)
    cover.hist([100 * m.counts.occlusion for m in measured.photos], bins=12, color=plot_colour(LOCAL))
    cover.set_xlabel("% of a photo covered", fontsize=9)
    cosines = [c for m in measured.photos if not math.isnan(c := sem.photo_cosine(m.matches))]
    look.hist(cosines, bins=24, range=(-0.2, 1.0), color=plot_colour(NEUTRAL))
    limit = measured.usual if measured.whitened else sem.AMBIGUOUS_ABOVE
    if not math.isnan(limit):
        look.axvline(limit, color="k", ls="--", lw=1)
    what = "95 % of static regions reach" if measured.whitened else "limit"
    look.set_xlabel(f"cosine of the most similar distractor ({what} {limit:.2f})", fontsize=9)
    for axes in (cover, look):
        axes.set_ylabel("photos", fontsize=9)
    for axes in (colour, cover, look):
        axes.tick_params(labelsize=8)


def check_folder(folder: Path) -> None:
    """Raise AwError if the path is a file, or a folder with other files than a report."""
    refuse_file(folder)
    if folder.is_dir():
        refuse_foreign_files(folder, FILES)
        if not (folder / FILES[0]).is_file():
            refuse_files_there(folder, FILES)


def write_report(measured: MeasuredScene, summary: Summary, out: Path) -> None:
    """Write the report into `out`, complete or not at all; an earlier report is replaced."""
    metric = cosine_column(measured.features)
    rows = [row(m, metric) for m in measured.photos]
    with atomic_dir(out) as folder:
        write_text(folder / "photos.csv", to_csv(list(rows[0]), (r.values() for r in rows)))
        write_json(folder / "ambiguity.json", {**summary, "per_photo": rows})
        write_figure(measured, folder / "ambiguity.png")
        picture = (folder / "ambiguity.png").read_bytes()
        write_text(folder / "index.html", page(summary, rows, picture, list(_pictures(measured))))


def _pictures(measured: MeasuredScene) -> Iterator[tuple[str, list[tuple[str, bytes]]]]:
    """Yield the name and JPEGs (photo, overlay, residual, cosine) of each photo on the page."""
    captions = ("photo", "distractors", "difference in colour to the background",
                "similarity to the largest distractor")  # fmt: skip
    for index in sorted(chosen(measured.photos, SHOWN)):
        photo, _, maps = _maps(measured, index)
        images = zip(captions, ((255 * photo + 0.5).astype(np.uint8), *maps))
        jpegs = [(caption, jpeg_bytes(narrowed(i, WIDTH), 85)) for caption, i in images if i is not None]
        yield measured.scene.train[index].name, jpegs


def page(
    summary: Summary,
    rows: list[PhotoRow],
    picture: bytes,
    photos: list[tuple[str, list[tuple[str, bytes]]]],
) -> str:
    """Return the page, with every text of the scene escaped and every picture included."""
    title = html.escape(f"Ambiguity of {summary['scene']}")
    verdict = _CLASSES.get(summary["class"], f"class: {summary['class']}") + doubts(summary)
    lines = "".join(f"<li>{html.escape(line)}</li>" for line in describe(summary))
    sources = (
        f"{summary['photos']} train photos; masks: {summary['masks']}; background: {summary['background']}; "
        f"features: {summary['features']}; 95 % intervals by bootstrap over photos, seed {summary['seed']}"
    )
    shown = "".join(
        f"<h3>{html.escape(name)}</h3><div class=row>{''.join(_shown(name, *i) for i in images)}</div>"
        for name, images in photos
    )
    style = (PAGE / "ambiguity.css").read_text(encoding="utf-8")
    head = [_HEADS.get(key, "semantic: cosine") for key in rows[0]]
    table = html_table(text_table("", head, ([_cell(value) for value in r.values()] for r in rows)))
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{title}</title><style>\n{style}</style></head><body><h1>{title}</h1>"
        f"<p class=class>{html.escape(verdict)}</p><ul>{lines}</ul><p>{html.escape(sources)}</p>"
        "<h2>Photos</h2><p>From the left: the photo; its distractors in red; how much they differ from the "
        "background; how similar everything is to the largest distractor. Colours of the last two:</p>"
        "<div class=bar></div><div class=ends><span>similar</span>"
        f"<span>different</span></div>{shown}"
        f"<h2>Distributions</h2>{_image(picture, 'png', 'masks, maps and distributions')}"
        f"<h2>Every photo</h2><div class=wide>{table}</div></body></html>\n"
    )


def _shown(name: str, caption: str, data: bytes) -> str:
    picture = _image(data, "jpeg", f"{caption}, {name}")
    return f"<figure>{picture}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _image(data: bytes, kind: str, name: str) -> str:
    return f'<img alt="{html.escape(name)}" src="{data_uri(kind, data)}">'


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
