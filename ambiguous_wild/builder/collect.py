"""First stage: list the photos of a capture and name them; find the truth of a simulated capture."""

from __future__ import annotations

import hashlib
import os
import unicodedata
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ambiguous_wild.core.errors import AwError, counted, shortlist, similar_path
from ambiguous_wild.io.files import natural_key, sha256_file
from ambiguous_wild.io.images import header_size
from ambiguous_wild.io.mask_files import NO_PHOTOS, masks_beside_photos
from ambiguous_wild.io.photos import PHOTO_SUFFIXES, UNREAD_SUFFIXES, is_photo

MIN_PHOTOS = 3  # COLMAP's smallest useful model
Side = Literal["train", "test"] | None
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".3gp")
_MAX_STEM_BYTES = 120  # leaves room for prefixes of temporary files under the usual 255


@dataclass(frozen=True)
class PhotoSource:
    """One photo of the capture and the name it has in the scene."""

    path: Path  # absolute
    source: str  # path relative to the capture folder
    stem: str  # unique in the scene; its files are <stem>.png
    side: Side  # from the sub-folder, if the capture has them
    sha256: str
    folder: str = ""  # unique name of its folder if there are several; the stem starts with it

    @property
    def name(self) -> str:
        """Name of its files in every stage, whatever their format, and in the scene."""
        return f"{self.stem}.png"


@dataclass(frozen=True)
class Capture:
    """The user's folders of photos; they are not changed."""

    root: Path  # the folder, or the parent of several folders
    sources: tuple[PhotoSource, ...]  # natural order of their paths
    has_sides: bool  # the photos are in train/ and test/
    truth: Path | None  # truth/ of a simulated capture
    ignored: tuple[str, ...]  # names of other files
    notes: tuple[str, ...] = ()  # which folders are read, and which are not


def collect(
    raw: Path | str | Sequence[Path | str], jobs: int = 1, masks: Path | None = None, least: int = MIN_PHOTOS
) -> Capture:
    """List the photos of one capture folder or of several: directly in it, in images/, in train/ and test/.

    A folder without photos of its own stands for the folders in it, at any depth.

    Args:
        raw: one folder, or several that become one capture.
        jobs: threads.
        masks: the user's folder of masks, which is skipped.
        least: smallest number of photos.

    Raises:
        AwError: no folder, no photo, too few photos, or only one of train/ and test/.
    """
    given = [raw] if isinstance(raw, (str, Path)) else list(raw)
    roots = _check_roots(given)
    root = Path(os.path.commonpath(roots))
    folders = [found for one in roots for found in _photo_folders(one, masks)]
    files: list[tuple[Path, Side]] = []
    labels: list[str] = []
    ignored: list[str] = []
    marked = {path for folder, _ in folders for path in masks_beside_photos(folder)}
    for (folder, side), label in zip(folders, _labels(root, folders), strict=True):
        for path in sorted(folder.iterdir(), key=lambda p: natural_key(p.name)):
            if path.name.startswith(".") or not path.is_file():
                continue
            if path not in marked and is_photo(path):
                files.append((path, side))
                labels.append(label)
            else:
                ignored.append(path.name)
    # Python keeps other bytes as surrogates, which text files and other programs cannot hold.
    if odd := [ascii(p.name) for p, _ in files if str(p) != str(p).encode(errors="ignore").decode()]:
        raise AwError(f"names of photos in {root} are not UTF-8: {shortlist(odd)}; rename them")
    if len(files) < least:
        raise AwError(_too_few(root, len(files), ignored))
    with ThreadPoolExecutor(jobs) as pool:
        digests = list(pool.map(lambda item: sha256_file(item[0]), files))
    stems = _unique_stems(files, labels)
    sources = tuple(
        PhotoSource(path, path.relative_to(root).as_posix(), stem, side, digest, label)
        for (path, side), stem, digest, label in zip(files, stems, digests, labels, strict=True)
    )
    truth = root / "truth"
    return Capture(
        root,
        sources,
        any(side for _, side in folders),
        truth if truth.is_dir() and len(roots) == 1 else None,
        tuple(sorted(ignored)),
        (*_folder_notes(roots, folders, labels, masks), *_file_notes(marked, ignored, masks)),
    )


def largest_photo(capture: Capture) -> int:
    """Return the pixels of the largest photo, by the files' headers; 0 where none can be read."""
    sizes = (header_size(photo.path) for photo in capture.sources)
    return max((width * height for width, height in filter(None, sizes)), default=0)


def _check_roots(given: Sequence[Path | str]) -> list[Path]:
    roots: list[Path] = []
    for raw in given:
        root = Path(raw).resolve()
        if not root.is_dir():
            what = "is a file; give the folder of photos (of a video, see 'aw capture')"
            raise AwError(f"capture {raw} {what if root.exists() else 'does not exist' + similar_path(raw)}")
        if other := next((r for r in roots if r.is_relative_to(root) or root.is_relative_to(r)), None):
            raise AwError(f"{raw} and {other} are or hold the same folder; give each once")
        roots.append(root)
    return roots


def _photo_folders(root: Path, masks: Path | None) -> list[tuple[Path, Side]]:
    sides: tuple[Side, Side] = ("train", "test")
    there = [side for side in sides if side and (root / side).is_dir()]
    if len(there) == 1:
        other = sides[there[0] == "train"]
        raise AwError(f"{root} has {there[0]}/ but no {other}/: add it, or give one flat folder of photos")
    bases: list[tuple[Path, Side]] = [(root / side, side) for side in sides if side and there]
    folders = [(f, side) for base, side in bases or [(root, None)] for f in _folders_in(base, masks)]
    return folders or [(root, None)]


