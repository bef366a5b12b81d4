"""`aw screen`: check a capture for drifting camera settings and photos to leave out, and advise.

It reads a capture and writes nothing; one photo a thread is in memory. A check uses EXIF where the camera
wrote it, else the pixels of surfaces that several photos show; where neither decides, its state is "unknown".
The limits were set on captures that reconstruct well: docs/capture.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from ambiguous_wild.builder.capture_map import CaptureMap, component_gaps, map_of_photos
from ambiguous_wild.builder.collect import collect
from ambiguous_wild.builder.fixed_to_camera import area_text
from ambiguous_wild.builder.overlap_graph import FEW_COVISIBLE, GrowthForecast, Link, predict_growth
from ambiguous_wild.builder.photo_comparison import (
    PhotoComparison,
    compare_photos,
    photo_features,
)
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import ScreenedPhoto, SkippedPhoto
from ambiguous_wild.builder.screen import (
    BLUR_RATIO,
    exposure_stops,
    near_duplicate_pairs,
    panorama_warnings,
    photo_warnings,
    read_capture,
    zoomed_cameras,
)
from ambiguous_wild.core.errors import AwError, shortlist

State = Literal["ok", "warning", "unknown"]
EXIF_STOPS = 0.5  # stops between the darkest and the lightest setting
PIXEL_STOPS = 0.7  # stops between the 5th and 95th percentile photo, on the same surfaces
PIXEL_BALANCE = 0.4  # log2 of red or blue over green, the same percentiles: 32 %
ISO_RATIO = 2.0  # one stop
SOFT = -0.8  # log2 of fine detail on the same surfaces: a photo below it is softer than the others
FOCUS_SPREAD = 1.2  # log2, the same percentiles
# Share of the overlapping pairs that differ by motion along the line of sight: 0.9 in a walk down a street,
# where depth is imprecise; 0.58 in internet photos of unequal lenses and below 0.5 in others.
FORWARD = 0.8


@dataclass(frozen=True)
class CaptureCheck:
    """Result of one check."""

    name: str
    state: State
    basis: str  # EXIF, pixels, or what is missing
    finding: str  # what was measured, with its figure
    advice: str = ""  # empty where nothing is to be done
    photos: tuple[str, ...] = ()  # photos that fail


def run_checks(
    photos: Sequence[ScreenedPhoto],
    noises: Sequence[float],  # see `noise`
    thumbnails: np.ndarray,  # [N, 1024], see `screen.thumbnail`
    compared: PhotoComparison,
    growth: GrowthForecast,
    gaps: Sequence[tuple[int, int]],  # of `component_gaps`
) -> list[CaptureCheck]:
    """Run all checks, in the order of the table."""
    return [
        exposure(photos, compared),
        white_balance(photos, compared),
        iso(photos, noises),
        focus(photos, compared),
        focal_length(photos),
        blur(photos, compared),
        near_duplicates(photos, thumbnails),
        overlap(photos, compared, growth, gaps),
        motion(compared),
        fixed_to_camera(compared),
    ]


def exposure(photos: Sequence[ScreenedPhoto], compared: PhotoComparison) -> CaptureCheck:
    """Compare exposure settings in stops, and the brightness of the same surfaces."""
    advice = "lock exposure (hold the finger on the screen: AE/AF lock), or train with an appearance model"
    stops = [exposure_stops(photo.exif) for photo in photos]
    spread = _spread(compared, 0)
    if all(s is not None for s in stops):
        span = max(s for s in stops if s is not None) - min(s for s in stops if s is not None)
        if span <= EXIF_STOPS:
            return CaptureCheck("exposure", "ok", "EXIF", f"locked: settings span {span:.1f} stops")
        if spread is None:
            return CaptureCheck(
                "exposure", "warning", "EXIF", f"drifts: settings span {span:.1f} stops", advice
            )
        # Settings may follow the light, as under clouds; only a surface that changes brightness is harmful.
        finding = f"automatic: settings span {span:.1f} stops, the same surfaces differ by {spread:.1f}"
        return _row("exposure", "EXIF and pixels", spread > PIXEL_STOPS, finding, advice)
    if spread is None:
        return CaptureCheck(
            "exposure", "unknown", _silent(photos, stops), "no two photos share enough surface to measure it"
        )
    finding = f"the same surfaces differ by {spread:.1f} stops"
    return _row("exposure", _basis(stops), spread > PIXEL_STOPS, finding, advice)


def white_balance(photos: Sequence[ScreenedPhoto], compared: PhotoComparison) -> CaptureCheck:
    """Check that white balance is locked: by EXIF if manual in every photo, else on the same surfaces."""
    advice = "lock white balance (manual, or a fixed preset), or train with an appearance model"
    modes = [photo.exif.get("white_balance") for photo in photos]
    if all(m == 1 for m in modes):
        return CaptureCheck("white balance", "ok", "EXIF", "manual in every photo")
    source = "EXIF: automatic" if any(m == 0 for m in modes) else "EXIF silent"
    red, blue = _spread(compared, 1), _spread(compared, 2)
    if red is None or blue is None:
        return CaptureCheck(
            "white balance", "unknown", source, "no two photos share enough surface to measure it", advice
        )
    worst = 100 * (2 ** max(red, blue) - 1)
    finding = f"red or blue of the same surfaces differs by {worst:.0f} %"
    return _row("white balance", f"pixels ({source})", max(red, blue) > PIXEL_BALANCE, finding, advice)


def iso(
    photos: Sequence[ScreenedPhoto],
    noises: Sequence[float],  # see `noise`
) -> CaptureCheck:
    """Compare ISO by EXIF; without EXIF report the noise of flat areas."""
    advice = "fix ISO (pro mode), as low as the light allows"
    values = [photo.exif.get("iso") for photo in photos]
    recorded = [v for v in values if v is not None]
    if len(recorded) == len(values):
        finding = (
            f"{min(recorded):.0f} to {max(recorded):.0f}"
            if max(recorded) > min(recorded)
            else f"{recorded[0]:.0f} throughout"
        )
        return _row("ISO", "EXIF", max(recorded) > ISO_RATIO * min(recorded), finding, advice)
    if not np.isfinite(noises).any() or np.nanmedian(noises) <= 0:
        return CaptureCheck(
            "ISO", "unknown", _silent(photos, values), "no flat areas in which to measure noise"
        )
    low, high = np.nanpercentile(noises, [5, 95])
    finding = f"not recorded; noise of flat areas {low:.1f} to {high:.1f} of 255"
    # Texture and compression look like noise, so this is not certain enough for a warning.
    return CaptureCheck("ISO", "unknown", "pixels (EXIF silent)", finding, "")


def focus(photos: Sequence[ScreenedPhoto], compared: PhotoComparison) -> CaptureCheck:
    """Compare fine detail of the same surfaces across photos; EXIF does not record the focus."""
    spread = _spread(compared, 3)
    if spread is None:
        return CaptureCheck("focus", "unknown", "pixels", "no two photos share enough surface to measure it")
    finding = f"fine detail of the same surfaces differs by a factor of {2**spread:.1f}"
    return _row(
        "focus", "pixels", spread > FOCUS_SPREAD, finding, "lock focus (AE/AF lock), keep one distance"
    )


def focal_length(photos: Sequence[ScreenedPhoto]) -> CaptureCheck:
    """Check for one focal length per camera and one picture size, as a single-camera model assumes."""
    if wide := panorama_warnings(photos):
        return CaptureCheck("focal length", "warning", "picture size", wide[0])
    advice = "do not zoom; or build with --camera per-image"
    spans = [
        f"{camera or 'camera'}: {shortest:.1f} to {longest:.1f} mm"
        for camera, (shortest, longest) in zoomed_cameras(photos).items()
    ]
    if spans:
        return CaptureCheck("focal length", "warning", "EXIF", shortlist(spans, 3), advice)
    silent = [photo.source for photo in photos if "focal_mm" not in photo.exif]
    sizes = len({photo.size for photo in photos})
    cameras = len({photo.camera for photo in photos if photo.camera})
    several = f"; {sizes} picture sizes" if sizes > 1 else ""
    if silent:
        state: State = "warning" if sizes > 2 else "unknown"
        what = f"not recorded in {len(silent)} of {len(photos)} photos{several}"
        return CaptureCheck(
            "focal length", state, "EXIF silent", what, "build with --camera per-image" if sizes > 2 else ""
        )
    return CaptureCheck("focal length", "ok", "EXIF", f"one per camera ({cameras or 1}){several}")


def blur(photos: Sequence[ScreenedPhoto], compared: PhotoComparison) -> CaptureCheck:
    """Find photos much softer than the median, or softer than others on the same surfaces."""
    sharp = np.array([photo.sharpness for photo in photos])
    soft = sharp < BLUR_RATIO * np.median(sharp)
    soft |= np.nan_to_num(compared.offsets[:, 3], nan=0.0) < SOFT
    names = tuple(photo.source for photo, s in zip(photos, soft) if s)
    finding = (
        f"{len(names)} of {len(photos)} photos are soft: {shortlist(names, 3)}" if names else "all sharp"
    )
    return _row(
        "blur",
        "pixels",
        bool(names),
        finding,
        "leave these out, or take them again with a steadier hand",
        names,
    )


def near_duplicates(photos: Sequence[ScreenedPhoto], thumbnails: np.ndarray) -> CaptureCheck:
    """Find pairs of photos that are nearly the same picture."""
    pairs = [(photos[i].source, photos[j].source) for i, j in near_duplicate_pairs(thumbnails)]
    names = tuple(b for _, b in pairs)
    listed = shortlist([f"{a} = {b}" for a, b in pairs], 2)
    finding = f"{len(pairs)} pairs: {listed}" if pairs else "none"
    return _row(
        "near-duplicates",
        "pixels",
        bool(pairs),
        finding,
        "leave one of each pair out; move between photos",
        names,
    )


def overlap(
    photos: Sequence[ScreenedPhoto],
    compared: PhotoComparison,
    growth: GrowthForecast,
    gaps: Sequence[tuple[int, int]],  # of `component_gaps`
) -> CaptureCheck:
    """Predict how many photos will be registered, and name those that share too little with the others."""
    names, count = [photo.source for photo in photos], len(photos)
    if not growth.components:
        finding = "no three photos share enough features: none will be registered" + _few_pairs(compared)
        advice = "take more photos, each sharing two thirds of the picture with the next"
        return CaptureCheck("overlap", "warning", "pixels", finding, advice, tuple(names))
    main = growth.components[0]
    if len(main) == count:
        median = float(np.median(compared.covisible))
        finding = f"each overlaps with {median:.0f} others (median); all {count} photos will be registered"
        return CaptureCheck("overlap", "ok", "pixels", finding)
    finding = f"about {len(main)} of {count} photos will be registered"
    if len(growth.components) > 1:
        finding += f"; parts: {', '.join(str(len(component)) for component in growth.components)}"
    if growth.others:
        finding += "; the others share too few features with two photos at once: "
        finding += shortlist([names[k] for k in growth.others], 3)
    finding += _few_pairs(compared)
    pairs = [f"{names[a]} and {names[b]}" for a, b in gaps]
    advice = f"take 2 or 3 photos between {shortlist(pairs, 3)}"
    outside = tuple(names[k] for k in range(count) if k not in main)
    return CaptureCheck("overlap", "warning", "pixels", finding, advice, outside)


def _few_pairs(compared: PhotoComparison) -> str:
    """Return how many pairs overlap, if most photos overlap with too few others; else ""."""
    if float(np.median(compared.covisible)) >= FEW_COVISIBLE:
        return ""
    return f"; most pairs share too few features ({len(compared.links)} of {compared.pairs} share enough)"


def motion(compared: PhotoComparison) -> CaptureCheck:
    """Find motion along the viewing direction: such photos overlap but give little parallax."""
    if math.isnan(compared.forward):
        return CaptureCheck("motion", "unknown", "pixels", "no two photos overlap enough to measure it")
    finding = f"{100 * compared.forward:.0f} % of overlapping pairs differ by motion along the line of sight"
    advice = "walk sideways or around the subject too: motion along the line of sight leaves depth imprecise"
    return _row("motion", "pixels", compared.forward > FORWARD, finding, advice)


def fixed_to_camera(compared: PhotoComparison) -> CaptureCheck:
    """Find what stands still in the photos while the rest moves: a bonnet, a rig, a watermark."""
    if not compared.fixed:
        return CaptureCheck("fixed to camera", "ok", "pixels", "nothing stands still while the rest moves")
    shown = "; ".join(
        area_text(area.share, area.where())
        + (f" of {area.size[0]}x{area.size[1]}" if len(compared.fixed) > 1 else "")
        for area in compared.fixed
    )
    finding = f"{shown} stands still while the rest moves"
    advice = "aw build-scene masks it; take the photos without it (a bonnet, a rig, a stamp) if you can"
    return CaptureCheck("fixed to camera", "warning", "pixels", finding, advice)


def _row(
    name: str, basis: str, bad: bool, finding: str, advice: str, photos: tuple[str, ...] = ()
) -> CaptureCheck:
    return CaptureCheck(name, "warning" if bad else "ok", basis, finding, advice if bad else "", photos)


def _spread(compared: PhotoComparison, quantity: int) -> float | None:
    """Return log2 between 5th and 95th percentile photo; None for fewer than three compared photos."""
    values = compared.offsets[:, quantity]
    values = values[np.isfinite(values)]
    if len(values) < 3:
        return None
    low, high = np.percentile(values, [5, 95])
    return float(high - low) if math.isfinite(high - low) else None


def _basis(values: Sequence[Any]) -> str:
    missing = sum(v is None for v in values)
    return "pixels (EXIF silent)" if missing == len(values) else f"pixels (EXIF silent in {missing} photos)"


def _silent(photos: Sequence[ScreenedPhoto], values: Sequence[Any]) -> str:
    return f"EXIF silent in {sum(v is None for v in values)} of {len(photos)} photos"


@dataclass(frozen=True)
class CaptureReport:
    """Result of the checks."""

    root: Path
    photos: int  # readable photos
    skipped: list[SkippedPhoto]  # unreadable files and copies
    checks: list[CaptureCheck]
    sources: list[str]  # of the readable photos, in the order of capture
    links: list[Link]  # photos that overlap
    growth: GrowthForecast
    gaps: list[tuple[int, int]]  # photos between which more are needed

    @property
    def warnings(self) -> list[CaptureCheck]:
        """The checks that warn."""
        return [c for c in self.checks if c.state == "warning"]

    def overlap_map(self) -> CaptureMap:
        """Lay out the photos by their overlap."""
        return map_of_photos(self.sources, self.links, self.growth, self.gaps)


def check_capture(
    raw: Path | str | Sequence[Path | str], *, jobs: int = 1, bar: Bar | None = None
) -> CaptureReport:
    """Check the capture in a folder of photos.

    Raises:
        AwError: no capture, or fewer readable photos than a scene needs.
    """
    bar = bar or Bar(False)
    capture = collect(raw, jobs)
    for note in capture.notes:
        bar.say(note)
    read = read_capture(
        capture,
        lambda _, __, pixels: (noise(pixels), photo_features(pixels)),
        strict=False,
        jobs=jobs,
        bar=bar,
    )
    for line in photo_warnings(read.photos):
        bar.say(line)
    photos, noises = read.photos, [level for level, _ in read.more]
    features = [found for _, found in read.more]
    compared = compare_photos(features, bar, jobs)
    growth = predict_growth(len(photos), compared.matches)
    gaps = component_gaps(growth, compared.links)
    checks = run_checks(photos, noises, read.thumbnails, compared, growth, gaps)
    if read.skipped:
        checks.insert(0, _files_check(read.skipped, len(capture.sources)))
    names = [photo.source for photo in photos]
    return CaptureReport(capture.root, len(photos), read.skipped, checks, names, compared.links, growth, gaps)


def _files_check(skipped: list[SkippedPhoto], total: int) -> CaptureCheck:
    """Return the failed check of a capture with photos that are left out."""
    reasons = shortlist((f"{s['source']} ({s['skipped']})" for s in skipped), 3)
    finding = f"{len(skipped)} of {total} photos are left out: {reasons}"
    names = tuple(s["source"] for s in skipped)
    return CaptureCheck("files", "warning", "files", finding, "repair or remove them", names)


def refuse_failed(report: CaptureReport) -> None:
    """Raise AwError, in one line, with every check that warns."""
    if report.warnings:
        reasons = "; ".join(f"{c.name}: {c.finding} ({c.advice})" for c in report.warnings)
        raise AwError(
            f"{report.root}: {len(report.warnings)} of {len(report.checks)} capture checks warn: {reasons}"
        )


def noise(
    rgb: np.ndarray,  # [H, W, 3] uint8
    block: int = 16,
) -> float:
    """Estimate noise in the flattest tenth of the blocks, of 255; NaN if the photo is too small or clipped.

    Source: Immerkaer, CVIU 1996. His mask gives 0 on planes; clipped blocks are left out.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    h, w = (s // block * block for s in gray.shape)
    if min(h, w) == 0:
        return float("nan")
    response = np.abs(cv2.filter2D(gray, cv2.CV_32F, mask))[:h, :w]

    def means(values: np.ndarray) -> np.ndarray:
        return values.reshape(h // block, block, w // block, block).mean(axis=(1, 3)).ravel()

    level = means(gray[:h, :w])
    sigma = np.sqrt(np.pi / 2) / 6 * means(response)[(level > 8) & (level < 247)]
    return round(float(np.percentile(sigma, 10)), 3) if len(sigma) else float("nan")
