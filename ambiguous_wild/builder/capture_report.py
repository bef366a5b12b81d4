"""`aw screen`: read a capture, run its checks, write nothing. One photo a thread is in memory."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ambiguous_wild.builder.checks import Check, run_checks
from ambiguous_wild.builder.collect import Source, collect
from ambiguous_wild.builder.phone_photos import format_twins
from ambiguous_wild.builder.photo_comparison import (
    PhotoFeatures,
    candidate_pairs,
    compare_photos,
    photo_features,
)
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import CheckedPhoto, SkippedPhoto
from ambiguous_wild.builder.screen import copy_rows, photo_record, refuse_bad, thumbnail, without_copies
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.photos import UnreadablePhoto, read_photo


@dataclass(frozen=True)
class CaptureReport:
    """Result of the checks."""

    root: Path
    photos: int  # that can be read
    skipped: list[SkippedPhoto]  # unreadable files and copies
    checks: list[Check]

    @property
    def warnings(self) -> list[Check]:
        """The checks that failed."""
        return [c for c in self.checks if c.state == "warning"]


def check_capture(raw: Path | str, *, jobs: int = 1, bar: Bar | None = None) -> CaptureReport:
    """Check the capture in a folder of photos.

    Raises:
        AwError: no capture, or fewer readable photos than a scene needs.
    """
    bar = bar or Bar(False)
    capture = collect(raw, jobs)
    sources, copies = without_copies(capture)
    bar.start("reading photos", len(sources))

    def one(source: Source) -> tuple[CheckedPhoto, np.ndarray, PhotoFeatures] | SkippedPhoto:
        try:
            photo, pixels = read_photo(source.path)
        except UnreadablePhoto as error:
            return {"source": source.relative, "skipped": error.reason}
        finally:
            bar.step()
        record: CheckedPhoto = {**photo_record(source, photo, pixels), "noise": noise(pixels)}
        return record, thumbnail(pixels), photo_features(pixels)

    with ThreadPoolExecutor(jobs) as pool:
        rows = list(pool.map(one, sources))
    bar.finish()
    unreadable = [r for r in rows if not isinstance(r, tuple)]
    good = [r for r in rows if isinstance(r, tuple)]
    if not capture.has_sides:
        twins = format_twins([r for r, _, _ in good], np.stack([t for _, t, _ in good]) if good else None)
        good = [row for row in good if row[0]["source"] not in twins]
        copies = copies | twins
    refuse_bad(capture, unreadable, copies, len(good), False)
    skipped = [*unreadable, *copy_rows(copies)]
    features = [f for _, _, f in good]
    bar.start("comparing photos", len(candidate_pairs(features)))
    compared = compare_photos(features, bar.step, jobs)
    bar.finish()
    checks = run_checks([record for record, _, _ in good], np.stack([t for _, t, _ in good]), compared)
    if skipped:
        checks.insert(0, _files_check(skipped, len(capture.sources)))
    return CaptureReport(capture.root, len(good), skipped, checks)


def _files_check(skipped: list[SkippedPhoto], total: int) -> Check:
    """The failed check of a capture with photos that are left out."""
    first = f"{skipped[0]['source']} ({skipped[0]['skipped']})"
    finding = f"{len(skipped)} of {total} photos are left out: {first}"
    finding += f" and {len(skipped) - 1} more" if len(skipped) > 1 else ""
    names = tuple(s["source"] for s in skipped)
    return Check("files", "warning", "files", finding, "repair or remove them", names)


def refuse_failed(report: CaptureReport) -> None:
    """Raise AwError, in one line, with every check that failed."""
    if report.warnings:
        reasons = "; ".join(f"{c.name}: {c.finding} ({c.advice})" for c in report.warnings)
        raise AwError(
            f"{report.root} fails {len(report.warnings)} of {len(report.checks)} capture checks: {reasons}"
        )


def noise(
    rgb: np.ndarray,  # [H, W, 3] uint8
    block: int = 16,
) -> float:
    """Noise in the flattest tenth of the blocks, of 255; NaN where the photo is too small or clipped.

    Source: Immerkaer, CVIU 1996. His mask gives 0 on planes; clipped blocks are left out.
    """
    import cv2

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