def _may_hold_photos(path: Path) -> bool:
    return path.is_dir() and path.name[0] != "." and path.name.lower() not in NO_PHOTOS


def _folders_in(base: Path, masks: Path | None) -> Iterator[Path]:
    """Yield the folder if it holds photos, else those in images/, else those of all folders below."""
    if _has_photos(base):
        yield base
        return
    inner = [p for p in base.iterdir() if _may_hold_photos(p) and p != masks]
    named = [p for p in inner if p.name == "images" and any(_folders_in(p, masks))]
    for folder in named or sorted(inner, key=lambda p: natural_key(p.name)):
        yield from _folders_in(folder, masks)


def videos_in(base: Path) -> Iterator[Path]:
    """Yield the videos below a folder, except beside photos, where they are live photos or their source."""
    inner = sorted(base.iterdir(), key=lambda p: natural_key(p.name))
    beside = _has_photos(base) or _has_photos(base / "images")
    for path in () if beside else inner:
        if path.is_file() and path.name[0] != "." and path.suffix.lower() in VIDEO_SUFFIXES:
            yield path
    for path in inner:
        if _may_hold_photos(path):
            yield from videos_in(path)


def _labels(root: Path, folders: Sequence[tuple[Path, Side]]) -> list[str]:
    """Label several folders by the end of the path that tells them apart, joined by "_"; a single one "" ."""
    paths = [
        [p for p in folder.relative_to(root).parts if p not in ("images", side)] for folder, side in folders
    ]
    different = {tuple(path) for path in paths}
    if len(different) == 1:
        return [""] * len(paths)
    for depth in range(1, max(map(len, paths)) + 1):
        ends = {path: clean_stem("_".join(path[-depth:])).casefold() for path in different}
        if len(set(ends.values())) == len(different):
            break
    return [clean_stem("_".join(path[-depth:])) for path in paths]


def _folder_notes(
    roots: Sequence[Path], folders: Sequence[tuple[Path, Side]], labels: Sequence[str], masks: Path | None
) -> Iterator[str]:
    counts = Counter(labels)
    if len(counts) > 1:
        yield f"photos of {len(counts)} folders: {shortlist([f'{k} ({v})' for k, v in counts.items()])}"
    for root in roots:
        beside = [p for p in sorted(root.iterdir()) if p.is_dir() and p.name.lower() == "masks"]
        for unused in beside if masks is None else ():
            yield f"{unused} is not used; --keep-masks '{unused}' does (white = keep)"
        if (root, None) in folders:
            inner = (p for p in sorted(root.iterdir()) if _may_hold_photos(p) and p != masks)
            if left := [p.name for p in inner if any(_folders_in(p, masks))]:
                yield f"{root} holds photos itself, so its folders {shortlist(left)} are left out"


def _file_notes(marked: set[Path], ignored: Sequence[str], masks: Path | None) -> Iterator[str]:
    if marked and masks is None:
        folder = min(marked).parent
        yield (
            f"{counted(len(marked), 'mask')} beside photos, as {min(marked).name}, not used; "
            f"--keep-masks '{folder}' does (white = keep)"
        )
    kinds = Counter(s for name in ignored if (s := Path(name).suffix.lower()) in UNREAD_SUFFIXES)
    if kinds:
        each = shortlist(f"{suffix} ({count})" for suffix, count in sorted(kinds.items()))
        count = counted(kinds.total(), "picture")
        yield f"{count} of formats that are not read, left out: {each}; export what has no JPEG beside it"


def _has_photos(folder: Path) -> bool:
    return folder.is_dir() and any(p.name[0] != "." and p.is_file() and is_photo(p) for p in folder.iterdir())


def _too_few(root: Path, count: int, ignored: list[str]) -> str:
    suffixes = ", ".join(s.lstrip(".") for s in PHOTO_SUFFIXES)
    others = f"; it holds {shortlist(ignored)}" if ignored else ""
    if count == 0:
        return f"{root} holds no photos ({suffixes}){others}"
    what = "one photo" if count == 1 else f"{count} photos"
    return f"{root} holds {what}; at least {MIN_PHOTOS} that overlap are needed, 20 or more are better"


def _unique_stems(files: list[tuple[Path, Side]], labels: Sequence[str]) -> list[str]:
    """Return names in the scene, without spaces; with several folders the folder's name comes first.

    Equal names get the side in front, then the format, then a number.
    """
    stems = [
        clean_stem("_".join(filter(None, (k, path.stem)))) for (path, _), k in zip(files, labels, strict=True)
    ]
    for attempt in ("side", "suffix"):
        seen = Counter(s.casefold() for s in stems)
        for i, (path, side) in enumerate(files):
            if seen[stems[i].casefold()] > 1:
                if attempt == "side" and side:
                    stems[i] = f"{side}_{stems[i]}"
                elif attempt == "suffix":
                    stems[i] = f"{stems[i]}_{path.suffix.lower().lstrip('.')}"
    taken: set[str] = set()
    for i, stem in enumerate(stems):  # names that differ in case only
        number, free = 2, stem
        while free.casefold() in taken:
            free, number = f"{stem}_{number}", number + 1
        stems[i] = free
        taken.add(free.casefold())
    return stems


def clean_stem(stem: str) -> str:
    """Replace white space (COLMAP's text models split on it) and control characters, and shorten the name."""
    text = unicodedata.normalize("NFC", stem)
    text = "".join("_" if c.isspace() or not c.isprintable() or c in '\\:*?"<>|' else c for c in text)
    data = text.encode("utf-8", errors="surrogateescape")
    if len(data) <= _MAX_STEM_BYTES:
        return text
    digest = hashlib.sha256(data).hexdigest()[:8]
    return data[: _MAX_STEM_BYTES - 9].decode("utf-8", errors="ignore") + "_" + digest
