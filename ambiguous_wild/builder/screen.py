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

from ambiguous_wild.builder.collect import MIN_PHOTOS, VIDEO_SUFFIXES, Capture, PhotoSource
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import (
    ExifRecord,
    ScreenedPhoto,
    ScreenResult,
    SkippedPhoto,
)
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.io.colmap_records import SPLIT_PANORAMAS
from ambiguous_wild.io.photos import GREY, TRANSPARENT, Photo, UnreadablePhoto, read_photo
from ambiguous_wild.io.scene_checks import SHARED

BLUR_SIDE = 1024  # px, longer side: the Laplacian grows with resolution, so blur is compared at one size
BLUR_RATIO = 0.2  # of the capture's median; a photo below it counts as blurred
ONE_COLOUR = 8  # largest difference of codes within a border
MIN_BORDER, MAX_BORDER = 4, 0.4  # px; share of a photo's side that is looked at
MOST_HAVE = 0.8  # share of the photos that have a border of one width, where it is not the sky
NEAR_DUPLICATE = 0.995  # correlation of 32 x 32 thumbnails
FOCAL_RATIO = 1.01  # longest over shortest focal length of a camera that counts as zoomed
_THUMBNAIL = 32
More = TypeVar("More")


@dataclass(frozen=True)
class ReadCapture(Generic[More]):
    """The photos of a capture that can be used."""

    photos: list[ScreenedPhoto]
    thumbnails: np.ndarray  # [N, 1024], see `thumbnail`
    more: list[More]  # what the caller's function returned for each photo
    copies: dict[str, str]  # path of a copy or of another format -> path of the photo that is used
    skipped: list[SkippedPhoto]  # unreadable photos and copies


def screen(capture: Capture, folder: Path, *, strict: bool, jobs: int, bar: Bar) -> ScreenResult:
    """Read every photo once and fill `folder/photos` for structure from motion.

    A photo that COLMAP reads as we do is linked; any other is converted to PNG.

    Raises:
        AwError: too few photos can be read, or with `strict` one cannot.
    """
    laid_out = folder / "photos"
    laid_out.mkdir()
    read = read_capture(
        capture,
        lambda listed, photo, pixels: _lay_out(listed, photo, pixels, laid_out),
        strict=strict,
        jobs=jobs,
        bar=bar,
    )
    used = {photo.name for photo in read.photos}
    for path in laid_out.iterdir():
        if path.name not in used:  # left out: another format of the same photo is used
            path.unlink()
    screened = [
        dataclasses.replace(photo, copies=[c for c, kept in read.copies.items() if kept == photo.source])
        for photo in read.photos
    ]
    warnings = [
        *_skipped_warning(read.skipped, len(capture.sources)),
        *photo_warnings(screened),
        *_near_duplicates(screened, read.thumbnails),
        *_burst_warnings(screened, read.thumbnails),
        *_live_photo_warnings(capture),
        *drift_warnings(screened),
    ]
    return {
        "photos": [dataclasses.asdict(photo) for photo in screened],
        "skipped": read.skipped,
        "warnings": warnings,
    }


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

    def one(listed: PhotoSource) -> tuple[ScreenedPhoto, np.ndarray, More] | SkippedPhoto:
        try:
            photo, pixels = read_photo(listed.path)
        except UnreadablePhoto as error:
            return {"source": listed.source, "skipped": error.reason}
        finally:
            bar.step()
        return photo_record(listed, photo, pixels), thumbnail(pixels), more(listed, photo, pixels)

    with ThreadPoolExecutor(jobs) as pool:
        rows = list(pool.map(one, sources))
    bar.finish()
    unreadable = [r for r in rows if not isinstance(r, tuple)]
    good = [r for r in rows if isinstance(r, tuple)]
    if not capture.has_sides:
        twins = _format_twins([record for record, _, _ in good], [small for _, small, _ in good])
        good = [row for row in good if row[0].source not in twins]
        copies = copies | twins
    _refuse_bad(capture, unreadable, copies, len(good), strict)
    photos, thumbnails, results = zip(*good)
    return ReadCapture(
        list(photos), np.stack(thumbnails), list(results), copies, [*unreadable, *_copy_rows(copies)]
    )


def photo_record(listed: PhotoSource, photo: Photo, pixels: np.ndarray) -> ScreenedPhoto:
    """Measure size, EXIF, blur and brightness of one photo."""
    exif = {k: v for k, v in dataclasses.asdict(photo.exif).items() if v is not None}
    return ScreenedPhoto(
        source=listed.source,
        name=listed.name,
        side=listed.side,
        sha256=listed.sha256,
        width=photo.width,
        height=photo.height,
        exif=cast(ExifRecord, exif),
        camera=photo.exif.camera,
        sharpness=round(sharpness(pixels), 3),
        mean_luma=round(float(pixels.mean()), 2),
        notes=list(photo.notes),
        borders=[_border(side) for side in _from_each_side(pixels)],
    )


