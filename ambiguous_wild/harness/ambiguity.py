"""Measure a scene's ambiguity and write the report: page, picture, CSV, JSON."""

from __future__ import annotations

import csv
import html
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.atomic import atomic_path, write_json, write_text
from ambiguous_wild.io.images import load_image_float, read_gray
from ambiguous_wild.metrics import ambiguity as am

BINS = np.linspace(0.0, math.sqrt(3.0), 53)  # of the residual; 0.3 is on no edge, so counts are kept apart
Bar = Callable[[list[View]], Iterable[View]]


@dataclass(frozen=True)
class Measured:
    """One training photo."""

    name: str
    counts: am.ColourCounts
    histogram: np.ndarray  # [52] int64, residual over the known distractor pixels
    semantic: float  # cosine; NaN where undefined
    semantic_px: int  # pixels of the regions it rests on


def find_masks(scene: Scene, folder: Path | None) -> dict[str, Path]:
    """Distractor masks of the training photos, by the photo's name: the user's folder, else the truth.

    Raises:
        AwError: there is none, or photos lack theirs.
    """
    where = folder if folder is not None else scene.root / "truth" / "distractor"
    if not where.is_dir():
        raise AwError(
            f"{scene.name} has no truth at {where}: give distractor masks with --masks DIR "
            "(PNG of the photo's stem, white (255) = distractor), or build from an 'aw simulate' capture"
        )
    found = {v.name: where / f"{_stem(v)}.png" for v in scene.train}
    missing = [name for name, path in found.items() if not path.is_file()]
    if missing:
        raise AwError(
            f"{len(missing)} of {len(found)} train photos have no mask in {where}: {shortlist(missing)}; "
            "add them (all black where nobody stands)"
        )
    return found


def measure(scene: Scene, masks: dict[str, Path], progress: Bar = iter) -> list[Measured]:
    """Score every training photo; photos without a clean version count as of unknown background."""
    import torch
    from scipy import ndimage

    from ambiguous_wild.vision.labhog import LabHog
    from ambiguous_wild.vision.segments import GraphSegments

    views = list(scene.train)
    photos = {v.name: load_image_float(v.image_path) for v in views}
    features = LabHog()
    features.fit([torch.from_numpy(photos[v.name]) for v in views])
    grids = {v.name: features(torch.from_numpy(photos[v.name])).numpy() for v in views}
    mean, spread = am.channel_statistics(list(grids.values()))
    segments = GraphSegments()
    measured = []
    for view in progress(views):
        photo = photos[view.name]
        distractor = load_mask(masks[view.name], view)
        background = load_clean(scene, view)
        counts = am.colour_counts(photo, background, distractor)
        regions, _ = ndimage.label(distractor)
        matches = am.semantic_matches(
            (grids[view.name] - mean) / spread, regions, segments.labels(torch.from_numpy(photo))
        )
        residual = (
            am.colour_residual(photo, background)[distractor] if background is not None else np.empty(0)
        )
        measured.append(
            Measured(
                view.name,
                counts,
                np.histogram(residual, BINS)[0],
                am.semantic_cosine(matches),
                sum(m.pixels for m in matches),
            )
        )
    return measured


def load_mask(path: Path, view: View) -> np.ndarray:
    """A distractor mask at the photo's size, [H, W] bool; another size of the same shape is resampled.

    Raises:
        AwError: unreadable, or of another shape than the photo.
    """
    import cv2

    mask = read_gray(path)
    width, height = view.camera.width, view.camera.height
    if mask.shape != (height, width):
        if abs(mask.shape[1] * height - mask.shape[0] * width) > 0.02 * mask.shape[1] * height:
            raise AwError(
                f"mask {path} is {mask.shape[1]}x{mask.shape[0]}, its photo {width}x{height}: another shape; "
                "export it from the photo of the scene"
            )
        mask = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    return mask >= 128


def load_clean(scene: Scene, view: View) -> np.ndarray | None:
    """The photo with nobody there, [H, W, 3] float32 in [0, 1]; None where the scene has none.

    Raises:
        AwError: it is of another size than the photo.
    """
    path = scene.root / "truth" / "clean" / f"{_stem(view)}.png"
    if not path.is_file():
        return None
    image = load_image_float(path)
    if image.shape[:2] != (view.camera.height, view.camera.width):
        raise AwError(
            f"{path} is {image.shape[1]}x{image.shape[0]}, its photo "
            f"{view.camera.width}x{view.camera.height}; load the factor it was built for, or build it again"
        )
    return image


