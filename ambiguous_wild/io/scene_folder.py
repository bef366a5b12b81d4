"""Read scene folders: ours (with scene.json), and plain COLMAP scenes as gsplat and 3DGS read them."""

from __future__ import annotations

import json
import shlex
import warnings
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, Literal, TypeGuard, cast

import numpy as np

from ambiguous_wild.core import AwError, Camera, Scene, SparsePoints, View
from ambiguous_wild.core.errors import shortlist, similar_path
from ambiguous_wild.core.names import check_name, plain, quoted, stays_below
from ambiguous_wild.core.scene import SceneInfo, Split, centred
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelImage
from ambiguous_wild.io.files import sha256_file, unique_keys
from ambiguous_wild.io.images import image_size
from ambiguous_wild.io.mask_files import OWN_MASKS, mask_files, side_masks
from ambiguous_wild.io.scene_checks import check_masks, check_scene

SCENE_SCHEMA = 1  # version of scene.json, raised when an older reader would misread it
MAX_FACTOR = 1000  # largest downsampling factor; the builder allows 64
SIDES: tuple[Split, Split] = ("train", "test")
MAP = "map.png"  # in the scene's folder: the cameras from above
TEST_EVERY = 8  # in scenes without lists every 8th photo is a test photo, as in 3DGS and gsplat
ALL_TRAINED = "none"  # "split" in scene.json: there are no test photos, and none are missed
TESTS_OF_3DGS = "test.txt"  # names of test photos, one a line

_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")


def load_scene(
    path: Path | str,
    *,
    factor: int | None = None,
    verify: bool | Literal["quick"] = True,
    raw: bool = False,
    check: bool = True,
) -> Scene:
    """Open a scene folder.

    Args:
        path: our scene folder, or a plain COLMAP scene (``images/`` and ``sparse/0``).
        factor: 1 opens ``images/``, n opens ``images_n/``; None: the factor of scene.json.
        verify: True compares the sha256 of every file in scene.json, "quick" the sizes, False nothing.
        check: ask what `scene_checks` lists, for which photos may be read, and warn; not where a run is only
            looked at, or the scene was asked before.
        raw: keep the files' coordinates; else a scene far from the origin, or too large or small for float32
            and the nearest depth, is moved and scaled (`Scene.transform`).

    Returns:
        The scene: views ordered by name, intrinsics at the size of the loaded files, tracks in px of these
        files. ``info["warnings"]`` holds what it warned of. Observations in photos without 2D points in the
        model have view -1.

    Raises:
        AwError: no scene, an invalid name, a changed file, lists that do not fit the model, or a scene that
            would give a wrong result.
    """
    root = Path(path)
    if root.is_file():
        raise AwError(f"{root} is a file, not a scene folder; give the folder: {root.parent}")
    if not root.is_dir():
        hint = similar_path(root) or f"; 'aw build-scene PHOTOS -o {shlex.quote(str(root))}' makes one"
        raise AwError(f"there is no scene folder {root}{hint}")
    read = read_scene_json(root)
    if read is not None and verify:
        verify_files(root, read, quick=verify == "quick")
    # The model is looked for first, so that the error for a folder of mere photos says that it has none.
    sparse = model_folder(root, () if read is None else read["files"])
    chosen = _default_factor(root, read) if factor is None else factor
    folder = _image_folder(root, chosen)
    info: SceneInfo = {} if read is None else read.copy()
    # Runs are written to a folder of this name, so the name in a downloaded scene must be safe.
    try:
        name = check_name(f"scene name in {root}", info.get("name", root.resolve().name))
    except AwError as error:
        cure = 'change "name" in scene.json' if "name" in info else "rename the folder"
        raise AwError(f"{error}; {cure}") from error
    model = read_model(sparse)
    info["loaded_factor"] = chosen
    split, missing, warning = _split(root, [image.name for image in model.images.values()])
    info["missing"] = missing
    info["warnings"] = [warning] if warning else []
    info["warnings"] += [
        f"{len(names)} {side} photos of the list are not in the model: {shortlist(names)}"
        for side, names in missing.items()
        if names
    ]
    if read is None and (note := several_models(models_in(root), sparse)):
        info["warnings"].append(note)
    masks: dict[str, Path] = {}
    if read is None and (root / "masks").is_dir() and not (root / "masks" / OWN_MASKS).is_file():
        for side in SIDES:
            masks |= side_masks(root / "masks", [n for n, of in split.items() if of == side], side)
    views = tuple(
        _view(root, folder, model, image, split[image.name], masks.get(image.name))
        for image in sorted(model.images.values(), key=lambda i: i.name)
        if image.name in split
    )
    _check_reduced(model, views, chosen)
    for side in SIDES:
        refuse_same_stems(root, [v.name for v in views if v.split == side])
    if not any(v.split == "train" for v in views):
        raise AwError(f"{root} has no training photo: none of train_list.txt is in the model; build it again")
    scene = Scene(root, name, views, _points(model, views), info)
    if check:
        info["warnings"] += [*_mask_warnings(root, scene, read), *check_scene(scene)]
        for warning in info["warnings"]:
            warnings.warn(plain(f"{name}: {warning}"), stacklevel=2)
    return scene if raw else centred(scene)


