"""Second stage: read every photo, leave out damaged files and copies, warn of blur and changed settings.

What phones add is recognised too: one photo in two formats, bursts, videos of live photos. Every warning
states the number behind it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Generic, TypeVar, cast

import cv2
import numpy as np

from ambiguous_wild.builder.collect import MIN_PHOTOS, VIDEO_SUFFIXES, Capture, PhotoSource, identical
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import (
    ExifRecord,
    PhotoRecord,
    ScreenedPhoto,
    ScreenResult,
    SkippedPhoto,
)
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.io.colmap_records import SPLIT_PANORAMAS
from ambiguous_wild.io.photos import Photo, UnreadablePhoto, read_photo

BLUR_SIDE = 1024  # px, longer side: the Laplacian grows with resolution, so blur is compared at one size
BLUR_RATIO = 0.2  # of the capture's median; a photo below it counts as blurred
NEAR_DUPLICATE = 0.995  # correlation of 32 x 32 thumbnails
EXPOSURE_STOPS = 1.0
_THUMBNAIL = 32
More = TypeVar("More")


@dataclass(frozen=True)
class ReadCapture(Generic[More]):
    """The photos of a capture that can be used."""

    photos: list[PhotoRecord]
    thumbnails: np.ndarray  # [N, 1024], see `thumbnail`
    more: list[More]  # what the caller's function returned for each photo
    copies: dict[str, str]  # relative name of a copy or of another format -> name of the photo that is used
    skipped: list[SkippedPhoto]  # unreadable photos and copies


def screen(capture: Capture, folder: Path, *, strict: bool, jobs: int, bar: Bar) -> ScreenResult:
    """Read every photo once and fill `folder/photos` for structure from motion.

    A photo that COLMAP reads as we do is linked; any other is converted to PNG.

    Raises:
        AwError: too few photos can be read, or with `strict` one cannot.
    """
    photos = folder / "photos"
    photos.mkdir()
    read = read_capture(
        capture,
        lambda source, photo, pixels: _lay_out(source, photo, pixels, photos),
        strict=strict,
        jobs=jobs,
        bar=bar,
    )
    for path in photos.iterdir():
        if path.name not in read.more:  # left out: another format of the same photo is used
            path.unlink()
    facts: list[ScreenedPhoto] = [
        {
            **record,
            "work_name": work_name,
            "copies": [copy for copy, kept in read.copies.items() if kept == record["source"]],
        }
        for record, work_name in zip(read.photos, read.more)
    ]
    warnings = [
        *_skipped_warning(read.skipped, len(capture.sources)),
        *(f"{p['source']}: {n}" for p in facts for n in p["notes"]),
        *(_identical_warning(group) for group in identical(capture) if capture.has_sides),
        *_near_duplicates(facts, read.thumbnails),
        *_burst_warnings(facts, read.thumbnails),
        *_live_photo_warnings(capture),
        *drift_warnings(facts),
    ]
    return {"photos": facts, "skipped": read.skipped, "warnings": warnings}


def read_capture(
    capture: Capture,
    more: Callable[[PhotoSource, Photo, np.ndarray], More],
    *,
    strict: bool,
    jobs: int,
    bar: Bar,
) -> ReadCapture[More]:
    """Read every photo once; leave out copies, and the second format of a photo saved in two formats.

    Args:
        capture: the photos to read.
        more: called with each photo and its pixels [H, W, 3] uint8; its results are returned.
        strict: refuse a photo that cannot be read.
        jobs: threads; each holds one photo.
        bar: progress.

    Raises:
        AwError: too few photos can be read, or with `strict` one cannot.
    """
    sources, copies = without_copies(capture)
    bar.start("reading photos", len(sources))

    def one(source: PhotoSource) -> tuple[PhotoRecord, np.ndarray, More] | SkippedPhoto:
        try:
            photo, pixels = read_photo(source.path)
        except UnreadablePhoto as error:
            return {"source": source.relative, "skipped": error.reason}
        finally:
            bar.step()
        return photo_record(source, photo, pixels), thumbnail(pixels), more(source, photo, pixels)

    with ThreadPoolExecutor(jobs) as pool:
        rows = list(pool.map(one, sources))
    bar.finish()
    unreadable = [r for r in rows if not isinstance(r, tuple)]
    good = [r for r in rows if isinstance(r, tuple)]
    if not capture.has_sides:
        twins = _format_twins([record for record, _, _ in good], [small for _, small, _ in good])
        good = [row for row in good if row[0]["source"] not in twins]
        copies = copies | twins
    _refuse_bad(capture, unreadable, copies, len(good), strict)
    photos, thumbnails, results = zip(*good)
    return ReadCapture(
        list(photos), np.stack(thumbnails), list(results), copies, [*unreadable, *_copy_rows(copies)]
    )


def photo_record(source: PhotoSource, photo: Photo, pixels: np.ndarray) -> PhotoRecord:
    """Measure size, EXIF, blur and brightness of one photo."""
    exif = {k: v for k, v in dataclasses.asdict(photo.exif).items() if v is not None}
    return {
        "source": source.relative,
        "stem": source.stem,
        "side": source.side,
        "sha256": source.sha256,
        "width": photo.width,
        "height": photo.height,
        "exif": cast(ExifRecord, exif),
        "camera": photo.exif.camera,
        "blur": round(sharpness(pixels), 3),
        "mean_luma": round(float(pixels.mean()), 2),
        "notes": list(photo.notes),
    }


def without_copies(capture: Capture) -> tuple[list[PhotoSource], dict[str, str]]:
    """Return the photos to use, and the copies to leave out: relative name -> first file with the same bytes.

    One of two copies could be a training photo and the other a test photo, which leaks test data. In a
    capture with train/ and test/ the copies stay, and a warning names them.
    """
    if capture.has_sides:
        return list(capture.sources), {}
    first: dict[str, PhotoSource] = {}
    copies = {}
    for source in capture.sources:
        kept = first.setdefault(source.sha256, source)
        if kept is not source:
            copies[source.relative] = kept.relative
    return list(first.values()), copies


def sharpness(
    rgb: np.ndarray,  # [H, W, 3] uint8
) -> float:
    """Return the variance of the Laplacian of grey at `BLUR_SIDE` px (Pech-Pacheco et al., ICPR 2000)."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = BLUR_SIDE / max(gray.shape)
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray, cv2.CV_32F).var())