def summarise(scene: Scene, measured: list[Measured], seed: int = 0) -> dict[str, Any]:
    """The scene's scores with 95 % intervals over photos; what is undefined is None."""
    total = am.pooled([m.counts for m in measured])
    colour = am.ratio_interval(
        [m.counts.close for m in measured], [m.counts.known for m in measured], seed=seed
    )
    cosines = [0.0 if math.isnan(m.semantic) else m.semantic * m.semantic_px for m in measured]
    semantic = am.ratio_interval(cosines, [m.semantic_px for m in measured], seed=seed)
    covered = am.ratio_interval(
        [m.counts.distractor for m in measured], [m.counts.pixels for m in measured], seed=seed
    )
    shares = [m.counts.occlusion for m in measured]
    return {
        "scene": scene.name,
        "photos": len(measured),
        "seed": seed,
        "occlusion": {**_interval(covered), "min": min(shares), "max": max(shares)},
        am.COLOUR_METRIC: {
            **_interval(colour),
            "ambiguous_above": am.COLOUR_AMBIGUOUS_ABOVE,
            "ambiguous": am.verdict(colour.mean, am.COLOUR_AMBIGUOUS_ABOVE),
            "mean_residual": _number(total.mean_residual),
            "distractor_px": total.distractor,
            "unknown_px": total.unknown,
        },
        am.SEMANTIC_METRIC: {
            **_interval(semantic),
            "ambiguous_above": am.SEMANTIC_AMBIGUOUS_ABOVE,
            "ambiguous": am.verdict(semantic.mean, am.SEMANTIC_AMBIGUOUS_ABOVE),
            "note": "weight-free features see looks, not meaning; the limit of 0.7 was stated for DINOv2",
        },
    }