def read_scene_json(root: Path | str) -> SceneInfo | None:
    """Read scene.json; None if the scene has none.

    Raises:
        AwError: it does not parse, has a newer schema, or a key that readers need has the wrong type.
    """
    path = Path(root) / "scene.json"
    if not path.is_file():
        return None
    try:
        info = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=unique_keys)
    except (ValueError, RecursionError) as error:
        raise AwError(f"{path} is damaged ({error}); build the scene again with 'aw build-scene'") from error
    version = info.get("schema_version") if isinstance(info, dict) else None
    if not _is_count(version):
        raise AwError(f"{path} has no schema_version, so it is not a scene.json of 'aw build-scene'")
    if version > SCENE_SCHEMA:
        raise AwError(
            f"{path} has schema {version}, this version reads up to {SCENE_SCHEMA}: update ambiguous-wild"
        )
    _check_fields(path, info)
    return cast(SceneInfo, info)


def _check_fields(path: Path, info: dict[str, object]) -> None:
    """Raise AwError where a key that readers need has the wrong type."""
    factor, name, files = info.get("factor"), info.get("name", ""), info.get("files")
    wrong = []
    if not _is_count(factor) or not 1 <= factor <= MAX_FACTOR:
        wrong.append(f"factor must be a whole number from 1 to {MAX_FACTOR}, not {quoted(factor)}")
    if not isinstance(name, str):
        wrong.append(f"name must be a text, not {quoted(name)}")
    behind = info.get("background", [0, 0, 0])
    if not isinstance(behind, list) or len(behind) != 3 or not all(_is_count(c) and c < 256 for c in behind):
        wrong.append(f"background must be three whole numbers from 0 to 255, not {quoted(behind)}")
    if not isinstance(files, dict):
        wrong.append("it lists no files")
    else:
        odd = [quoted(file) for file, entry in files.items() if not _is_file_entry(entry)]
        wrong += (
            [f"under files, sha256 or bytes is absent or has the wrong type: {shortlist(odd)}"] if odd else []
        )
    if wrong:
        raise AwError(f"{path} is damaged ({'; '.join(wrong)}); restore it, or build the scene again")


def _is_file_entry(entry: Any) -> bool:
    fields = entry if isinstance(entry, dict) else {}
    return isinstance(fields.get("sha256"), str) and _is_count(fields.get("bytes"))