def _from_each_side(pixels: np.ndarray) -> list[np.ndarray]:
    """Return views [N, M, 3] of a photo whose first line is its top, its bottom, its left, its right."""
    turned = pixels.transpose(1, 0, 2)
    return [pixels, pixels[::-1], turned, turned[::-1]]


def _border(lines: np.ndarray) -> int:
    """Return how many first lines [N, M, 3] are of one colour; at most a part of them is looked at."""
    for count, line in enumerate(lines[: int(MAX_BORDER * len(lines))]):
        if np.abs(line.astype(np.int16) - lines[0, 0]).max() > ONE_COLOUR:
            return count
    return int(MAX_BORDER * len(lines))


def photo_warnings(photos: Sequence[ScreenedPhoto]) -> list[str]:
    """Return what reading converted, borders of one colour, and grey photos among colour ones."""
    sources = grouped(((note, photo.source) for photo in photos for note in photo.notes), lambda row: row[0])
    lines = [
        f"{rows[0][1]}: {note}"
        if len(rows) == 1
        else f"{len(rows)} photos: {note}: " + shortlist([source for _, source in rows], 3)
        for note, rows in sources.items()
    ]
    grey = [photo.source for photo in photos if GREY in photo.notes]
    if 0 < len(grey) < len(photos):
        lines.append(
            f"{len(grey)} of {len(photos)} photos are grey: if they show another channel (thermal, depth), "
            f"move them away: {shortlist(grey, 3)}"
        )
    thermal = [photo.source for photo in photos if PurePosixPath(photo.source).stem.upper().endswith("_T")]
    if 0 < len(thermal) < len(photos):
        lines.append(
            f"the names of {len(thermal)} of {len(photos)} photos end in _T: if they are thermal, move them "
            f"away: {shortlist(thermal, 3)}"
        )
    for side, name in enumerate(("top", "bottom", "left", "right")):
        widths = [photo.borders[side] for photo in photos if TRANSPARENT not in photo.notes]
        width = round(float(np.median(widths or [0])))
        count = sum(abs(each - width) <= MIN_BORDER for each in widths)  # JPEG blurs its edge
        if width >= MIN_BORDER and count >= MOST_HAVE * len(photos):
            lines.append(
                f"{count} photos have {width} px of one colour at the {name}, which would be learnt as part "
                "of the scene: crop them, or give --keep-masks"
            )
    return lines


def without_copies(capture: Capture) -> tuple[list[PhotoSource], dict[str, str]]:
    """Return the photos to use, and the copies to leave out: path -> first file with the same bytes.

    One of two copies could be a training photo and the other a test photo, which leaks test data.

    Raises:
        AwError: one is in train/ and the other in test/.
    """
    first: dict[str, PhotoSource] = {}
    copies, shared = {}, []
    for listed in capture.sources:
        kept = first.setdefault(listed.sha256, listed)
        if kept.side != listed.side:
            test, train = sorted((kept, listed), key=lambda photo: str(photo.side))
            shared.append(f"{test.source} is {train.source}")
        elif kept is not listed:
            copies[listed.source] = kept.source
    if shared:
        raise AwError(f"{capture.root}: {SHARED.format(names=shortlist(shared))}")
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


def drift_warnings(photos: Sequence[ScreenedPhoto]) -> list[str]:
    """Warn of blurred photos, and of camera settings that changed within the capture.

    Exposure is left to `aw screen` and `aw plan`: settings may follow the light, and these compare surfaces.
    """
    warnings = []
    sharp = np.array([photo.sharpness for photo in photos])
    limit = BLUR_RATIO * float(np.median(sharp))
    soft = [photo.source for photo, b in zip(photos, sharp) if b < limit]
    if soft:
        warnings.append(
            f"{len(soft)} photos are blurred (Laplacian variance under {limit:.0f}, a fifth of the "
            f"capture's median): {shortlist(soft)}"
        )
    balances = {photo.exif["white_balance"] for photo in photos if "white_balance" in photo.exif}
    if len(balances) > 1:
        warnings.append("white balance is automatic in some photos and manual in others: colours may shift")
    for camera, (shortest, longest) in zoomed_cameras(photos).items():
        if camera:
            warnings.append(f"{camera} was zoomed: {shortest:.1f} to {longest:.1f} mm")
    if len({photo.size for photo in photos}) > 1:
        warnings.append(f"photos have {len({photo.size for photo in photos})} different sizes")
    return warnings + panorama_warnings(photos)


def zoomed_cameras(photos: Sequence[ScreenedPhoto]) -> dict[str, tuple[float, float]]:
    """Return the shortest and longest focal length, mm by EXIF, of cameras that were zoomed; "": unnamed."""
    focals: dict[str, list[float]] = {}
    for photo in sorted(photos, key=lambda photo: photo.camera or ""):
        if "focal_mm" in photo.exif:
            focals.setdefault(photo.camera or "", []).append(photo.exif["focal_mm"])
    spans = {camera: (min(values), max(values)) for camera, values in focals.items()}
    return {camera: span for camera, span in spans.items() if span[1] > FOCAL_RATIO * span[0]}