def write_report(
    scene: Scene, masks: dict[str, Path], measured: list[Measured], summary: dict[str, Any], out: Path
) -> None:
    """Write photos.csv, ambiguity.json, ambiguity.png and index.html into `out`."""
    out.mkdir(parents=True, exist_ok=True)
    rows = [_row(m) for m in measured]
    with atomic_path(out / "photos.csv") as path, open(path, "w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    write_json(out / "ambiguity.json", {**summary, "per_photo": rows})
    _figure(scene, masks, measured, out / "ambiguity.png")
    write_text(out / "index.html", _page(summary, rows))


def _row(m: Measured) -> dict[str, Any]:
    return {
        "photo": m.name,
        "occlusion": _number(m.counts.occlusion),
        am.COLOUR_METRIC: _number(m.counts.close_share),
        "mean_residual": _number(m.counts.mean_residual),
        am.SEMANTIC_METRIC: _number(m.semantic),
        "distractor_px": m.counts.distractor,
        "unknown_px": m.counts.unknown,
    }


def _figure(scene: Scene, masks: dict[str, Path], measured: list[Measured], path: Path) -> None:
    """Four photos with the mask, their residual maps, and the scene's distributions."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    # Spread over the range of occlusion rather than the first four: what is easy and what is hard.
    order = sorted(range(len(measured)), key=lambda i: measured[i].counts.occlusion)
    chosen = [order[round(k)] for k in np.linspace(0, len(order) - 1, min(4, len(order)))]
    figure = Figure(figsize=(3.4 * max(len(chosen), 3), 6.2), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 12)
    for column, index in enumerate(chosen):
        view = scene.train[index]
        photo, mask = load_image_float(view.image_path), load_mask(masks[view.name], view)
        span = slice(12 * column // len(chosen), 12 * (column + 1) // len(chosen))
        top, below = figure.add_subplot(grid[0, span]), figure.add_subplot(grid[1, span])
        tinted = np.where(mask[..., None], 0.45 * photo + 0.55 * np.array([1.0, 0.15, 0.1]), photo)
        top.imshow(tinted)
        top.set_title(f"{view.name}: {100 * mask.mean():.0f} % covered", fontsize=8)
        background = load_clean(scene, view)
        if background is None or not mask.any():
            why = "no distractor" if background is not None else "background unknown"
            below.text(0.5, 0.5, why, ha="center", transform=below.transAxes)
        else:
            shown = np.where(mask, am.colour_residual(photo, background), np.nan)
            picture = below.imshow(shown, vmin=0, vmax=1, cmap="viridis")
            figure.colorbar(picture, ax=below, shrink=0.7)
        below.set_title("colour difference to the background", fontsize=8)
        for axes in (top, below):
            axes.set_xticks([])
            axes.set_yticks([])
    _histograms(figure, grid, measured)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})


def _histograms(figure: Any, grid: Any, measured: list[Measured]) -> None:
    colour, cover, look = (figure.add_subplot(grid[2, s]) for s in (slice(0, 4), slice(4, 8), slice(8, 12)))
    counts = np.sum([m.histogram for m in measured], axis=0)
    colour.stairs(counts / max(counts.sum(), 1), BINS, fill=True, color="#4c78a8")
    colour.axvline(am.COLOUR_THRESHOLD, color="k", ls="--", lw=1)
    colour.set_xlabel(f"colour difference (close: below {am.COLOUR_THRESHOLD})", fontsize=8)
    colour.set_ylabel("share of distractor px", fontsize=8)
    cover.hist([m.counts.occlusion for m in measured], bins=12, color="#f58518")
    cover.set_xlabel("covered share of a photo", fontsize=8)
    cosines = [m.semantic for m in measured if not math.isnan(m.semantic)]
    look.hist(cosines, bins=12, range=(-0.2, 1.0), color="#54a24b")
    look.axvline(am.SEMANTIC_AMBIGUOUS_ABOVE, color="k", ls="--", lw=1)
    look.set_xlabel(am.SEMANTIC_METRIC, fontsize=8)
    for axes in (cover, look):
        axes.set_ylabel("photos", fontsize=8)
    for axes in (colour, cover, look):
        axes.tick_params(labelsize=7)


_STYLE = (
    "body{font:15px sans-serif;max-width:75em;margin:2em auto;padding:0 1em}"
    "img{max-width:100%}td,th{padding:2px 9px;text-align:right}"
)


def _page(summary: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    def cell(value: Any) -> str:
        return html.escape(
            "missing" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)
        )

    head = "".join(f"<th>{html.escape(k)}</th>" for k in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{cell(v)}</td>" for v in row.values()) + "</tr>" for row in rows)
    lines = "".join(f"<li>{html.escape(line)}</li>" for line in describe(summary))
    title = html.escape(f"Ambiguity of {summary['scene']}")
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
        f'<h1>{title}</h1><ul>{lines}</ul><img src="ambiguity.png" alt="masks, residual maps, distributions">'
        f"<table><tr>{head}</tr>{body}</table></html>\n"
    )


def describe(summary: dict[str, Any]) -> list[str]:
    """The scores as sentences, for the terminal and the page."""
    colour, look, covered = summary[am.COLOUR_METRIC], summary[am.SEMANTIC_METRIC], summary["occlusion"]
    lines = [
        f"occlusion: {_percent(covered)} of a train photo, from {100 * covered['min']:.1f} to "
        f"{100 * covered['max']:.1f} %",
        f"colour: {_percent(colour)} of the distractor pixels are within {am.COLOUR_THRESHOLD} of their "
        f"background: {_word(colour)} (limit {100 * am.COLOUR_AMBIGUOUS_ABOVE:.0f} %)",
        f"semantic: cosine {_value(look)} to the most similar static region: {_word(look)} "
        f"(limit {am.SEMANTIC_AMBIGUOUS_ABOVE}; {look['note']})",
    ]
    if colour["unknown_px"]:
        share = 100 * colour["unknown_px"] / colour["distractor_px"]
        lines.append(
            f"the background of {share:.0f} % of the distractor pixels is unknown: left out of colour"
        )
    return lines


def _percent(score: dict[str, Any]) -> str:
    if score["value"] is None:
        return "missing"
    text = f"{100 * score['value']:.1f} %"
    return text if score["low"] is None else f"{text} [{100 * score['low']:.1f}, {100 * score['high']:.1f}]"


def _value(score: dict[str, Any]) -> str:
    if score["value"] is None:
        return "missing"
    text = f"{score['value']:.3f}"
    return text if score["low"] is None else f"{text} [{score['low']:.3f}, {score['high']:.3f}]"


def _word(score: dict[str, Any]) -> str:
    return {None: "no verdict", True: "AMBIGUOUS", False: "not ambiguous"}[score["ambiguous"]]


def _interval(interval: am.Interval) -> dict[str, float | None]:
    return {"value": _number(interval.mean), "low": _number(interval.low), "high": _number(interval.high)}


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(float(value), 6)


def _stem(view: View) -> str:
    return str(PurePosixPath(view.name).with_suffix(""))
