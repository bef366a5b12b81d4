"""First stage: list the photos of a capture and name them; find the truth of a simulated capture.

And the split of those that are placed into training and test photos, as lists of names.
"""

from __future__ import annotations

import difflib
import hashlib
import re
import unicodedata
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.photos import PHOTO_SUFFIXES
from ambiguous_wild.io.scene_folder import TEST_EVERY, read_list

MIN_PHOTOS = 3  # COLMAP's smallest useful model
_MAX_STEM_BYTES = 120  # leaves room for prefixes of temporary files under the usual 255


@dataclass(frozen=True)
class Source:
    """One photo of the capture and the name it has in the scene."""

    path: Path  # absolute
    relative: str  # path relative to the capture folder
    stem: str  # unique in the scene; its files are <stem>.png
    side: Literal["train", "test"] | None  # from the sub-folder, if the capture has them
    sha256: str

    @property
    def work_name(self) -> str:
        """File name that COLMAP sees."""
        return self.stem + self.path.suffix.lower()


@dataclass(frozen=True)
class Capture:
    """The user's folder of photos; it is not changed."""

    root: Path
    sources: tuple[Source, ...]  # natural order of their relative names
    has_sides: bool  # the photos are in train/ and test/
    truth: Path | None  # truth/ of a simulated capture
    ignored: tuple[str, ...]  # names of other files


