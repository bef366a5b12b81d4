"""Second stage: can each photo be read, and does the capture hold together?

Nothing is judged by eye alone: each warning carries the number it rests on.
"""

from __future__ import annotations

import dataclasses
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ambiguous_wild.builder.collect import MIN_PHOTOS, Capture, Source, identical
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.io.photos import Photo, UnreadablePhoto, read_photo

BLUR_SIDE = 1024  # px; blur is compared at one size, since the Laplacian grows with resolution
BLUR_RATIO = 0.2  # of the capture's median; below it a photo is called blurred
NEAR_DUPLICATE = 0.995  # correlation of 32 x 32 thumbnails
EXPOSURE_STOPS = 1.0
_THUMBNAIL = 32


def screen(capture: Capture, folder: Path, *, strict: bool, jobs: int, bar: Bar) -> dict[str, Any]:
    """Read every photo once; lay out `folder/photos` for structure from motion.

    A photo that other tools read as we do is a link to the user's file; any other is converted to PNG.

    Returns:
        Facts: per photo size, EXIF, blur and notes; what was skipped and why; warnings.

    Raises:
        AwError: `strict` and a photo cannot be read, or too few can.
    """
    photos = folder / "photos"
    photos.mkdir()
    sources, copies = without_copies(capture)
    bar.start("reading photos", len(sources))

    def one(source: Source) -> tuple[dict[str, Any], np.ndarray | None]:
        try:
            photo, pixels = read_photo(source.path)
        except UnreadablePhoto as error:
            return {"source": source.relative, "skipped": error.reason}, None
        finally:
            bar.step()
        facts = photo_facts(source, photo, pixels)
        facts["work_name"] = _lay_out(source, photo, pixels, photos)
        return facts, thumbnail(pixels)

    with ThreadPoolExecutor(jobs) as pool:
        rows = list(pool.map(one, sources))
    bar.finish()
    skipped = [r for r, _ in rows if "skipped" in r]
    good = [(r, t) for r, t in rows if t is not None]
    refuse_bad(capture, skipped, copies, len(good), strict)
    facts = [r for r, _ in good]
    for fact in facts:
        fact["copies"] = [copy for copy, kept in copies.items() if kept == fact["source"]]
    skipped = [*skipped, *_copy_rows(copies)]
    warnings = [
        *_skipped_warning(skipped, len(capture.sources)),
        *(f"{r['source']}: {n}" for r in facts for n in r["notes"]),
        *(_identical_warning(group) for group in identical(capture) if capture.has_sides),
        *_near_duplicates(facts, np.stack([t for _, t in good])),
        *drift_warnings(facts),
    ]
    return {"photos": facts, "skipped": skipped, "warnings": warnings}


def photo_facts(source: Source, photo: Photo, pixels: np.ndarray) -> dict[str, Any]:
    """What is recorded of one photo; `screen` adds the name structure from motion sees."""
    return {
        "source": source.relative,
        "stem": source.stem,
        "side": source.side,
        "sha256": source.sha256,
        "width": photo.width,
        "height": photo.height,
        "exif": {k: v for k, v in dataclasses.asdict(photo.exif).items() if v is not None},
        "camera": photo.exif.camera,
        "blur": round(sharpness(pixels), 3),
        "mean_luma": round(float(pixels.mean()), 2),
        "notes": list(photo.notes),
    }


def without_copies(capture: Capture) -> tuple[list[Source], dict[str, str]]:
    """The photos to use, and the copies left out: relative name -> the first file with the same bytes.

    Of two copies one could train and the other test, which would reward learning by heart. Where train/
    and test/ are the user's own, nothing is left out: both are kept and named in a warning.
    """
    if capture.has_sides:
        return list(capture.sources), {}
    first: dict[str, Source] = {}
    copies = {}
    for source in capture.sources:
        kept = first.setdefault(source.sha256, source)
        if kept is not source:
            copies[source.relative] = kept.relative
    return list(first.values()), copies


def sharpness(
    rgb: np.ndarray,  # [H, W, 3] uint8
) -> float:
    """Variance of the Laplacian of grey at `BLUR_SIDE` px (Pech-Pacheco et al., ICPR 2000)."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = BLUR_SIDE / max(gray.shape)
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def thumbnail(
    rgb: np.ndarray,  # [H, W, 3] uint8
) -> np.ndarray:  # [1024] float32, zero mean, unit length
    """The photo at 32 x 32 grey, normalised, so that a dot product is a correlation."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(gray, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA).astype(np.float32)
    small -= small.mean()
    return (small / max(float(np.linalg.norm(small)), 1e-6)).ravel()


