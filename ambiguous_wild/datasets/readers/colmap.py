"""Read COLMAP models with photos: plain, with lists, and published datasets in this form."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path, PurePosixPath

from ambiguous_wild.core.errors import AwError, shortlist, unknown
from ambiguous_wild.core.scene import Split
from ambiguous_wild.datasets.foreign import ForeignScene, inside, split_by_lists
from ambiguous_wild.datasets.photo_names import locate
from ambiguous_wild.io.colmap_model import POINT_CLOUD, read_model
from ambiguous_wild.io.colmap_records import ColmapModel
from ambiguous_wild.io.scene_folder import (
    SIDES,
    default_split,
    models_in,
    read_list,
    registered,
    several_models,
    shipped_factors,
)

LISTS: dict[Split, str] = {"train": "train_list.txt", "test": "test_list.txt"}
KEYWORDS: dict[str, Split | None] = {"clutter": "train", "extra": "test", "clean": None}
MODEL_FOLDERS = (
    "sparse",
    "dense/sparse",
    "dense/0/sparse",
    "colmap/sparse",
)  # each may hold numbered models instead
DRONE_WIDTH = 1920  # px to which DroneSplat's loader reduces wider photos


def model_folder(root: Path, chosen: str = "") -> Path | None:
    """Find the folder of the COLMAP model called `chosen`, else of the largest; None without a model.

    Raises:
        AwError: no model is called `chosen`.
    """
    models = models_in(root, MODEL_FOLDERS)
    if not models:
        return next((f for f in (root, root / "images") if registered(f)), None)  # beside the photos
    if not chosen:
        return models[0][0]
    by_name = {folder.name: folder for folder, _ in models}
    if chosen not in by_name:
        raise unknown("model", chosen, by_name)
    return by_name[chosen]


def which_model(root: Path, chosen: str = "") -> str:
    """Return a note if there are several models; empty for a single one."""
    folder = model_folder(root, chosen)
    models = models_in(root, MODEL_FOLDERS)
    return several_models(models, folder) if folder is not None and models else ""


def read_named_model(root: Path, chosen: str) -> tuple[ColmapModel, Path]:
    """Read the model and find the folder of its photos, whose paths in it become their names.

    Args:
        root: the dataset's folder.
        chosen: name of one of several models, or "".

    Raises:
        AwError: no model, a damaged one, or a name that no list can hold.
    """
    folder = model_folder(root, chosen)
    if folder is None:
        raise AwError(
            f"{root} has no COLMAP model in {', '.join(MODEL_FOLDERS)}; build a scene from the photos "
            "with 'aw build-scene'"
        )
    model = read_model(folder)
    located = locate(root, [image.name for image in model.images.values()])
    for number, image in model.images.items():
        model.images[number] = replace(image, name=inside(located.names[image.name], root))
    return model, located.folder


def model_names(model: ColmapModel) -> list[str]:
    """Return the names of the registered photos, sorted."""
    return sorted(image.name for image in model.images.values())


def read_lists(root: Path) -> dict[Split, list[str]]:
    """Read train_list.txt and test_list.txt.

    Raises:
        AwError: one is missing, empty or unreadable.
    """
    listed: dict[Split, list[str]] = {}
    for side in SIDES:
        path = root / LISTS[side]
        try:
            listed[side] = read_list(path)
        except OSError as error:
            raise AwError(
                f"{path}: {error.strerror}; both {LISTS['train']} and {LISTS['test']} are needed"
            ) from error
        if not listed[side]:
            raise AwError(f"{path} is empty: it must name the {side} photos, one a line")
    return listed


def has_lists(root: Path) -> bool:
    """Tell whether the folder has at least one of the two lists."""
    return any((root / name).is_file() for name in LISTS.values())


def sides(names: Iterable[str], root: Path) -> tuple[dict[str, Split], dict[Split, list[str]], list[str]]:
    """Return sides by the folder's lists, else as 3DGS splits; listed names without photo; notes."""
    if has_lists(root):
        return *split_by_lists(names, read_lists(root), root), []
    split, note = default_split(root, names)
    return split, {}, [note]


