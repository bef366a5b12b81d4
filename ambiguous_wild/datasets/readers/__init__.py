"""Readers of public layouts, a file each, that turn a folder into a `ForeignScene`; recognise layouts."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path

from ambiguous_wild.core.errors import AwError, similar_path, unknown
from ambiguous_wild.datasets.foreign import ForeignScene, plain
from ambiguous_wild.datasets.readers import (
    colmap,
    metashape,
    nerfbaselines,
    on_the_go,
    phone,
    phototourism,
    realityscan,
    transforms,
)
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.mask_files import (
    MASK_FOLDERS,
    OWN_MASKS,
    SPELLINGS,
    mask_files,
    masks_beside_photos,
    side_masks,
)
from ambiguous_wild.io.scene_checks import check_masks
from ambiguous_wild.io.scene_folder import SIDES

READERS: dict[str, Callable[..., ForeignScene]] = {
    "on-the-go": on_the_go.read_on_the_go,
    "robustnerf": colmap.read_robustnerf,
    "photo-tourism": phototourism.read_phototourism,
    "drone": colmap.read_drone,
    "dualsplat": colmap.read_dualsplat,
    "nerfbaselines": nerfbaselines.read_nerfbaselines,
    "nerfstudio": transforms.read_transforms,
    "instant-ngp": transforms.read_transforms,
    "blender": transforms.read_blender,
    "realityscan": realityscan.read_realityscan,
    "metashape": metashape.read_metashape,
    "polycam": phone.read_polycam,
    "record3d": phone.read_record3d,
    "colmap": colmap.read_plain,
}
FINDERS: dict[str, Callable[[Path], Path | None]] = {  # find poses in folders without a COLMAP model
    "realityscan": realityscan.find_table,
    "metashape": metashape.find_cameras,
    "polycam": lambda root: next(root.glob("keyframes/*cameras"), None),
    "record3d": phone.find_metadata,
}
COLMAP_KINDS = ("on-the-go", "robustnerf", "photo-tourism", "drone", "dualsplat", "nerfbaselines", "colmap")
DRONE_SCENES = ("Cultural_Center", "TangTian", "Pavilion", "Simingshan", "Intersection", "Sculpture")


def recognise(root: Path) -> tuple[str, str]:
    """Return the folder's layout and the evidence for it.

    Raises:
        AwError: no layout, two that contradict each other, or a scene of ours.
    """
    if not root.is_dir():
        what = (
            "is a file; give the dataset's folder (unpack archives first)"
            if root.exists()
            else "does not exist" + similar_path(root)
        )
        raise AwError(f"dataset {root} {what}")
    if (root / "scene.json").is_file():
        raise AwError(f"{root} is a scene already (it holds scene.json): run 'aw bench' on it")
    candidates = _candidates(root)
    if not candidates:
        raise AwError(
            f"{root} has no known layout: no COLMAP model, transforms.json, transforms_train.json, "
            f"split.json, nb-info.json, or poses of {', '.join(FINDERS)}; give the folder of one scene, name "
            f"the layout with --as ({', '.join(READERS)}), or build a scene with 'aw build-scene'"
        )
    if len(candidates) > 1:
        layouts = "; ".join(f"{kind} ({why})" for kind, why in candidates)
        raise AwError(f"{root} may be two layouts, whose splits differ: {layouts}; choose one with --as")
    return candidates[0]


def _candidates(root: Path) -> list[tuple[str, str]]:
    """Return the layouts whose files the folder has; several only if they give different splits."""
    if (root / "nb-info.json").is_file():
        return [("nerfbaselines", "nb-info.json")]
    layouts = []
    if (root / "transforms_train.json").is_file():
        layouts.append(("blender", "transforms_train.json"))
    if (root / "split.json").is_file():
        layouts.append(("on-the-go", "split.json"))
    if sorted(root.glob("*.tsv")) or (root / "nerfw_split.csv").is_file():
        layouts.append(("photo-tourism", "a .tsv table"))
    elif (root / "dense" / "sparse").is_dir():
        layouts.append(("photo-tourism", "dense/sparse"))
    if layouts:
        return layouts
    folder = colmap.model_folder(root)
    if (root / "transforms.json").is_file() and (folder is None or not colmap.has_lists(root)):
        data = transforms.read_object(root / "transforms.json")
        studio = any(key in data for key in ("ply_file_path", "camera_model", "applied_transform"))
        return [("nerfstudio" if studio else "instant-ngp", "transforms.json")]
    if folder is None:
        return [(kind, path.name) for kind, find in FINDERS.items() if (path := find(root)) is not None]
    if (root / "sam_masks").is_dir() or (root / "pseudo_masks").is_dir():
        return [("dualsplat", "sam_masks or pseudo_masks")]
    if (root / "masks" / "masks.json").is_file():
        return [("drone", "masks/masks.json")]
    if colmap.has_lists(root):
        name = plain(root.resolve().name)
        if on_the_go.is_scene_name(name):
            return [("on-the-go", f"lists, and a scene called {root.resolve().name}")]
        if name in {plain(s) for s in DRONE_SCENES}:
            return [("drone", f"lists, and a scene called {root.resolve().name}")]
        return [("colmap", "a COLMAP model and lists")]
    if colmap.has_keywords(image.name for image in read_model(folder).images.values()):
        return [("robustnerf", "clutter and extra in the names")]
    return [("colmap", "a COLMAP model")]


def read_foreign(root: Path, kind: str | None = None, model: str = "") -> tuple[ForeignScene, str]:
    """Read a dataset's scene.

    Args:
        root: its folder.
        kind: the layout; None = recognise it.
        model: name of one of several COLMAP models; empty = the one with most photos.

    Returns:
        The scene, and why it is taken for this layout.

    Raises:
        AwError: unknown layout, or a folder in another layout.
    """
    if kind is None:
        kind, why = recognise(root)
    else:
        if kind not in READERS:
            raise unknown("layout", kind, READERS)
        if not root.is_dir():
            raise AwError(f"dataset {root} does not exist or is no folder")
        why = "--as"
    if kind == "colmap" and (table := phototourism.find_table(root)) is not None:
        raise AwError(
            f"{table} is a table of splits, which --as colmap would not follow: pass --as photo-tourism, "
            "or move the table away"
        )
    if kind not in COLMAP_KINDS:
        if model:
            raise AwError(f"--model {model} chooses among COLMAP models, which layout {kind} does not use")
        return READERS[kind](root), why
    scene = READERS[kind](root, model)
    note = colmap.which_model(root, model)
    return (dataclasses.replace(scene, notes=(*scene.notes, note)) if note else scene), why


def with_masks(scene: ForeignScene) -> ForeignScene:
    """Add the keep masks beside the photos or in a folder of masks, unless the dataset's files name masks.

    Raises:
        AwError: there are masks, and none is of a photo of the scene.
    """
    train, test = ([name for name, of in scene.split.items() if of == side] for side in SIDES)
    by_side, files = scene.masks, set(scene.masks.values())
    base = scene.photos.parent if scene.photos != scene.root else scene.root
    there = [p for place in (base, scene.photos) if place.is_dir() for p in sorted(place.iterdir())]
    named = [p for p in there if p.is_dir() and p.name.lower() in MASK_FOLDERS]
    folder = min(named, key=lambda p: MASK_FOLDERS.index(p.name.lower()), default=scene.photos)
    if by_side:
        folder = Path(os.path.commonpath({mask.parent for mask in files}))
    elif scene.kind not in ("drone", "dualsplat", "blender") and not (folder / OWN_MASKS).is_file():
        files = masks_beside_photos(folder) if folder == scene.photos else mask_files(folder)
        if files:
            by_side = side_masks(folder, train, "train") | side_masks(folder, test, "test")
        elif named:
            note = f"not used: {folder.name}/ holds no mask: {SPELLINGS}"
            scene = dataclasses.replace(scene, notes=(*scene.notes, note))
    used = {name: mask for name, mask in by_side.items() if scene.split.get(name) == "train"}
    tests = {mask for name, mask in by_side.items() if scene.split.get(name) == "test"}
    notes = (*scene.notes, *check_masks(folder, files, used, tests, train))
    return dataclasses.replace(scene, masks=by_side, notes=notes)
