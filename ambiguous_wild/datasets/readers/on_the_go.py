"""Read NeRF On-the-go, whose split.json counts the sorted frames of transforms.json, and its copies."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.core.scene import Split
from ambiguous_wild.datasets.foreign import ForeignScene, plain, split_by_lists
from ambiguous_wild.datasets.readers.colmap import (
    model_folder,
    model_names,
    read_lists,
    read_named_model,
)
from ambiguous_wild.datasets.readers.transforms import frame_name, frames_of, read_frames, read_object
from ambiguous_wild.io.scene_folder import shipped_factors

DATASET = "NeRF On-the-go"
FACTOR, LOW_FACTOR = 8, 4
LOW_RESOLUTION = ("patio", "arcdetriomphe")  # 1920x1080 sources, published at factor 4
# Scenes with undistorted copies, which are recognised by name; the names of the others are common words.
SCENES = ("mountain", "fountain", "corner", "patio", "spot", "patio_high", "arcdetriomphe")


def is_scene_name(name: str) -> bool:
    """Tell whether a name is that of a scene of On-the-go, in any spelling."""
    return plain(name) in {plain(s) for s in SCENES}


def published_factor(root: Path) -> int:
    """Return the factor of images_N in the folder, else 4 for patio and arcdetriomphe, 8 for the others."""
    shipped = shipped_factors(root)
    if len(shipped) == 1:
        return shipped[0]
    return LOW_FACTOR if plain(root.resolve().name) in LOW_RESOLUTION else FACTOR


def read_split(path: Path, count: int) -> dict[str, list[int]]:
    """Read split.json: lists of positions in the sorted frames.

    Raises:
        AwError: damaged, without clutter or extra, or positions that the frames do not have.
    """
    data = read_object(path)
    positions: dict[str, list[int]] = {}
    for key in ("clutter", "extra", "clean"):
        rows: Any = data.get(key, [])
        if not isinstance(rows, list) or not all(
            isinstance(i, int) and not isinstance(i, bool) for i in rows
        ):
            raise AwError(f"{path}: {key!r} is no list of whole numbers")
        positions[key] = rows
    for key in ("clutter", "extra"):
        if not positions[key]:
            raise AwError(f"{path} has no {key!r}: clutter trains and extra tests")
    largest = max(max(positions["clutter"]), max(positions["extra"]))
    if largest >= count or min(min(positions["clutter"]), min(positions["extra"])) < 0:
        raise AwError(
            f"{path} counts up to {largest}, but transforms.json has {count} frames: they belong to "
            "two scenes"
        )
    both = sorted(set(positions["clutter"]) & set(positions["extra"]))
    if both:
        raise AwError(f"{path}: position {both[0]} is in clutter and in extra")
    return positions


def read_on_the_go(root: Path, chosen: str = "") -> ForeignScene:
    """Read the original dataset, with or without a COLMAP model in its folder, or an undistorted copy."""
    if not (root / "split.json").is_file():
        return _undistorted(root, chosen)
    path = root / "transforms.json"
    if not path.is_file():
        raise AwError(
            f"{root} has split.json without transforms.json, whose sorted frames its numbers count; "
            "copy it too"
        )
    data = read_object(path)
    names = sorted(
        (PurePosixPath(frame_name(f, root)) for f in frames_of(data, path)), key=lambda p: (p.name, str(p))
    )
    positions = read_split(root / "split.json", len(names))
    listed: dict[Split, list[str]] = {
        "train": [names[i].name for i in positions["clutter"]],
        "test": [names[i].name for i in positions["extra"]],
    }
    notes = [f"{len(positions['clean'])} clean photos are left out"] if positions["clean"] else []
    if model_folder(root) is not None:
        model, folder = read_named_model(root, chosen)
        notes.append("poses from the COLMAP model in the folder, names from transforms.json")
        points: Literal["model", "triangulate"] = "model"
    else:
        model, folder, _ = read_frames(root, path, data)
        notes.append("poses from transforms.json; the release has no points, so they are triangulated")
        points = "triangulate"
    split, missing = split_by_lists(model_names(model), listed, root / "split.json")
    scene = ForeignScene("on-the-go", root, model, folder, split, published_factor(root), missing)
    return replace(scene, dataset=DATASET, notes=tuple(notes), points=points)


def _undistorted(root: Path, chosen: str = "") -> ForeignScene:
    model, photos = read_named_model(root, chosen)
    odd = sorted({c.model for c in model.cameras.values()} - {"PINHOLE", "SIMPLE_PINHOLE"})
    split, missing = split_by_lists(model_names(model), read_lists(root), root)
    notes = (f"cameras are {shortlist(odd)}: undistorted here",) if odd else ()
    factor = _undistorted_factor(root, model)
    return ForeignScene(
        "on-the-go", root, model, photos, split, factor, missing, dataset=DATASET, notes=notes
    )


def _undistorted_factor(root: Path, model: Any) -> int:
    """Return the factor of images_N; 1 for copies that were reduced before (504 px), else as published."""
    longest = max(max(c.width, c.height) for c in model.cameras.values())
    factor = published_factor(root)
    return factor if shipped_factors(root) or longest / factor >= 200 else 1