def read_plain(root: Path, chosen: str = "") -> ForeignScene:
    """Read a COLMAP model with images, split by lists, else by every 8th photo."""
    model, photos = read_named_model(root, chosen)
    factors = shipped_factors(root)
    factor = factors[0] if len(factors) == 1 and not photos.is_dir() else 1
    split, missing, notes = sides(model_names(model), root)
    folder = model_folder(root, chosen)
    if len(model.points.ids) and folder is not None and not any(folder.glob("points3D.[bt][ix][nt]")):
        notes.append(f"points from {POINT_CLOUD}, without the photos that see them")
    return ForeignScene("colmap", root, model, photos, split, factor, missing, notes=tuple(notes))


def keyword_sides(names: Iterable[str]) -> dict[str, Split | None]:
    """Split by keyword in the file name: clutter = train, extra = test, clean = left out.

    Raises:
        AwError: a name with no keyword, or with two.
    """
    side_of: dict[str, Split | None] = {}
    odd = []
    for name in names:
        hits = [word for word in KEYWORDS if word in PurePosixPath(name).name.casefold()]
        if len(hits) == 1:
            side_of[name] = KEYWORDS[hits[0]]
        else:
            odd.append(f"{name} ({' and '.join(hits) or 'none'})")
    if odd:
        raise AwError(
            f"{len(odd)} photos do not have exactly one of the words {', '.join(KEYWORDS)} in their names: "
            f"{shortlist(odd, 3)}; rename or remove them, or write train_list.txt and test_list.txt and pass "
            "--as colmap"
        )
    return side_of


def has_keywords(names: Iterable[str]) -> bool:
    """Tell whether some names have "clutter" and others "extra"."""
    bases = [PurePosixPath(n).name.casefold() for n in names]
    return any("clutter" in b for b in bases) and any("extra" in b for b in bases)


def read_robustnerf(root: Path, chosen: str = "") -> ForeignScene:
    """Read RobustNeRF, also as SpotLessSplats and RobustSplat publish it: the split is in the file names."""
    model, photos = read_named_model(root, chosen)
    sides = keyword_sides(model_names(model))
    split: dict[str, Split] = {name: side for name, side in sides.items() if side is not None}
    lacking = [side for side in SIDES if side not in split.values()]
    if lacking:
        word = {side: word for word, side in KEYWORDS.items() if side}[lacking[0]]
        raise AwError(f"{root} has no {lacking[0]} photo: no name holds {word!r}; copy all of the release")
    clean = sum(side is None for side in sides.values())
    notes = (f"{clean} clean repeats of training views are left out",) if clean else ()
    factor = _published_factor(root, model)
    dataset = "" if factor == 1 else "RobustNeRF"
    return ForeignScene("robustnerf", root, model, photos, split, factor, dataset=dataset, notes=notes)


def _published_factor(root: Path, model: ColmapModel) -> int:
    """Return 8, the factor of the papers, or 1 for photos that were downsampled before COLMAP ran."""
    longest = max(max(c.width, c.height) for c in model.cameras.values())
    return 8 if longest / 8 >= 200 or 8 in shipped_factors(root) else 1


def first_dot(name: str) -> str:
    """Return the base name up to its first dot, by which DroneSplat compares names."""
    return PurePosixPath(name).name.partition(".")[0]


def read_drone(root: Path, chosen: str = "") -> ForeignScene:
    """Read DroneSplat's Drone Imagery: lists with names up to their first dot, photos at most 1920 px."""
    model, photos = read_named_model(root, chosen)
    split, missing = split_by_lists(model_names(model), read_lists(root), root, first_dot)
    notes: tuple[str, ...] = ()
    if (root / "masks").is_dir():
        notes = ("masks/ holds instances of a segmentation, not keep masks of the dataset: left out",)
    scene = ForeignScene("drone", root, model, photos, split, missing=missing, notes=notes)
    return replace(scene, max_width=DRONE_WIDTH, dataset="Drone Imagery")


def read_dualsplat(root: Path, chosen: str = "") -> ForeignScene:
    """Read scenes as DualSplat prepares them: lists, beside its own masks and depths, which are left out."""
    model, photos = read_named_model(root, chosen)
    split, missing = split_by_lists(model_names(model), read_lists(root), root)
    own = [n for n in ("sam_masks", "pseudo_masks", "depths") if (root / n).is_dir()]
    notes = (f"{', '.join(own)} are results of a method: left out",)
    factor = _published_factor(root, model)
    return ForeignScene("dualsplat", root, model, photos, split, factor, missing, notes=notes)
