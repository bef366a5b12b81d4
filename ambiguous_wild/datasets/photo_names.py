"""Find the photos that a model names: in folders of any name, under paths of other computers."""

from __future__ import annotations

import functools
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ambiguous_wild.core.names import spelling_key
from ambiguous_wild.io.images import header_size
from ambiguous_wild.io.mask_files import NO_PHOTOS
from ambiguous_wild.io.photos import PHOTO_SUFFIXES

PREFERRED = ("images", "dense/images", "dense/0/images", "input", "rgb", "photos", "")  # "": the scene's own


@dataclass(frozen=True)
class LocatedPhotos:
    """Where a model's photos are."""

    folder: Path
    names: dict[str, str]  # name in the model -> path below the folder, which `find_photo` finds
    found: int  # photos that are there


def locate(root: Path, names: Sequence[str]) -> LocatedPhotos:
    """Find the folder below `root` that holds most of the photos, and their paths in it.

    A prefix that all names share may be missing there, as in /home/me/scan/images/a.jpg. Folders of other
    names than `PREFERRED` are looked into where these hold none. A photo that is in none keeps its name
    without the prefix.
    """
    parts = [_parts(name) for name in names]
    shared = min((len(path) for path in parts), default=1) - 1
    shared = next((k for k in range(shared) if len({path[k] for path in parts}) > 1), shared)
    folders, reduced = _folders(root)
    best = LocatedPhotos(root / "images", dict(zip(names, map("/".join, parts))), 0)
    for folder in (*folders, *reduced):
        if best.found and folder not in {root / name for name in PREFERRED}:
            break  # other folders may hold pictures of the same names: masks, depth
        for drop in range(shared + 1):
            tails = ["/".join(path[drop:]) for path in parts]
            found = sum(find_photo(folder, tail) is not None for tail in tails)
            if found <= best.found or (folder in reduced and best.folder != root / "images"):
                continue
            # A dataset may have reduced photos only; its folder of full ones keeps its usual name.
            full = root / "images" if folder in reduced else folder
            best = LocatedPhotos(full, dict(zip(names, tails)), found)
            if found == len(names):
                return best
    return best


def find_photo(folder: Path, name: str) -> Path | None:
    """Find the photo's file below `folder`; None if it is absent.

    Its suffix, upper and lower case, and whether letters are composed may differ.
    """
    exact = folder / name
    if exact.is_file():
        return exact
    if not exact.parent.is_dir():
        return None
    # A copy may be saved in another format; of a name with several dots only the last part is replaced.
    stem = exact.stem if exact.suffix.lower() in PHOTO_SUFFIXES else exact.name
    listed = _photos_by_stem(exact.parent, exact.parent.stat().st_mtime_ns)
    return listed.get(spelling_key(stem))


@functools.lru_cache(maxsize=256)
def _photos_by_stem(folder: Path, _mtime_ns: int) -> dict[str, Path]:
    photos: dict[str, Path] = {}
    files = sorted(p for p in folder.iterdir() if p.name[0] != "." and p.is_file())
    for path in sorted(files, key=lambda p: p.suffix.lower() not in (".png", ".jpg", ".jpeg")):
        if path.suffix.lower() in PHOTO_SUFFIXES or header_size(path) is not None:
            photos.setdefault(spelling_key(path.stem), path)
    return photos


def _folders(root: Path) -> tuple[list[Path], list[Path]]:
    """Return the folders that may hold photos, and those of reduced copies, images_N."""
    named = [root / name for name in PREFERRED]
    others = sorted(p for p in root.iterdir() if p.is_dir() and p.name[0] != "." and p not in named)
    reduced = [p for p in others if p.name.startswith("images_")]
    others = [p for p in others if p not in reduced and p.name.lower() not in NO_PHOTOS]
    return [folder for folder in (*named, *others) if folder.is_dir()], reduced


def _parts(name: str) -> tuple[str, ...]:
    """Split a path of any system, without its drive, its root and what leads upwards."""
    parts = PurePosixPath(unicodedata.normalize("NFC", name).replace("\\", "/")).parts
    after = 1 + max((k for k, part in enumerate(parts) if part in ("..", "/") or part[1:] == ":"), default=-1)
    return parts[after:] or parts[-1:]
