"""Names of keep masks in the spellings of the field's tools: to find masks, and to write them for a tool."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.names import spelling_key
from ambiguous_wild.core.scene import Split

MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
MASK_FOLDERS = ("masks", "mask", "segmentation", "dynamic_masks")  # of COLMAP, nerfstudio, LichtFeld
NO_PHOTOS = (  # folders whose images are no photos, in upper or lower case
    *MASK_FOLDERS, "truth", "depth", "depths", "confidence", "normals", "@eadir", "#recycle", "__macosx",
)  # fmt: skip
OWN_MASKS = "masks.json"  # marks a folder with instances of a segmentation, not keep masks
# a.jpg.mask.png: RealityScan; a.mask.png: OpenMVS; a_mask.png: Metashape
MARKS = (".mask", "_mask", "-mask")
SPELLINGS = (
    "a mask of a.jpg is called a.png, a.jpg.png, a.mask.png, a.jpg.mask.png, a_mask.png or mask_a.png; "
    ".jpg, .tif, .bmp and .webp are read too"
)


@dataclass(frozen=True)
class MaskStyle:
    """What a tool reads as the mask of a photo. Masks lie in folders as the photos do."""

    pattern: str  # of the name: of a.jpg, {stem} is a and {name} is a.jpg
    use: str  # how the tool takes them
    left_out: int = 0  # code of the pixels that the tool does not use, the others have 255 minus it


OWN_STYLE = MaskStyle("{stem}.png", "'aw build-scene --keep-masks' and 'aw bench --mask' read them")
# All of them read a mask as large as the photo. Left out is black, but for Postshot.
MASK_STYLES = {
    # pycolmap.ImageReaderOptions.mask_path: the photo's sub-path with .png added; nothing is extracted where
    # the mask is black.
    "colmap": MaskStyle("{name}.png", "colmap feature_extractor --ImageReader.mask_path MASKS"),
    # nerfstudio/data/dataparsers/colmap_dataparser.py: (masks_path / name).with_suffix(".png"); its docs,
    # data conventions: "Black corresponds to regions to ignore", and a mask for every photo.
    "nerfstudio": MaskStyle("{stem}.png", "ns-train METHOD --data DATA colmap --masks-path MASKS"),
    # Import Masks takes a template of names (agisoft.freshdesk.com/support/solutions/articles/31000162414);
    # agisoft-llc/metashape-scripts#86: its masks go to nerfstudio as they are, and a white one masks nothing.
    "metashape": MaskStyle("{stem}_mask.png", "File, Import, Import Masks: template {filename}_mask.png"),
    # rchelp.capturingreality.com/en-US/tools/imglayers.htm: DSC_0001.jpg.mask.png; tools/mask.htm: masks are
    # alpha channels, where white is what is seen. LichtFeld reads these files with white = used
    # (MrNeRF/LichtFeld-Studio#551).
    "realityscan": MaskStyle("{name}.mask.png", "put the masks beside the photos, then add both"),
    # jawset.com/docs/d/Postshot+User+Guide/Interface/Training+Configuration: the same base file name; "Remove
    # Occluders: the active (white) regions of the mask images will be ignored".
    "postshot": MaskStyle("{stem}.png", "Image Masks, Mask Mode: Remove Occluders", left_out=255),
    # MrNeRF/LichtFeld-Studio, src/io/include/io/filesystem_utils.hpp: DATA/masks, stem or name with .png;
    # #1314: values below 128 are to ignore.
    "lichtfeld": MaskStyle("{stem}.png", "put the folder into DATA as masks; --mask-mode ignore"),
}


def mask_names(photos: Iterable[str], style: MaskStyle) -> dict[str, str]:
    """Return the path of each photo's mask, relative to the folder of masks, as `find_masks` finds it.

    Raises:
        AwError: the masks of two photos would be one file.
    """
    names: dict[str, str] = {}
    taken: dict[str, str] = {}
    for photo in photos:
        pure = PurePosixPath(photo)
        names[photo] = str(pure.with_name(style.pattern.format(name=pure.name, stem=pure.stem)))
        other = taken.setdefault(spelling_key(names[photo]), photo)
        if other != photo:
            raise AwError(
                f"the masks of {other} and {photo} would both be {names[photo]}: rename one of the photos, "
                "or choose --for colmap, whose masks have the whole name"
            )
    return names


def find_masks(folder: Path, names: Iterable[str], files: set[Path] | None = None) -> dict[str, Path]:
    """Find mask files by the name of the photo; photos without one are absent.

    A mask is called as in `SPELLINGS`, in any format and case, and lies under the photo's path or, if no
    other photo has this base name, directly in `folder`. In a folder that holds the photos too, only files
    that are marked as masks are.

    Args:
        folder: of the masks.
        names: of the photos.
        files: what may be a mask, of this folder and others; None: all of it, or what is marked.
    """
    if files is None:
        files = _candidates(folder)
    files = {path for path in files if path.is_relative_to(folder)}
    there: dict[str, Path] = {}
    for path in sorted(files):
        there.setdefault(spelling_key(path.relative_to(folder).as_posix()), path)
    photos = [PurePosixPath(name) for name in names]
    bases = Counter(pure.name for pure in photos)
    masks: dict[str, Path] = {}
    for pure in photos if there else ():
        paths = [pure, PurePosixPath(pure.name)] if bases[pure.name] == 1 else [pure]
        for spelling in (s for path in paths for s in _spellings(path)):
            if (key := spelling_key(spelling)) in there:
                masks[str(pure)] = there[key]
                break
    return masks


def side_masks(folder: Path, names: Iterable[str], side: Split) -> dict[str, Path]:
    """Find the masks of one side's photos in `folder`, or in its folder of that side."""
    listed, files = list(names), _candidates(folder)
    return find_masks(folder, listed, files) | find_masks(folder / side, listed, files)


def mask_files(folder: Path) -> set[Path]:
    """Return all files below a folder that may be masks."""
    files = folder.rglob("*")
    return {p for p in files if p.suffix.lower() in MASK_SUFFIXES and p.name[:2] != "._" and p.is_file()}


def masks_beside_photos(folder: Path) -> set[Path]:
    """Return the files that are marked as masks of photos in the same folder, in it or below."""
    return _marked(mask_files(folder))


def _candidates(folder: Path) -> set[Path]:
    files = mask_files(folder)
    return _marked(files) or files


def _marked(files: set[Path]) -> set[Path]:
    names = {(p.parent, spelling_key(part)) for p in files for part in (p.name, p.stem)}
    return {p for p in files if any((p.parent, spelling_key(name)) in names for name in _masked(p))}


def _masked(path: Path) -> Iterator[str]:
    """Yield the names that the photo of a marked mask may have, with or without its extension."""
    for mark in MARKS:
        if path.stem.casefold().endswith(mark):
            yield path.stem[: -len(mark)]
    if path.stem.casefold().startswith("mask_"):
        yield path.stem[len("mask_") :]


def _spellings(photo: PurePosixPath) -> Iterator[str]:
    for name in (photo.name, photo.stem):
        for spelling in (name, *(name + mark for mark in MARKS), f"mask_{name}"):
            yield from (str(photo.with_name(f"{spelling}{suffix}")) for suffix in MASK_SUFFIXES)