def collect(raw: Path | str, jobs: int = 1) -> Capture:
    """List the photos of a capture folder: directly in it, in images/, or in train/ and test/.

    Raises:
        AwError: no folder, no photo, too few photos, or only one of train/ and test/.
    """
    root = Path(raw).resolve()
    if not root.is_dir():
        what = "is a file; give the folder of photos" if root.exists() else "does not exist"
        raise AwError(f"capture {raw} {what}")
    folders = _photo_folders(root)
    files: list[tuple[Path, Literal["train", "test"] | None]] = []
    ignored: list[str] = []
    for folder, side in folders:
        for path in sorted(folder.iterdir(), key=lambda p: natural_key(p.name)):
            if path.name.startswith(".") or not path.is_file():
                continue
            if path.suffix.lower() in PHOTO_SUFFIXES:
                files.append((path, side))
            else:
                ignored.append(path.name)
    # Python keeps other bytes as surrogates, which no list and no other program can hold.
    if odd := [ascii(p.name) for p, _ in files if str(p) != str(p).encode(errors="ignore").decode()]:
        raise AwError(f"names of photos in {root} are not UTF-8: {shortlist(odd)}; rename them")
    if len(files) < MIN_PHOTOS:
        raise AwError(_too_few(root, len(files), ignored))
    with ThreadPoolExecutor(jobs) as pool:
        digests = list(pool.map(lambda item: sha256_file(item[0]), files))
    stems = _unique_stems(files)
    sources = tuple(
        Source(path, path.relative_to(root).as_posix(), stem, side, digest)
        for (path, side), stem, digest in zip(files, stems, digests)
    )
    truth = root / "truth"
    return Capture(
        root, sources, folders[0][1] is not None, truth if truth.is_dir() else None, tuple(sorted(ignored))
    )


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts IMG_2 before IMG_10."""
    parts = re.split(r"(\d+)", name)
    return [(1, int(p), p) if p.isascii() and p.isdigit() else (0, 0, p.casefold()) for p in parts]


def identical(capture: Capture) -> list[list[str]]:
    """Groups of photos with the same bytes."""
    groups: dict[str, list[str]] = {}
    for source in capture.sources:
        groups.setdefault(source.sha256, []).append(source.relative)
    return [names for names in groups.values() if len(names) > 1]


def _photo_folders(root: Path) -> list[tuple[Path, Literal["train", "test"] | None]]:
    train, test = root / "train", root / "test"
    if train.is_dir() and test.is_dir():
        return [(train, "train"), (test, "test")]
    if train.is_dir() or test.is_dir():
        there, other = ("train", "test") if train.is_dir() else ("test", "train")
        raise AwError(f"{root} has {there}/ but no {other}/: add it, or give one flat folder of photos")
    if not _has_photos(root) and _has_photos(root / "images"):
        return [(root / "images", None)]
    return [(root, None)]


def _has_photos(folder: Path) -> bool:
    return folder.is_dir() and any(p.suffix.lower() in PHOTO_SUFFIXES for p in folder.iterdir())


def _too_few(root: Path, count: int, ignored: list[str]) -> str:
    known = ", ".join(s.lstrip(".") for s in PHOTO_SUFFIXES)
    found = f"; it holds {shortlist(ignored)}" if ignored else ""
    nested = [p.name for p in sorted(root.iterdir()) if _has_photos(p)]
    if count == 0 and nested:
        return f"{root} holds no photos itself, but {shortlist(nested)} does: give that folder"
    if count == 0:
        return f"{root} holds no photos ({known}){found}"
    what = "one photo" if count == 1 else f"{count} photos"
    return f"{root} holds {what}; at least {MIN_PHOTOS} that overlap are needed, 20 or more are better"


def _unique_stems(files: list[tuple[Path, Literal["train", "test"] | None]]) -> list[str]:
    """Names in the scene, without spaces; equal names get the side, then the format, then a number."""
    stems = [_clean(path.stem) for path, _ in files]
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


def _clean(stem: str) -> str:
    """The name without white space (COLMAP's text models split on it) and control characters, shortened."""
    text = unicodedata.normalize("NFC", stem)
    text = "".join("_" if c.isspace() or not c.isprintable() or c in '\\:*?"<>|' else c for c in text)
    data = text.encode("utf-8", errors="surrogateescape")
    if len(data) <= _MAX_STEM_BYTES:
        return text
    digest = hashlib.sha256(data).hexdigest()[:8]
    return data[: _MAX_STEM_BYTES - 9].decode("utf-8", errors="ignore") + "_" + digest


def split_photos(
    facts: list[ScreenedPhoto], registered: set[str], test_stems: set[str] | None
) -> tuple[list[str], list[str], str, list[str]]:
    """Names of the training and the test photos.

    Args:
        facts: screened photos.
        registered: stems in the model.
        test_stems: from the user's test list, or None.

    Returns:
        (train, test, "list" or "folders" or "every-8", warnings); names are ``<stem>.png``, sorted.

    Raises:
        AwError: fewer than two training photos, or a test set without a placed photo.
    """
    inside = sorted(f["stem"] for f in facts if f["stem"] in registered)
    warnings = []
    if test_stems is not None:
        how, test = "list", [s for s in inside if s in test_stems]
        wanted = len(test_stems)
    elif any(f["side"] for f in facts):
        sides = {f["stem"]: f["side"] for f in facts}
        how, test = "folders", [s for s in inside if sides[s] == "test"]
        wanted = sum(f["side"] == "test" for f in facts)
    else:
        how, test = f"every-{TEST_EVERY}", inside[::TEST_EVERY]
        wanted = len(test)
        warnings.append(
            f"no test set given, so every {TEST_EVERY}th photo tests: distractors in these photos count "
            "as truth in the scores; give clean photos in test/, or --test-list FILE"
        )
    train = sorted(set(inside) - set(test))
    if wanted and not test:
        raise AwError(
            f"none of the {wanted} test photos could be placed among the training photos: they show "
            "another place or too little overlap; take them nearer to the training views"
        )
    if len(train) < 2:
        raise AwError(f"only {len(train)} training photos could be placed; a scene needs at least 2")
    if len(test) < wanted:
        warnings.append(f"{wanted - len(test)} of {wanted} test photos are lost: scores cover {len(test)}")
    return [f"{s}.png" for s in train], [f"{s}.png" for s in test], how, warnings


def read_test_list(path: Path, facts: list[ScreenedPhoto]) -> set[str]:
    """Stems of the photos in a test list, which names them by path, by file name or without extension.

    Raises:
        AwError: the file cannot be read or is empty, names an unknown photo, or names all photos.
    """
    try:
        names = read_list(path)
    except (OSError, UnicodeDecodeError) as error:
        raise AwError(f"cannot read the test list {path}: {error}") from error
    known: dict[str, str] = {}
    for fact in facts:
        source = PurePosixPath(fact["source"])
        for key in (str(source), source.name, source.stem, fact["stem"], fact["stem"] + ".png"):
            known.setdefault(key, fact["stem"])
        for copy in fact.get("copies", ()):
            known.setdefault(copy, fact["stem"])
    unknown = [n for n in names if n not in known]
    if unknown:
        what = "a photo" if len(unknown) == 1 else f"{len(unknown)} photos"
        sources = {f["stem"]: f["source"] for f in facts}
        raise AwError(
            f"{path} names {what} not in the capture: "
            + shortlist((_with_nearest(n, known, sources) for n in unknown), 3)
        )
    if not names:
        raise AwError(f"{path} is empty; list test photos one a line, or leave out --test-list")
    tests = {known[n] for n in names}
    if len(tests) == len(facts):
        raise AwError(f"{path} names all {len(facts)} photos: no training photo would be left; list fewer")
    return tests


def _with_nearest(name: str, known: dict[str, str], sources: dict[str, str]) -> str:
    """The unknown name, and the photo whose name is nearest to it."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"{name!r} (did you mean {sources[known[near[0]]]!r}?)" if near else repr(name)