def thumbnail(
    rgb: np.ndarray,  # [H, W, 3] uint8
) -> np.ndarray:  # [1024] float32, zero mean, unit length
    """Reduce the photo to 32 x 32 grey, normalised: the dot product of two is their correlation."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    small = cv2.resize(gray, (_THUMBNAIL, _THUMBNAIL), interpolation=cv2.INTER_AREA).astype(np.float32)
    small -= small.mean()
    return (small / max(float(np.linalg.norm(small)), 1e-6)).ravel()


def drift_warnings(facts: Sequence[PhotoRecord]) -> list[str]:
    """Warn of blurred photos, and of camera settings that changed within the capture."""
    warnings = []
    blur = np.array([f["blur"] for f in facts])
    limit = BLUR_RATIO * float(np.median(blur))
    soft = [f["source"] for f, b in zip(facts, blur) if b < limit]
    if soft:
        warnings.append(
            f"{len(soft)} photos are blurred (Laplacian variance under {limit:.0f}, a fifth of the "
            f"capture's median): {shortlist(soft)}"
        )
    stops = [s for f in facts if (s := exposure_stops(f["exif"])) is not None]
    if stops and max(stops) - min(stops) > EXPOSURE_STOPS:
        warnings.append(
            f"exposure settings span {max(stops) - min(stops):.1f} stops: appearance changes between photos"
        )
    balances = {f["exif"]["white_balance"] for f in facts if "white_balance" in f["exif"]}
    if len(balances) > 1:
        warnings.append("white balance is automatic in some photos and manual in others: colours may shift")
    for camera in sorted({f["camera"] for f in facts if f["camera"]}):
        focal = [f["exif"]["focal_mm"] for f in facts if f["camera"] == camera and "focal_mm" in f["exif"]]
        if focal and max(focal) > 1.01 * min(focal):
            warnings.append(f"{camera} was zoomed: {min(focal):.1f} to {max(focal):.1f} mm")
    if len({(f["width"], f["height"]) for f in facts}) > 1:
        warnings.append(f"photos have {len({(f['width'], f['height']) for f in facts})} different sizes")
    return warnings + panorama_warnings(facts)


def panorama_warnings(facts: Sequence[PhotoRecord]) -> list[str]:
    """Warn of photos shaped like 360 degree photos: a tool may have dropped the XMP data that says so."""
    wide = [f["source"] for f in facts if f["width"] == 2 * f["height"]]
    name = f"{len(wide)} photos are 2:1, as 360 degree photos are ({shortlist(wide, 2)})"
    return [f"{name}: {SPLIT_PANORAMAS}"] if wide else []


def exposure_stops(exif: ExifRecord) -> float | None:
    """Return log2(t ISO / N^2), up to a constant; None where EXIF has no exposure time."""
    if "exposure_s" not in exif:
        return None
    return math.log2(exif["exposure_s"] * exif.get("iso", 100.0) / exif.get("f_number", 1.0) ** 2)


def _near_duplicates(facts: Sequence[PhotoRecord], thumbnails: np.ndarray) -> list[str]:
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


def _format_twins(facts: Sequence[PhotoRecord], thumbnails: Sequence[np.ndarray]) -> dict[str, str]:
    """Find photos saved in two formats: source to leave out -> source to keep.

    Phones save or export IMG_1.HEIC and IMG_1.JPG. The larger one is kept, of equal ones the first by name.

    Args:
        facts: photos that can be read.
        thumbnails: [1024] each, as `thumbnail` returns them.
    """
    groups: dict[str, list[int]] = {}
    for index, fact in enumerate(facts):
        groups.setdefault(str(PurePosixPath(fact["source"]).with_suffix("")).casefold(), []).append(index)
    twins = {}
    for members in groups.values():
        if len(members) < 2:
            continue
        first = max(members, key=lambda i: (facts[i]["width"] * facts[i]["height"], -i))
        for other in members:
            suffixes = {PurePosixPath(facts[i]["source"]).suffix.lower() for i in (first, other)}
            if (
                other != first
                and len(suffixes) == 2
                and float(thumbnails[first] @ thumbnails[other]) > NEAR_DUPLICATE
            ):
                twins[facts[other]["source"]] = facts[first]["source"]
    return twins


def _burst_warnings(facts: Sequence[PhotoRecord], thumbnails: np.ndarray) -> list[str]:
    """Warn of runs of near-identical photos that one camera took within the same second."""
    groups: dict[tuple[str | None, str], list[int]] = {}
    for index, fact in enumerate(facts):
        taken = fact["exif"].get("taken_at")
        if taken is not None:
            groups.setdefault((fact["camera"], taken), []).append(index)
    bursts = []
    for members in groups.values():
        alike = [i for i in members[1:] if float(thumbnails[members[0]] @ thumbnails[i]) > NEAR_DUPLICATE]
        if alike:
            bursts.append(f"{facts[members[0]]['source']} and {len(alike)} more")
    if not bursts:
        return []
    return [
        f"{len(bursts)} bursts of near-identical photos of one second: {shortlist(bursts, 3)}; keep the "
        "sharpest of each, or training photos may show nearly the same as test photos"
    ]


def _live_photo_warnings(capture: Capture) -> list[str]:
    """Warn of videos that belong to photos of the same name."""
    stems = {PurePosixPath(s.relative).stem.casefold() for s in capture.sources}
    videos = [
        name
        for name in capture.ignored
        if PurePosixPath(name).suffix.lower() in VIDEO_SUFFIXES
        and PurePosixPath(name).stem.casefold() in stems
    ]
    return [f"{len(videos)} videos of live photos are left out: {shortlist(videos, 3)}"] if videos else []


def _lay_out(source: PhotoSource, photo: Photo, pixels: np.ndarray, folder: Path) -> str:
    if photo.plain:
        (folder / source.work_name).symlink_to(source.path)
        return source.work_name
    import OpenImageIO as oiio

    # OpenImageIO copies the EXIF focal length, from which COLMAP starts.
    name = source.stem + ".png"
    spec = oiio.ImageSpec(photo.width, photo.height, 3, "uint8")
    for key, value in _attributes(photo).items():
        spec.attribute(key, value)  # passed with its uint16 type, it would be dropped
    output = oiio.ImageOutput.create(str(folder / name))
    if output is None or not output.open(str(folder / name), spec) or not output.write_image(pixels):
        reason = oiio.geterror() if output is None else output.geterror()
        raise AwError(f"cannot convert {source.relative} to PNG: {' '.join(reason.split())}")
    output.close()
    return name


def _attributes(photo: Photo) -> dict[str, str | int | float]:
    """Return EXIF values under OpenImageIO's names."""
    if photo.format == "heic":
        exif = photo.exif
        values = {
            "Make": exif.make,
            "Model": exif.model,
            "Exif:FocalLength": exif.focal_mm,
            "Exif:FocalLengthIn35mmFilm": None if exif.focal_35mm is None else int(exif.focal_35mm),
        }
        return {key: value for key, value in values.items() if value is not None}
    import OpenImageIO as oiio

    return {
        a.name: a.value
        for a in oiio.ImageBuf(str(photo.path)).spec().extra_attribs
        if (a.name.startswith("Exif:") or a.name in ("Make", "Model"))
        and isinstance(a.value, (str, int, float))
    }