def drift_warnings(facts: list[dict[str, Any]]) -> list[str]:
    """Blur outliers, and camera settings that changed within the capture."""
    found = []
    blur = np.array([f["blur"] for f in facts])
    limit = BLUR_RATIO * float(np.median(blur))
    soft = [f["source"] for f, b in zip(facts, blur) if b < limit]
    if soft:
        found.append(
            f"{len(soft)} photos are blurred (Laplacian variance under {limit:.0f}, a fifth of the "
            f"capture's median): {shortlist(soft)}"
        )
    stops = [s for f in facts if (s := exposure_stops(f["exif"])) is not None]
    if stops and max(stops) - min(stops) > EXPOSURE_STOPS:
        found.append(
            f"exposure settings span {max(stops) - min(stops):.1f} stops: appearance changes between photos"
        )
    balances = {f["exif"]["white_balance"] for f in facts if "white_balance" in f["exif"]}
    if len(balances) > 1:
        found.append("white balance is automatic in some photos and manual in others: colours may shift")
    for camera in sorted({f["camera"] for f in facts if f["camera"]}):
        focal = [f["exif"]["focal_mm"] for f in facts if f["camera"] == camera and "focal_mm" in f["exif"]]
        if focal and max(focal) > 1.01 * min(focal):
            found.append(f"{camera} was zoomed: {min(focal):.1f} to {max(focal):.1f} mm")
    if len({(f["width"], f["height"]) for f in facts}) > 1:
        found.append(f"photos have {len({(f['width'], f['height']) for f in facts})} different sizes")
    return found


def exposure_stops(exif: dict[str, Any]) -> float | None:
    """log2 of the light a setting lets in, t ISO / N^2, up to a constant; None if not recorded."""
    if "exposure_s" not in exif:
        return None
    return math.log2(exif["exposure_s"] * exif.get("iso", 100.0) / exif.get("f_number", 1.0) ** 2)


def _near_duplicates(facts: list[dict[str, Any]], thumbnails: np.ndarray) -> list[str]:
    close = np.triu(thumbnails @ thumbnails.T > NEAR_DUPLICATE, k=1)
    pairs = [
        f"{facts[i]['source']} = {facts[j]['source']}"
        for i, j in np.argwhere(close)
        if facts[i]["sha256"] != facts[j]["sha256"]
    ]
    if not pairs:
        return []
    return [
        f"{len(pairs)} near-duplicate pairs add little (thumbnails correlate over {NEAR_DUPLICATE}): "
        f"{shortlist(pairs, 3)}"
    ]


def _lay_out(source: Source, photo: Photo, pixels: np.ndarray, folder: Path) -> str:
    if photo.plain:
        (folder / source.work_name).symlink_to(source.path)
        return source.work_name
    import OpenImageIO as oiio

    # Through OpenImageIO so that the EXIF focal length travels along: COLMAP starts from it.
    name = source.stem + ".png"
    original = oiio.ImageBuf(str(photo.path)).spec()
    spec = oiio.ImageSpec(photo.width, photo.height, 3, "uint8")
    for attribute in original.extra_attribs:
        known = attribute.name.startswith("Exif:") or attribute.name in ("Make", "Model")
        if known and isinstance(attribute.value, (str, int, float)):
            spec.attribute(attribute.name, attribute.value)  # with its uint16 type it would be dropped
    output = oiio.ImageOutput.create(str(folder / name))
    if output is None or not output.open(str(folder / name), spec) or not output.write_image(pixels):
        reason = oiio.geterror() if output is None else output.geterror()
        raise AwError(f"cannot convert {source.relative} to PNG: {' '.join(reason.split())}")
    output.close()
    return name


def _identical_warning(group: list[str]) -> str:
    sides = {name.partition("/")[0] for name in group}
    leak = ": one trains and one tests, so its score rewards learning by heart" if len(sides) > 1 else ""
    return f"identical files: {shortlist(group)}{leak}"


def _copy_rows(copies: dict[str, str]) -> list[dict[str, Any]]:
    return [{"source": copy, "skipped": f"the same file as {kept}"} for copy, kept in copies.items()]


def refuse_bad(
    capture: Capture, skipped: list[dict[str, Any]], copies: dict[str, str], good: int, strict: bool
) -> None:
    """Raise AwError where a photo cannot be read and `strict`, or too few can."""
    reasons = shortlist([f"{r['source']} ({r['skipped']})" for r in skipped], 4)
    total = len(capture.sources)
    if skipped and strict:
        raise AwError(
            f"{len(skipped)} of {total} photos cannot be read: {reasons}; mend or remove them, or leave "
            "out --strict to go on without them"
        )
    if good < MIN_PHOTOS:
        reasons = shortlist([f"{r['source']} ({r['skipped']})" for r in [*skipped, *_copy_rows(copies)]], 4)
        raise AwError(
            f"only {good} of {total} photos in {capture.root} can be used, {MIN_PHOTOS} are needed: {reasons}"
        )


def _skipped_warning(skipped: list[dict[str, Any]], total: int) -> list[str]:
    if not skipped:
        return []
    reasons = shortlist([f"{r['source']} ({r['skipped']})" for r in skipped])
    return [f"{len(skipped)} of {total} photos skipped: {reasons}"]
