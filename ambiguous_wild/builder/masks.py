"""The user's keep masks, checked before structure from motion.

COLMAP drops a photo without a mask, without a message, and a mask of the wrong size removes most features.
Both are refused here, by name. White = keep, black = ignore, as in COLMAP.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ambiguous_wild.builder.records import MaskResult, ScreenedPhoto
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.images import read_mask, write_png
from ambiguous_wild.io.scene_folder import find_masks as by_name

LITTLE_KEPT = 0.3  # share of a photo; distractors rarely cover more than the rest


def find_masks(folder: Path, facts: list[ScreenedPhoto], missing: str) -> dict[str, Path]:
    """Mask file of each photo, by stem.

    Names: see `io.scene_folder.find_masks`; paths are those in the capture.

    Args:
        folder: the user's mask folder.
        facts: screened photos.
        missing: "error", or "keep": a photo without a mask is used whole.

    Raises:
        AwError: no such folder, photos without a mask, masks of another size, or what is no mask.
    """
    if not folder.is_dir():
        what = "is a file; give the folder that holds the masks" if folder.exists() else "does not exist"
        raise AwError(f"mask folder {folder} {what}")
    found: dict[str, Path] = {}
    unmasked, misfits = [], []
    sources = [fact["source"] for fact in facts]
    named = by_name(folder, sources) or by_name(folder, (s.removeprefix("images/") for s in sources))
    for fact in facts:
        path = named.get(fact["source"]) or named.get(fact["source"].removeprefix("images/"))
        if path is None:
            unmasked.append(fact["source"])
            continue
        height, width = read_mask(path).shape
        if (width, height) != (fact["width"], fact["height"]):
            misfits.append(f"{path.name} is {width}x{height} but its photo {fact['width']}x{fact['height']}")
        found[fact["stem"]] = path
    if misfits:
        raise AwError(
            f"{len(misfits)} of {len(found)} masks in {folder} have another size than their photo: "
            f"{shortlist(misfits, 3)}; resize them with nearest-neighbour sampling"
        )
    if unmasked and (missing == "error" or not found):
        raise AwError(
            f"{len(unmasked)} of {len(facts)} photos have no mask: {shortlist(unmasked)}; add them under "
            f"{folder} as NAME.png, or pass --masks-missing keep to use those photos whole"
        )
    return found


def lay_out_masks(folder: Path, found: dict[str, Path], facts: list[ScreenedPhoto]) -> MaskResult:
    """Write every photo's mask for COLMAP, `folder/masks/<work name>.png`, values 0 and 255."""
    (folder / "masks").mkdir()
    shares = {}
    for fact in facts:
        path = found.get(fact["stem"])
        if path is None:
            mask = np.full((fact["height"], fact["width"]), 255, np.uint8)
        else:
            mask = read_mask(path)
            shares[fact["stem"]] = round(float((mask > 0).mean()), 4)
        write_png(folder / "masks" / f"{fact['work_name']}.png", mask)
    return {"kept_share": shares}


def mask_warnings(facts: MaskResult | None) -> list[str]:
    """A warning where the masks keep so little of the photos that they may be inverted."""
    shares = list(facts["kept_share"].values()) if facts else []
    if not shares or np.median(shares) >= LITTLE_KEPT:
        return []
    return [
        f"the masks keep only {100 * np.median(shares):.0f} % of a photo (median): white = keep, black = "
        "ignore; are they inverted?"
    ]


def mask_hashes(found: dict[str, Path]) -> dict[str, str]:
    """sha256 of each mask file, by stem."""
    return {stem: sha256_file(path) for stem, path in sorted(found.items())}
