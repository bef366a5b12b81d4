"""Capture checks: what was locked, what drifted, which photos to leave out, and what to do about it.

Each check says on what it rests: EXIF where the camera wrote it, the pixels of shared surfaces where not,
and "unknown" where neither tells. Limits were set on captures that reconstruct well, see docs/capture.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from ambiguous_wild.builder.screen import BLUR_RATIO, NEAR_DUPLICATE, exposure_stops
from ambiguous_wild.builder.shared_points import Compared
from ambiguous_wild.core.errors import shortlist

State = Literal["ok", "warning", "unknown"]
EXIF_STOPS = 0.5  # stops between the darkest and the lightest setting
PIXEL_STOPS = 0.7  # stops between the 5th and 95th percentile photo, on the same surfaces
PIXEL_BALANCE = 0.4  # log2 of red or blue over green, the same percentiles: 32 %
ISO_RATIO = 2.0  # one stop
FOCAL_RATIO = 1.01
SOFT = -0.8  # log2 of fine detail on the same surfaces: below it a photo is soft where others are sharp
FOCUS_SPREAD = 1.2  # log2, the same percentiles: the focus moves
FORWARD = 0.6  # share of the overlapping pairs that differ by motion along the line of sight
MIN_PARTNERS = 2  # overlapping photos a photo needs


@dataclass(frozen=True)
class Check:
    """One row of the table."""

    name: str
    state: State
    basis: str  # EXIF, pixels, or what is missing
    finding: str  # with its number
    advice: str = ""  # what to do; empty where nothing is to be done
    photos: tuple[str, ...] = ()  # those it is about


def run_checks(
    facts: Sequence[dict[str, Any]],  # per photo, as `screen` returns them
    thumbnails: np.ndarray,  # [N, 1024], see `screen.thumbnail`
    compared: Compared,
) -> list[Check]:
    """The table, one row a check."""
    return [
        exposure(facts, compared),
        white_balance(facts, compared),
        iso(facts),
        focus(facts, compared),
        focal_length(facts),
        blur(facts, compared),
        near_duplicates(facts, thumbnails),
        overlap(facts, compared),
        motion(compared),
    ]


def exposure(facts: Sequence[dict[str, Any]], compared: Compared) -> Check:
    """Exposure time, aperture and ISO together as stops; else brightness of the same surfaces."""
    advice = "lock exposure (hold the finger on the screen: AE/AF lock), or train with an appearance model"
    stops = [exposure_stops(f["exif"]) for f in facts]
    spread = _spread(compared, 0)
    if all(s is not None for s in stops):
        span = max(s for s in stops if s is not None) - min(s for s in stops if s is not None)
        if span <= EXIF_STOPS:
            return Check("exposure", "ok", "EXIF", f"locked: settings span {span:.1f} stops")
        if spread is None:
            return Check("exposure", "warning", "EXIF", f"drifts: settings span {span:.1f} stops", advice)
        # Settings may follow the light, as under clouds: what harms is a surface that changes its brightness.
        finding = f"automatic: settings span {span:.1f} stops, the same surfaces differ by {spread:.1f}"
        return _row("exposure", "EXIF and pixels", spread > PIXEL_STOPS, finding, advice)
    if spread is None:
        return Check("exposure", "unknown", _silent(facts, stops), "no shared surfaces to measure on")
    finding = f"the same surfaces differ by {spread:.1f} stops"
    return _row("exposure", _basis(stops), spread > PIXEL_STOPS, finding, advice)


def white_balance(facts: Sequence[dict[str, Any]], compared: Compared) -> Check:
    """Manual in every photo is locked; automatic or silent is measured."""
    advice = "lock white balance (manual, or a fixed preset), or train with an appearance model"
    modes = [f["exif"].get("white_balance") for f in facts]
    if all(m == 1 for m in modes):
        return Check("white balance", "ok", "EXIF", "manual in every photo")
    said = "EXIF: automatic" if any(m == 0 for m in modes) else "EXIF silent"
    red, blue = _spread(compared, 1), _spread(compared, 2)
    if red is None or blue is None:
        return Check("white balance", "unknown", said, "no shared surfaces to measure on", advice)
    worst = 100 * (2 ** max(red, blue) - 1)
    finding = f"red or blue of the same surfaces differs by {worst:.0f} %"
    return _row("white balance", f"pixels ({said})", max(red, blue) > PIXEL_BALANCE, finding, advice)


def iso(facts: Sequence[dict[str, Any]]) -> Check:
    """ISO by EXIF; without it the noise of flat areas."""
    advice = "fix ISO (pro mode), as low as the light allows"
    values = [f["exif"].get("iso") for f in facts]
    known = [v for v in values if v is not None]
    if len(known) == len(values):
        finding = (
            f"{min(known):.0f} to {max(known):.0f}"
            if max(known) > min(known)
            else f"{known[0]:.0f} throughout"
        )
        return _row("ISO", "EXIF", max(known) > ISO_RATIO * min(known), finding, advice)
    noise = np.array([f["noise"] for f in facts])
    if not np.isfinite(noise).any() or np.nanmedian(noise) <= 0:
        return Check("ISO", "unknown", _silent(facts, values), "no flat areas to measure noise in")
    low, high = np.nanpercentile(noise, [5, 95])
    finding = f"not recorded; noise of flat areas {low:.1f} to {high:.1f} of 255"
    # Noise in flat areas also holds texture and compression: it cannot accuse, so it never warns.
    return Check("ISO", "unknown", "pixels (EXIF silent)", finding, "")


def focus(facts: Sequence[dict[str, Any]], compared: Compared) -> Check:
    """Fine detail on the same surfaces, photo against photo; EXIF does not say where the focus was."""
    spread = _spread(compared, 3)
    if spread is None:
        return Check("focus", "unknown", "pixels", "no shared surfaces to measure on")
    finding = f"fine detail of the same surfaces differs by a factor of {2**spread:.1f}"
    return _row(
        "focus", "pixels", spread > FOCUS_SPREAD, finding, "lock focus (AE/AF lock), keep one distance"
    )


def focal_length(facts: Sequence[dict[str, Any]]) -> Check:
    """One focal length per camera and one picture size: what a single-camera model assumes."""
    advice = "do not zoom; or build with --camera per-image"
    spans = []
    for camera in sorted({f["camera"] or "" for f in facts}):
        values = [
            f["exif"]["focal_mm"] for f in facts if (f["camera"] or "") == camera and "focal_mm" in f["exif"]
        ]
        if values and max(values) > FOCAL_RATIO * min(values):
            spans.append(f"{camera or 'camera'}: {min(values):.1f} to {max(values):.1f} mm")
    if spans:
        return Check("focal length", "warning", "EXIF", shortlist(spans, 3), advice)
    silent = [f["source"] for f in facts if "focal_mm" not in f["exif"]]
    sizes = len({(f["width"], f["height"]) for f in facts})
    cameras = len({f["camera"] for f in facts if f["camera"]})
    several = f"; {sizes} picture sizes" if sizes > 1 else ""
    if silent:
        state: State = "warning" if sizes > 2 else "unknown"
        what = f"not recorded in {len(silent)} of {len(facts)} photos{several}"
        return Check(
            "focal length", state, "EXIF silent", what, "build with --camera per-image" if sizes > 2 else ""
        )
    return Check("focal length", "ok", "EXIF", f"one per camera ({cameras or 1}){several}")


def blur(facts: Sequence[dict[str, Any]], compared: Compared) -> Check:
    """Photos far softer than the capture, or softer than others on the same surfaces."""
    sharp = np.array([f["blur"] for f in facts])
    soft = sharp < BLUR_RATIO * np.median(sharp)
    soft |= np.nan_to_num(compared.offsets[:, 3], nan=0.0) < SOFT
    names = tuple(f["source"] for f, s in zip(facts, soft) if s)
    finding = f"{len(names)} of {len(facts)} photos are soft: {shortlist(names, 3)}" if names else "all sharp"
    return _row("blur", "pixels", bool(names), finding, "leave these out or take them again, slower", names)


def near_duplicates(facts: Sequence[dict[str, Any]], thumbnails: np.ndarray) -> Check:
    """Pairs of photos that are one photo twice."""
    close = np.triu(thumbnails @ thumbnails.T > NEAR_DUPLICATE, k=1)
    pairs = [(facts[i]["source"], facts[j]["source"]) for i, j in np.argwhere(close)]
    names = tuple(b for _, b in pairs)
    listed = shortlist([f"{a} = {b}" for a, b in pairs], 2)
    finding = f"{len(pairs)} pairs: {listed}" if pairs else "none"
    return _row(
        "near-duplicates", "pixels", bool(pairs), finding, "leave one of each out; step between photos", names
    )


def overlap(facts: Sequence[dict[str, Any]], compared: Compared) -> Check:
    """Whether the photos hang together: groups of overlapping photos, and photos with few partners."""
    count = len(facts)
    apart = [f["source"] for f, g in zip(facts, compared.group) if g != 0]
    advice = "take more photos between these, each sharing two thirds of the picture with the next"
    if apart:
        groups = int(compared.group.max()) + 1
        finding = f"{len(apart)} of {count} photos do not hang together with the rest ({groups} groups): "
        finding += shortlist(apart, 3)
        return Check("overlap", "warning", "pixels", finding, advice, tuple(apart))
    few = [f["source"] for f, p in zip(facts, compared.partners) if p < min(MIN_PARTNERS, count - 1)]
    median = float(np.median(compared.partners))
    finding = f"each overlaps with {median:.0f} others (median)"
    if few:
        finding = (
            f"{len(few)} of {count} photos overlap with fewer than {MIN_PARTNERS} others: {shortlist(few, 3)}"
        )
    return _row("overlap", "pixels", bool(few), finding, advice, tuple(few))


def motion(compared: Compared) -> Check:
    """Whether the camera went where it looked: such photos overlap and yet give no depth."""
    if math.isnan(compared.forward):
        return Check("motion", "unknown", "pixels", "no overlapping photos to measure on")
    finding = f"{100 * compared.forward:.0f} % of overlapping pairs differ by motion along the line of sight"
    advice = "walk sideways or around the subject: along the line of sight there is no parallax"
    return _row("motion", "pixels", compared.forward > FORWARD, finding, advice)


def _row(name: str, basis: str, bad: bool, finding: str, advice: str, photos: tuple[str, ...] = ()) -> Check:
    return Check(name, "warning" if bad else "ok", basis, finding, advice if bad else "", photos)


def _spread(compared: Compared, quantity: int) -> float | None:
    """Log2 between the 5th and 95th percentile photo; None where fewer than three photos were compared."""
    values = compared.offsets[:, quantity]
    values = values[np.isfinite(values)]
    if len(values) < 3:
        return None
    low, high = np.percentile(values, [5, 95])
    return float(high - low) if math.isfinite(high - low) else None


def _basis(values: Sequence[Any]) -> str:
    missing = sum(v is None for v in values)
    return "pixels (EXIF silent)" if missing == len(values) else f"pixels (EXIF silent in {missing} photos)"


def _silent(facts: Sequence[dict[str, Any]], values: Sequence[Any]) -> str:
    return f"EXIF silent in {sum(v is None for v in values)} of {len(facts)} photos"
