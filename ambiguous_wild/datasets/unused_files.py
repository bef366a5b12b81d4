"""Say which photos and files of a dataset an import leaves out."""

from __future__ import annotations

from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import PurePosixPath

from ambiguous_wild.core.errors import counted, shortlist
from ambiguous_wild.datasets.foreign import ForeignScene
from ambiguous_wild.io.mask_files import masks_beside_photos
from ambiguous_wild.io.photos import PHOTO_SUFFIXES

LISTS = ("train_list.txt", "test_list.txt")
TRANSFORMS = ("transforms.json", "transforms_train.json", "transforms_test.json")
# Layout -> entries of its folder that its reader uses, beside photos, masks and what its notes name.
READ = {
    "on-the-go": ("split.json", "transforms.json", *LISTS),
    "photo-tourism": ("*.tsv", "nerfw_split.csv", *LISTS),
    "nerfbaselines": ("nb-info.json", "split.json", "*.tsv", "nerfw_split.csv", *TRANSFORMS, *LISTS),
    "nerfstudio": ("transforms.json", *LISTS),
    "instant-ngp": ("transforms.json", *LISTS),
    "blender": TRANSFORMS[1:],
    "realityscan": ("*.csv", *LISTS),
    "metashape": ("*.xml", *LISTS),
    "polycam": ("keyframes", *LISTS),
    "record3d": ("metadata.json", *LISTS),
}
MODELS = ("sparse", "dense", "colmap")
NO_DATA = (  # what lies beside data and holds none
    ".*", "__macosx", "thumbs.db", "desktop.ini", "readme*", "licen[cs]e*", "*.md", "*.pdf", "*.zip",
    "*.tar*", "*.7z", "*.log", "*.db", "*.db-*", "*.ini", "*.sh", "*.py", "*.mp4", "*.mov", "*.html",
)  # fmt: skip


def what_is_left_out(scene: ForeignScene) -> list[str]:
    """Return notes on where photos are read, on photos that are in no side, and on unused entries."""
    notes = []
    if scene.photos.is_dir() and scene.photos.name not in ("images", scene.root.name):
        notes.append(f"photos are read from {scene.photos.relative_to(scene.root).as_posix()}/")
    registered = {image.name for image in scene.model.images.values()}
    told = " ".join(scene.notes)
    if (unlisted := sorted(registered - scene.split.keys())) and "left out" not in told:
        notes.append(
            f"{counted(len(unlisted), 'photo')} of the model in no list, left out: {shortlist(unlisted)}"
        )
    if unplaced := sorted(_photos(scene) - {without_folder(name) for name in registered}):
        notes.append(f"{counted(len(unplaced), 'photo')} without a pose, left out: {shortlist(unplaced)}")
    if unused := [name for name in _unused(scene) if name not in told]:
        notes.append(f"not used: {shortlist(unused, 8)}")
    return notes


def without_folder(name: str) -> str:
    """Return the base name of a photo without its extension, in lower case."""
    return PurePosixPath(name).stem.casefold()


def _photos(scene: ForeignScene) -> set[str]:
    if not scene.photos.is_dir() or scene.photos == scene.root:
        return set()
    masks = masks_beside_photos(scene.photos)
    files = (p for p in scene.photos.rglob("*") if p.suffix.lower() in PHOTO_SUFFIXES and p not in masks)
    return {without_folder(p.name) for p in files if p.name[0] != "."}


def _unused(scene: ForeignScene) -> Iterator[str]:
    folders = [scene.photos, *(mask.parent for mask in scene.masks.values())]
    used = {f.relative_to(scene.root).parts[0] for f in folders if f != scene.root}
    if scene.photos == scene.root:
        used |= {PurePosixPath(image.name).parts[0] for image in scene.model.images.values()}
    patterns = (*READ.get(scene.kind, LISTS), *MODELS, *NO_DATA, f"images_{scene.factor}")
    photos = {without_folder(image.name) for image in scene.model.images.values()}
    for path in sorted(scene.root.iterdir()):
        name = path.name.casefold()
        photo = path.is_file() and (path.suffix.lower() in PHOTO_SUFFIXES or without_folder(name) in photos)
        if path.name not in used and not photo and not any(fnmatch(name, p) for p in patterns):
            yield f"{path.name}/" if path.is_dir() else path.name