def _identical_warning(group: list[str]) -> str:
    sides = {name.partition("/")[0] for name in group}
    leak = ": in train/ and in test/, which leaks test data into training" if len(sides) > 1 else ""
    return f"identical files: {shortlist(group)}{leak}"


def _copy_rows(copies: dict[str, str]) -> list[SkippedPhoto]:
    """Record the copies as photos that are left out."""
    return [{"source": copy, "skipped": f"{_sameness(copy, kept)} {kept}"} for copy, kept in copies.items()]


def _sameness(copy: str, kept: str) -> str:
    other_format = PurePosixPath(copy).suffix.lower() != PurePosixPath(kept).suffix.lower()
    return "the same photo in another format as" if other_format else "the same file as"


def _refuse_bad(
    capture: Capture, skipped: list[SkippedPhoto], copies: dict[str, str], good: int, strict: bool
) -> None:
    """Raise AwError where too few photos can be read, or with `strict` one cannot."""
    reasons = shortlist([f"{r['source']} ({r['skipped']})" for r in skipped], 4)
    total = len(capture.sources)
    if skipped and strict:
        raise AwError(
            f"{len(skipped)} of {total} photos cannot be read: {reasons}; repair or remove them, or "
            "run without --strict to leave them out"
        )
    if good < MIN_PHOTOS:
        reasons = shortlist([f"{r['source']} ({r['skipped']})" for r in [*skipped, *_copy_rows(copies)]], 4)
        raise AwError(
            f"only {good} of {total} photos in {capture.root} can be used, {MIN_PHOTOS} are needed: {reasons}"
        )


def _skipped_warning(skipped: list[SkippedPhoto], total: int) -> list[str]:
    if not skipped:
        return []
    reasons = shortlist([f"{r['source']} ({r['skipped']})" for r in skipped])
    return [f"{len(skipped)} of {total} photos skipped: {reasons}"]
