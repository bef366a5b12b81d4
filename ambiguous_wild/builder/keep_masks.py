"""The user's keep masks, checked before structure from motion.

COLMAP drops a photo without a mask, without a message, and a mask of the wrong size removes most features.
Missing masks and wrong sizes are refused here, by name. White = keep, black = ignore, as in COLMAP.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ambiguous_wild.builder.records import FixedMask, MaskResult, ScreenedPhoto
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import (
    header_size,
    orientation,
    read_alpha,
    read_gray,
    read_mask,
    upright,
    write_png,
)
from ambiguous_wild.io.mask_files import SPELLINGS
from ambiguous_wild.io.mask_files import find_masks as by_name
from ambiguous_wild.io.photos import TRANSPARENT

LITTLE_KEPT = 0.3  # share of a photo; distractors rarely cover more than the rest


def find_masks(folder: Path, photos: Sequence[ScreenedPhoto], missing: str) -> dict[str, Path]:
    """Find the mask file of each photo, by stem.

    How files are named: see `io.mask_files.find_masks`.

    Args:
        folder: the user's mask folder.
        photos: of the capture.
        missing: "error", or "keep": a photo without a mask is used whole.

    Raises:
        AwError: no such folder, photos without a mask, or masks of another size.
    """
    if not folder.is_dir():
        what = "is a file; give the folder that holds the masks" if folder.exists() else "does not exist"
        raise AwError(f"mask folder {folder} {what}")
    sources = [photo.source for photo in photos]
    named = by_name(folder, sources) or by_name(folder, (s.removeprefix("images/") for s in sources))
    mask_files: dict[str, Path] = {}
    unmasked, misfits = [], []
    for photo in photos:
        path = named.get(photo.source) or named.get(photo.source.removeprefix("images/"))
        if path is None:
            unmasked.append(photo.source)
            continue
        if mask_orientation(path, photo) is None:
            width, height = _stored_size(path)
            misfits.append(f"{path.name} is {width}x{height} but its photo {photo.width}x{photo.height}")
        mask_files[photo.stem] = path
    if misfits:
        raise AwError(
            f"{len(misfits)} of {len(mask_files)} masks in {folder} have another size than their photo: "
            f"{shortlist(misfits, 3)}; resize them with nearest-neighbour sampling"
        )
    if unmasked and (missing == "error" or not mask_files):
        how = " as NAME.png, or pass --masks-missing keep to use those photos whole"
        raise AwError(
            f"{len(unmasked)} of {len(photos)} photos have no mask: {shortlist(unmasked)}; add them under "
            f"{folder}{how if mask_files else f': {SPELLINGS}'}"
        )
    return mask_files


def mask_orientation(path: Path, photo: ScreenedPhoto) -> int | None:
    """Return the EXIF orientation to apply to a mask: its own, or that of a photo it was drawn on as stored.

    None: neither gives the photo's size.

    Raises:
        AwError: the file does not decode.
    """
    stored, own = _stored_size(path), orientation(path)
    for turn in (own, photo.exif.get("orientation", 1) if own == 1 else own):
        if (stored[::-1] if turn > 4 else stored) == photo.size:
            return turn
    return None


def _stored_size(path: Path) -> tuple[int, int]:
    width, height = header_size(path) or read_mask(path).shape[::-1]
    return width, height


def alpha_mask(capture: Path, photo: ScreenedPhoto) -> np.ndarray | None:  # [H, W] uint8 in {0, 255}
    """Read a photo's alpha as a keep mask, upright; None where it is opaque."""
    alpha = read_alpha(capture / photo.source) if TRANSPARENT in photo.notes else None
    return None if alpha is None else upright(alpha, photo.exif.get("orientation", 1))


def write_colmap_masks(
    folder: Path, mask_files: Mapping[str, Path], photos: Sequence[ScreenedPhoto], capture: Path
) -> MaskResult:
    """Write every photo's mask times its alpha, 0 or 255, to `folder/masks/<name>.png` for COLMAP.

    Args:
        folder: folder of the stage.
        mask_files: stem -> mask; photos without one are absent.
        photos: of the capture.
        capture: the capture's folder.

    Raises:
        AwError: a file that is no mask.
    """
    (folder / "masks").mkdir()
    shares, transparent = {}, []
    for photo in photos:
        path, alpha = mask_files.get(photo.stem), alpha_mask(capture, photo)
        if path is None:
            mask = np.full((photo.height, photo.width), 255, np.uint8)
        else:
            mask = upright(read_mask(path), mask_orientation(path, photo) or 1)
        if alpha is not None:
            transparent.append(photo.stem)
            mask = np.minimum(mask, alpha)
        if path is not None or alpha is not None:
            shares[photo.stem] = round(float((mask > 0).mean()), 4)
        write_png(folder / "masks" / f"{photo.name}.png", mask)
    return {"kept_share": shares, "alpha": sorted(transparent)}


def add_fixed(
    folder: Path,
    photos: Sequence[ScreenedPhoto],
    matches: Path,
    fixed: list[FixedMask],
    before: Path | None,
    shares: Mapping[str, float],
) -> dict[str, float]:
    """Write every photo's mask less what is fixed to the camera to `folder/masks/<name>.png`.

    Args:
        folder: folder of the stage, empty.
        photos: of the capture.
        matches: folder of the fixed masks.
        fixed: fixed masks.
        before: folder of the masks so far, as `write_colmap_masks` writes them; None: there are none.
        shares: stem -> share that these keep.

    Returns:
        stem -> share that is kept, of photos with a mask.
    """
    (folder / "masks").mkdir()
    kept, fixed_masks = dict(shares), {}
    for record in fixed:
        fixed_masks.update(dict.fromkeys(record["photos"], read_gray(matches / record["mask"])))
    for photo in photos:
        name = photo.name
        mask = read_gray(before / f"{name}.png") if before else None
        if name in fixed_masks:
            mask = fixed_masks[name] if mask is None else np.minimum(mask, fixed_masks[name])
            kept[photo.stem] = round(float((mask > 0).mean()), 4)
        if mask is None:
            mask = np.full((photo.height, photo.width), 255, np.uint8)
        write_png(folder / "masks" / f"{name}.png", mask)
    return kept


def mask_warnings(facts: MaskResult | None) -> list[str]:
    """Warn of alpha that hides pixels, and of masks that keep so little that they may be inverted."""
    shares = list(facts["kept_share"].values()) if facts else []
    warnings = []
    if hidden := len(facts.get("alpha", ())) if facts else 0:
        warnings = [
            f"alpha of {counted(hidden, 'photo')} hides pixels: nothing is learnt from them, and psnr_valid "
            "of test photos leaves them out"
        ]
    if not shares or np.median(shares) >= LITTLE_KEPT:
        return warnings
    return [
        *warnings,
        f"the masks keep only {100 * np.median(shares):.0f} % of a photo (median): white = keep, black = "
        "ignore; are they inverted?",
    ]


def mask_hashes(mask_files: dict[str, Path]) -> dict[str, str]:
    """Return the sha256 of each mask file, by stem."""
    return {stem: sha256_file(path) for stem, path in sorted(mask_files.items())}