def near_duplicate_pairs(thumbnails: np.ndarray) -> np.ndarray:
    """Return the pairs [K, 2] of photos whose thumbnails [N, 1024] hardly differ."""
    return np.argwhere(np.triu(thumbnails @ thumbnails.T > NEAR_DUPLICATE, k=1))


def panorama_warnings(photos: Sequence[ScreenedPhoto]) -> list[str]:
    """Warn of photos shaped like 360 degree photos: a tool may have dropped the XMP data that says so."""
    wide = [photo.source for photo in photos if photo.width == 2 * photo.height]
    name = f"{len(wide)} photos are 2:1, as 360 degree photos are ({shortlist(wide, 2)})"
    return [f"{name}: {SPLIT_PANORAMAS}"] if wide else []


def exposure_stops(exif: ExifRecord) -> float | None:
    """Return log2(t ISO / N^2), up to a constant; None where EXIF has no exposure time."""
    if "exposure_s" not in exif:
        return None
    return math.log2(exif["exposure_s"] * exif.get("iso", 100.0) / exif.get("f_number", 1.0) ** 2)


def _near_duplicates(photos: Sequence[ScreenedPhoto], thumbnails: np.ndarray) -> list[str]:
    pairs = [
        f"{photos[i].source} = {photos[j].source}"
        for i, j in near_duplicate_pairs(thumbnails)
        if photos[i].sha256 != photos[j].sha256
    ]
    if not pairs:
        return []
    return [
        f"{len(pairs)} near-duplicate pairs add little (thumbnails correlate over {NEAR_DUPLICATE}): "
        f"{shortlist(pairs, 3)}"
    ]


def _format_twins(photos: Sequence[ScreenedPhoto], thumbnails: Sequence[np.ndarray]) -> dict[str, str]:
    """Find photos saved in two formats: source to leave out -> source to keep.

    Phones save or export IMG_1.HEIC and IMG_1.JPG. The larger one is kept, of equal ones the first by name.

    Args:
        photos: those that can be read.
        thumbnails: [1024] each, as `thumbnail` returns them.
    """
    groups: dict[str, list[int]] = {}
    for index, photo in enumerate(photos):
        groups.setdefault(str(PurePosixPath(photo.source).with_suffix("")).casefold(), []).append(index)
    twins = {}
    for members in groups.values():
        if len(members) < 2:
            continue
        first = max(members, key=lambda i: (photos[i].width * photos[i].height, -i))
        for other in members:
            suffixes = {PurePosixPath(photos[i].source).suffix.lower() for i in (first, other)}
            if (
                other != first
                and len(suffixes) == 2
                and float(thumbnails[first] @ thumbnails[other]) > NEAR_DUPLICATE
            ):
                twins[photos[other].source] = photos[first].source
    return twins


def _burst_warnings(photos: Sequence[ScreenedPhoto], thumbnails: np.ndarray) -> list[str]:
    """Warn of runs of near-identical photos that one camera took within the same second."""
    groups: dict[tuple[str | None, str], list[int]] = {}
    for index, photo in enumerate(photos):
        taken = photo.exif.get("taken_at")
        if taken is not None:
            groups.setdefault((photo.camera, taken), []).append(index)
    bursts = []
    for members in groups.values():
        alike = [i for i in members[1:] if float(thumbnails[members[0]] @ thumbnails[i]) > NEAR_DUPLICATE]
        if alike:
            bursts.append(f"{photos[members[0]].source} and {len(alike)} more")
    if not bursts:
        return []
    return [
        f"{len(bursts)} bursts of near-identical photos of one second: {shortlist(bursts, 3)}; keep the "
        "sharpest of each, or training photos may show nearly the same as test photos"
    ]


def _live_photo_warnings(capture: Capture) -> list[str]:
    """Warn of videos that belong to photos of the same name."""
    stems = {PurePosixPath(s.source).stem.casefold() for s in capture.sources}
    videos = [
        name
        for name in capture.ignored
        if PurePosixPath(name).suffix.lower() in VIDEO_SUFFIXES
        and PurePosixPath(name).stem.casefold() in stems
    ]
    return [f"{len(videos)} videos of live photos are left out: {shortlist(videos, 3)}"] if videos else []


def _lay_out(listed: PhotoSource, photo: Photo, pixels: np.ndarray, folder: Path) -> None:
    """Link a photo as PNG, whatever its format, which decoders tell by its content; else convert it."""
    if photo.plain:
        (folder / listed.name).symlink_to(listed.path)
        return
    import OpenImageIO as oiio

    # OpenImageIO copies the EXIF focal length, from which COLMAP starts.
    path = str(folder / listed.name)
    spec = oiio.ImageSpec(photo.width, photo.height, 3, "uint8")
    for key, value in _attributes(photo).items():
        spec.attribute(key, value)  # passed with its uint16 type, it would be dropped
    output = oiio.ImageOutput.create(path)
    if output is None or not output.open(path, spec) or not output.write_image(pixels):
        reason = oiio.geterror() if output is None else output.geterror()
        raise AwError(f"cannot convert {listed.source} to PNG: {' '.join(reason.split())}")
    output.close()


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
