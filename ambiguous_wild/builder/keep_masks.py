"""The user's keep masks, checked before structure from motion.

COLMAP drops a photo without a mask, without a message, and a mask of the wrong size removes most features.
Missing masks and wrong sizes are refused here, by name. White = keep, black = ignore, as in COLMAP.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ambiguous_wild.builder.records import FixedMask, MaskResult, ScreenedPhoto
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.io.images import orientation, read_alpha, read_gray, read_mask, upright, write_png
from ambiguous_wild.io.photos import TRANSPARENT
from ambiguous_wild.io.scene_folder import find_masks as by_name

LITTLE_KEPT = 0.3  # share of a photo; distractors rarely cover more than the rest


def find_masks(folder: Path, facts: list[ScreenedPhoto], missing: str) -> dict[str, Path]:
    """Find the mask file of each photo, by stem.

    How files are named: see `io.scene_folder.find_masks`.

    Args:
        folder: the user's mask folder.
        facts: screened photos.
        missing: "error", or "keep": a photo without a mask is used whole.

    Raises:
        AwError: no such folder, photos without a mask, masks of another size, or a file that is no mask.
    """
    if not folder.is_dir():
        what = "is a file; give the folder that holds the masks" if folder.exists() else "does not exist"
        raise AwError(f"mask folder {folder} {what}")
    mask_files: dict[str, Path] = {}
    unmasked, misfits = [], []
    sources = [fact["source"] for fact in facts]
    named = by_name(folder, sources) or by_name(folder, (s.removeprefix("images/") for s in sources))
    for fact in facts:
        path = named.get(fact["source"]) or named.get(fact["source"].removeprefix("images/"))
        if path is None:
            unmasked.append(fact["source"])
            continue
        height, width = upright(read_mask(path), orientation(path)).shape
        if (width, height) != (fact["width"], fact["height"]):
            misfits.append(f"{path.name} is {width}x{height} but its photo {fact['width']}x{fact['height']}")
        mask_files[fact["stem"]] = path
    if misfits:
        raise AwError(
            f"{len(misfits)} of {len(mask_files)} masks in {folder} have another size than their photo: "
            f"{shortlist(misfits, 3)}; resize them with nearest-neighbour sampling"
        )
    if unmasked and (missing == "error" or not mask_files):
        raise AwError(
            f"{len(unmasked)} of {len(facts)} photos have no mask: {shortlist(unmasked)}; add them under "
            f"{folder} as NAME.png, or pass --masks-missing keep to use those photos whole"
        )
    return mask_files


def alphas(capture: Path, facts: list[ScreenedPhoto]) -> dict[str, np.ndarray]:
    """Read the photos' alpha as keep masks, [H, W] uint8 in {0, 255}, by stem; opaque photos are absent."""
    masks = {}
    for fact in facts:
        if TRANSPARENT in fact["notes"] and (alpha := read_alpha(capture / fact["source"])) is not None:
            masks[fact["stem"]] = upright(alpha, fact["exif"].get("orientation", 1))
    return masks


def lay_out_masks(
    folder: Path, mask_files: dict[str, Path], facts: list[ScreenedPhoto], alpha: Mapping[str, np.ndarray]
) -> MaskResult:
    """Write every photo's mask times its alpha, 0 or 255, to `folder/masks/<work name>.png` for COLMAP."""
    (folder / "masks").mkdir()
    shares = {}
    for fact in facts:
        path = mask_files.get(fact["stem"])
        if path is None:
            mask = np.full((fact["height"], fact["width"]), 255, np.uint8)
        else:
            mask = upright(read_mask(path), orientation(path))
        if fact["stem"] in alpha:
            mask = np.minimum(mask, alpha[fact["stem"]])
        if path is not None or fact["stem"] in alpha:
            shares[fact["stem"]] = round(float((mask > 0).mean()), 4)
        write_png(folder / "masks" / f"{fact['work_name']}.png", mask)
    return {"kept_share": shares, "alpha": sorted(alpha)}


def add_fixed(
    folder: Path,
    facts: list[ScreenedPhoto],
    matches: Path,
    fixed: list[FixedMask],
    before: Path | None,
    shares: Mapping[str, float],
) -> dict[str, float]:
    """Write every photo's mask less what is fixed to the camera to `folder/masks/<work name>.png`.

    Args:
        folder: folder of the stage, empty.
        facts: screened photos.
        matches: folder of the fixed masks.
        fixed: fixed masks.
        before: folder of the masks so far, as `lay_out_masks` writes them; None: there are none.
        shares: stem -> share that these keep.

    Returns:
        stem -> share that is kept, of photos with a mask.
    """
    (folder / "masks").mkdir()
    kept, fixed_masks = dict(shares), {}
    for record in fixed:
        fixed_masks.update(dict.fromkeys(record["photos"], read_gray(matches / record["mask"])))
    for fact in facts:
        name = fact["work_name"]
        mask = read_gray(before / f"{name}.png") if before else None
        if name in fixed_masks:
            mask = fixed_masks[name] if mask is None else np.minimum(mask, fixed_masks[name])
            kept[fact["stem"]] = round(float((mask > 0).mean()), 4)
        if mask is None:
            mask = np.full((fact["height"], fact["width"]), 255, np.uint8)
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
