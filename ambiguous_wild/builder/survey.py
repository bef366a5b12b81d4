"""Read a capture for its checks: nothing is written, one photo a thread is in memory."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.builder.checks import Check, run_checks
from ambiguous_wild.builder.collect import Source, collect
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.screen import photo_facts, refuse_bad, thumbnail, without_copies
from ambiguous_wild.builder.shared_points import Signature, compare, partners_of, signature
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io.photos import UnreadablePhoto, read_photo


@dataclass(frozen=True)
class Survey:
    """What the checks found."""

    root: Path
    photos: int  # that can be read
    skipped: list[dict[str, Any]]  # source and why: unreadable, or a copy
    checks: list[Check]

    @property
    def warnings(self) -> list[Check]:
        """The checks that failed."""
        return [c for c in self.checks if c.state == "warning"]


def survey(raw: Path | str, *, jobs: int = 1, bar: Bar | None = None) -> Survey:
    """Check the capture in a folder of photos.

    Raises:
        AwError: no capture, or fewer photos than a scene needs can be read.
    """
    bar = bar or Bar(False)
    capture = collect(raw, jobs)
    sources, copies = without_copies(capture)
    bar.start("reading photos", len(sources))

    def one(source: Source) -> tuple[dict[str, Any], np.ndarray, Signature] | dict[str, Any]:
        try:
            photo, pixels = read_photo(source.path)
        except UnreadablePhoto as error:
            return {"source": source.relative, "skipped": error.reason}
        finally:
            bar.step()
        facts = photo_facts(source, photo, pixels) | {"noise": noise(pixels)}
        return facts, thumbnail(pixels), signature(pixels)

    with ThreadPoolExecutor(jobs) as pool:
        rows = list(pool.map(one, sources))
    bar.finish()
    skipped = [r for r in rows if isinstance(r, dict)]
    good = [r for r in rows if not isinstance(r, dict)]
    refuse_bad(capture, skipped, copies, len(good), False)
    skipped += [{"source": c, "skipped": f"the same file as {kept}"} for c, kept in copies.items()]
    signatures = [s for _, _, s in good]
    bar.start("comparing photos", len(partners_of(signatures)))
    compared = compare(signatures, bar.step)
    bar.finish()
    checks = run_checks([f for f, _, _ in good], np.stack([t for _, t, _ in good]), compared)
    if skipped:
        names = tuple(s["source"] for s in skipped)
        first = f"{skipped[0]['source']} ({skipped[0]['skipped']})"
        finding = f"{len(skipped)} of {len(capture.sources)} photos are left out: {first}"
        finding += f" and {len(skipped) - 1} more" if len(skipped) > 1 else ""
        checks.insert(0, Check("files", "warning", "files", finding, "mend or remove them", names))
    return Survey(capture.root, len(good), skipped, checks)


def refuse(found: Survey) -> None:
    """Raise AwError if a check failed: names them all in one line."""
    if found.warnings:
        reasons = "; ".join(f"{c.name}: {c.finding} ({c.advice})" for c in found.warnings)
        raise AwError(
            f"{found.root} fails {len(found.warnings)} of {len(found.checks)} capture checks: {reasons}"
        )


def noise(
    rgb: np.ndarray,  # [H, W, 3] uint8
    block: int = 16,
) -> float:
    """Noise of the flattest tenth of the blocks, of 255; NaN where the photo is too small or clipped.

    Immerkaer's mask (CVIU 1996), which plane slopes pass through as 0, over blocks that are not clipped.
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