def _is_count(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def verify_files(root: Path | str, info: SceneInfo, *, quick: bool = False) -> None:
    """Compare the scene's files with scene.json.

    Args:
        root: the scene folder.
        info: from `read_scene_json`.
        quick: compare sizes only.

    Raises:
        AwError: files are missing or changed; the message names them.
    """
    base, files = Path(root), info["files"]
    wrong = []
    for name, known in files.items():
        path = base / _inside(name, base)
        if not path.is_file():
            wrong.append(f"{name} (missing)")
        elif path.stat().st_size != known["bytes"] or (not quick and sha256_file(path) != known["sha256"]):
            wrong.append(f"{name} (changed)")
    if wrong:
        command = "import DATASET" if "imported" in info else "build-scene PHOTOS"
        raise AwError(
            f"{len(wrong)} of {len(files)} files of {base} differ from what scene.json recorded: "
            f"{shortlist(wrong)}; restore them, or build the scene again with "
            f"'aw {command} -o SCENE --overwrite'"
        )


def without_suffix(name: str) -> str:
    """Return the name without its last extension."""
    return str(PurePosixPath(name).with_suffix(""))


def read_list(path: Path) -> list[str]:
    """Read the names of a split list, one a line; empty lines are skipped."""
    data = path.read_bytes()
    # Editors write a byte order mark, and PowerShell's > writes UTF-16.
    utf16 = data.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = data.decode("utf-16" if utf16 else "utf-8-sig", errors="replace" if utf16 else "surrogateescape")
    return [line.strip() for line in text.splitlines() if line.strip()]


def _inside(name: str, root: Path) -> str:
    if not stays_below(name):
        raise AwError(
            f"{root} names a file outside itself: {name!r}; if its photos lie in it, "
            f"'aw import {shlex.quote(str(root))} -o SCENE' finds them"
        )
    return name


def models_in(root: Path, places: Iterable[str] = ("sparse", "colmap/sparse")) -> list[tuple[Path, int]]:
    """List the COLMAP models of the first place that has any, with numbers of photos, largest first."""
    for place in places:
        inner = sorted((root / place).glob("*/"), key=lambda p: (p.name != "0", p.name))
        for folders in (inner, [root / place]):
            models = [
                (folder, registered(folder))
                for folder in folders
                if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()
            ]
            if models:
                return sorted(models, key=lambda item: -item[1])
    return []


def registered(folder: Path) -> int:
    """Return the number of photos of a COLMAP model from the head of its file; 0 if it cannot be read."""
    try:
        if (folder / "images.bin").is_file():
            with open(folder / "images.bin", "rb") as f:
                return int.from_bytes(f.read(8), "little")
        with open(folder / "images.txt", "rb") as f:
            return (sum(not line.startswith(b"#") for line in f) + 1) // 2
    except OSError:
        return 0


def several_models(models: list[tuple[Path, int]], used: Path) -> str:
    """Return a line that says which of several models is read; empty for a single model."""
    others = [f"{folder.name} ({count})" for folder, count in models if folder != used]
    if not others:
        return ""
    photos = dict(models)[used]
    return (
        f"{used.parent.name} holds {len(models)} COLMAP models: {used.name} with {photos} photos is read, "
        f"not {shortlist(others)}; 'aw import --model NAME' reads another"
    )


def model_folder(root: Path, listed: Collection[str] = ()) -> Path:
    """Return the folder of the scene's COLMAP model; of several, the one with most photos.

    Args:
        root: the scene folder.
        listed: files of scene.json; a model that is not among them was put there later and is not read.

    Raises:
        AwError: there is none.
    """
    if models := models_in(root):
        known = {PurePosixPath(name).parent.as_posix() for name in listed}
        ours = (folder for folder, _ in models if folder.relative_to(root).as_posix() in known)
        return next(ours, models[0][0])
    if inner := [str(child) for child in sorted(root.glob("*/")) if models_in(child)]:
        raise AwError(f"{root} is no scene; did you mean {shortlist(inner, 3)}?")
    raise AwError(
        f"{root} is no scene: neither sparse/0 nor sparse holds a COLMAP model; "
        f"if it holds photos, build one with 'aw build-scene {shlex.quote(str(root))} -o SCENE'"
    )


def _default_factor(root: Path, info: SceneInfo | None) -> int:
    if info is not None:
        return int(info["factor"])
    found = shipped_factors(root)
    return found[0] if len(found) == 1 and not (root / "images").is_dir() else 1


def shipped_factors(root: Path) -> list[int]:
    """Return the factors N of the downsampled folders images_N, ascending."""
    tails = (p.name.removeprefix("images_") for p in root.glob("images_*") if p.is_dir())
    return sorted(int(t) for t in tails if t.isdigit() and 1 < int(t) <= MAX_FACTOR)


def _image_folder(root: Path, factor: int) -> Path:
    folder = root / ("images" if factor == 1 else f"images_{factor}")
    if factor < 1 or not folder.is_dir():
        have = (["1 (images)"] if (root / "images").is_dir() else []) + [
            str(f) for f in shipped_factors(root)
        ]
        raise AwError(
            f"{root} has no images at factor {factor}; it has factor {', '.join(have) or 'none'}; "
            f"pass one of those, or read it with 'aw import {shlex.quote(str(root))} -o SCENE --factor "
            f"{max(factor, 1)}'"
        )
    return folder


def _unique_keys(names: Sequence[str]) -> dict[str, str]:
    """Return photos by their names, with and without suffix, and by base names that no other photo has."""
    by_key = {key: name for name in names for key in (without_suffix(name), name)}
    bases = Counter(PurePosixPath(name).name for name in names)
    for name in names:
        base = PurePosixPath(name).name
        if bases[base] == 1:
            by_key |= {key: name for key in (without_suffix(base), base) if key not in by_key}
    return by_key


def default_split(root: Path, names: Iterable[str]) -> tuple[dict[str, Split], str]:
    """Split photos without train_list.txt and test_list.txt, and say how.

    By test.txt beside the model, where 3DGS reads it and hierarchical 3DGS writes it; else every 8th, sorted
    by name, is a test photo.
    """
    ordered, unused = sorted(names), ""
    for path in (root / place / TESTS_OF_3DGS for place in ("sparse/0", "sparse", ".")):
        listed = read_list(path) if path.is_file() else []
        by_key = _unique_keys(ordered)
        tests = {by_key[key] for name in listed for key in (name, without_suffix(name)) if key in by_key}
        where = path.relative_to(root)
        if 0 < len(tests) < len(ordered):
            absent = [n for n in listed if not {n, without_suffix(n)} & by_key.keys()]
            lacking = f"; not in the model: {shortlist(absent, 3)}" if absent else ""
            note = f"{where} names {len(tests)} of {len(ordered)} photos: the test photos{lacking}"
            return {n: "test" if n in tests else "train" for n in ordered}, note
        if listed and path.parent != root:
            unused += f"{where} names none or all of the photos and is not used; "
    note = (
        f"{unused}no test set given: every {TEST_EVERY}th is a test photo; distractors in it count as truth"
    )
    return {n: "train" if i % TEST_EVERY else "test" for i, n in enumerate(ordered)}, note


def _split(root: Path, registered: list[str]) -> tuple[dict[str, Split], dict[str, list[str]], str]:
    """Return name -> side of registered photos, by side the names that the model lacks, a warning or ""."""
    paths: dict[Split, Path] = {"train": root / "train_list.txt", "test": root / "test_list.txt"}
    present = [p for p in paths.values() if p.is_file()]
    if not present:
        by_default, note = default_split(root, registered)
        return by_default, {}, note if TESTS_OF_3DGS in note else ""
    if len(present) == 1:
        raise AwError(f"{root} has {present[0].name} but not the other list; write both or neither")
    # Some published scenes list names with their extension, some without.
    by_stem = {without_suffix(n): n for n in registered}
    in_model = set(registered)
    split: dict[str, Split] = {}
    missing: dict[str, list[str]] = {}
    listed = {side: Counter(read_list(path)) for side, path in paths.items()}
    for side, names in listed.items():
        missing[side] = []
        for name in names:
            match = name if name in in_model else by_stem.get(name)
            if match is None:
                missing[side].append(name)
            elif split.setdefault(match, side) != side:
                raise AwError(f"{root}: {name!r} is in train_list.txt and in test_list.txt; keep it in one")
    repeated = shortlist(name for names in listed.values() for name, count in names.items() if count > 1)
    return split, missing, f"the lists name photos twice, which are used once: {repeated}" if repeated else ""


def refuse_same_stems(root: Path, names: Iterable[str]) -> None:
    """Raise AwError where two photos differ in their extension only: their PNGs would be one file."""
    seen: dict[str, str] = {}
    for name in names:
        other = seen.setdefault(without_suffix(name), name)
        if other != name:
            raise AwError(
                f"{root}: photos {other!r} and {name!r} differ in their extension only, so their renders "
                "would be one file; rename one and build the model again"
            )


def _check_reduced(model: ColmapModel, views: Iterable[View], factor: int) -> None:
    """Raise AwError where some photos of images_N are reduced otherwise than most."""
    cameras = {image.image_id: model.cameras[image.camera_id] for image in model.images.values()}
    ratios = {view.image_path: cameras[view.image_id].width / view.camera.width for view in views}
    usual = float(np.median(list(ratios.values()))) if factor > 1 and ratios else 0.0
    if odd := [path for path, ratio in ratios.items() if usual and not 0.8 < ratio / usual < 1.25]:
        raise AwError(
            f"{len(odd)} photos of {odd[0].parent} are reduced otherwise than most, which are {usual:.3g} "
            f"times smaller than their cameras: {shortlist([path.name for path in odd], 3)}; reduce all alike"
        )


def _view(
    root: Path, folder: Path, model: ColmapModel, image: ModelImage, side: Split, mask: Path | None
) -> View:
    path = _image_path(folder, _inside(image.name, root))
    width, height = image_size(path)
    full = model.cameras[image.camera_id]
    fx, fy, cx, cy = full.pinhole()
    if abs(width * full.height / full.width - height) > max(2.0, 0.02 * height):
        raise AwError(
            f"{path} is {width}x{height}, but its camera in the model is {full.width}x{full.height}: another "
            "aspect ratio, so the photo was cropped or turned; use the photos the model was built from"
        )
    camera = Camera(full.width, full.height, fx, fy, cx, cy, image.cam_from_world()).resized(width, height)
    keep = root / "masks" / side / f"{without_suffix(image.name)}.png"
    return View(image.name, path, camera, side, keep if keep.is_file() else mask, image.image_id)


def _mask_warnings(root: Path, scene: Scene, read: SceneInfo | None) -> list[str]:
    folder = root / "masks"
    if not folder.is_dir() or (folder / OWN_MASKS).is_file():
        return []
    if read is not None:  # what it lists was checked when the scene was made
        own = {root / name for name in read["files"]}
        own |= {folder / v.split / f"{without_suffix(v.name)}.png" for v in scene.views}
        strange = shortlist(sorted(p.relative_to(folder).as_posix() for p in mask_files(folder) - own))
        cure = "the mask of a.jpg is train/a.png or test/a.png, by its side"
        return [f"masks that belong to no photo: {strange} ({cure})"] if strange else []
    used = {view.name: view.keep_path for view in scene.train if view.keep_path is not None}
    tests = {view.keep_path for view in scene.test if view.keep_path is not None}
    return check_masks(folder, mask_files(folder), used, tests, [view.name for view in scene.train])


def _image_path(folder: Path, name: str) -> Path:
    # Downsampled copies may have another extension (gsplat writes PNG for JPEG photos).
    candidates = [folder / name, *((folder / name).with_suffix(s) for s in _SUFFIXES)]
    for path in candidates:
        if path.is_file():
            return path
    raise AwError(
        f"{folder} lacks {name}, which the model registers; restore it, or let 'aw import' look for photos "
        "under other names"
    )


def _points(model: ColmapModel, views: tuple[View, ...]) -> SparsePoints:
    """Return the model's points, with tracks in view indices and px of the loaded files."""
    points = model.points
    count = len(points.track_image_ids)
    track_views = np.full(count, -1, dtype=np.int32)
    track_xy = np.zeros((count, 2), dtype=np.float32)
    order = np.argsort(points.track_image_ids, kind="stable")
    ids = points.track_image_ids[order]
    scaled = {v.image_id: (i, v) for i, v in enumerate(views)}
    for image_id, image in model.images.items():
        rows = order[np.searchsorted(ids, image_id) : np.searchsorted(ids, image_id, side="right")]
        if not len(image.xys):
            continue  # the model was stored without 2D points, which its tracks name
        index = points.track_point2d[rows]
        if len(index) and (index.min() < 0 or index.max() >= len(image.xys)):
            raise AwError(
                f"the model's tracks and its image {image.name!r} contradict each other: it is damaged; "
                "build it again"
            )
        scale = np.ones(2)
        if image_id in scaled:
            position, view = scaled[image_id]
            full = model.cameras[image.camera_id]
            scale = np.array([view.camera.width / full.width, view.camera.height / full.height])
            track_views[rows] = position
        track_xy[rows] = image.xys[index] * scale
    return SparsePoints(points.xyz, points.rgb, points.error_px, points.track_offsets, track_views, track_xy)
