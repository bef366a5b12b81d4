"""`aw import`: write a scene of a dataset as a scene folder."""

from __future__ import annotations

import dataclasses
import glob
import json
import os
import shutil
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NotRequired, TypedDict, cast

from ambiguous_wild.builder.keep_masks import mask_warnings
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.resample import check_factor
from ambiguous_wild.builder.scene_package import list_files, nerfbaselines_info
from ambiguous_wild.builder.scene_record import point_checks, unfit_warnings
from ambiguous_wild.builder.sfm import SfmCrash
from ambiguous_wild.builder.workspace import content_key, versions
from ambiguous_wild.core.errors import AwError, counted, shortlist
from ambiguous_wild.core.machine import photo_threads
from ambiguous_wild.core.names import check_name
from ambiguous_wild.core.scene import SceneInfo, Split
from ambiguous_wild.datasets.foreign import ForeignScene
from ambiguous_wild.datasets.imported_photos import (
    PhotoPlan,
    PlacedPhoto,
    at_photo_size,
    place_mask,
    place_photo,
    plan_photos,
)
from ambiguous_wild.datasets.points import drop_test_only, find_motion, random_points, triangulate
from ambiguous_wild.datasets.readers import read_foreign, with_masks
from ambiguous_wild.datasets.suites import differences, suite_of
from ambiguous_wild.datasets.unused_files import what_is_left_out
from ambiguous_wild.io.colmap_model import write_model
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera
from ambiguous_wild.io.files import (
    check_output,
    check_replaceable,
    folder_lock,
    replace_folder,
    sweep,
    write_json,
    write_text,
)
from ambiguous_wild.io.images import read_gray
from ambiguous_wild.io.photos import FROM_PROFILE
from ambiguous_wild.io.scene_folder import SCENE_SCHEMA, SIDES, load_scene, read_scene_json, verify_files

HIDDEN = "alpha hides pixels"
LARGER = 1.5  # times; cameras that are this much larger than their photos belong to other files
SMALL_SIDE = 100  # px; training on smaller photos says little about a method


@dataclass(frozen=True)
class ImportSettings:
    """Settings of `import_scene`."""

    kind: str | None = None  # the layout; None = recognised
    factor: int | None = None  # downsampling; None = as in the published tables
    name: str = ""  # of the scene; empty = the output folder's name
    license: str = ""  # of the photos
    dataset: str = ""  # its name in result tables; empty = given by the layout
    drop_test_only_points: bool = False  # points that no training photo sees leak the test photos
    seed: int = 0  # of matching and of random points
    motion: bool = False  # match the photos and keep what moves
    model: str = ""  # name of one of several COLMAP models; empty = the one with most photos
    masks: bool = True  # use keep masks, the photos' alpha among them


class Imported(TypedDict):
    """Layout and folder of the dataset, and notes on reading it."""

    layout: str
    folder: str
    notes: list[str]  # decisions and omissions


class ImportRecord(SceneInfo):
    """scene.json of an imported scene."""

    schema: str
    split: str
    imported: Imported
    counts: dict[str, int]
    photos: dict[str, dict[str, str | list[str]]]  # name -> source, split and notes
    seconds: NotRequired[dict[str, float]]


@dataclass(frozen=True)
class ImportResult:
    """A finished import."""

    scene: Path
    info: ImportRecord
    why: str  # the evidence for the layout
    up_to_date: bool


def import_scene(
    source: Path | str,
    output: Path | str,
    settings: ImportSettings | None = None,
    *,
    overwrite: bool = False,
    jobs: int | None = None,
    progress: bool = False,
) -> ImportResult:
    """Make a scene folder from a scene of a public dataset, in the layout it was published in.

    Photos are linked unless they must be undistorted or reduced; the dataset is not changed. After a kill the
    same call continues with the remaining photos. The output appears complete or not at all.

    Args:
        source: the folder of one scene.
        output: the scene folder.
        settings: see `ImportSettings`.
        overwrite: replace a scene that was imported from other files or with other settings.
        jobs: threads; None: one per core. The result does not depend on it.
        progress: show bars on standard error.

    Raises:
        AwError: an unknown layout, or a dataset whose files contradict each other.
    """
    settings = settings or ImportSettings()
    root, target = Path(source).resolve(), Path(os.path.abspath(output))
    if settings.factor is not None and not 1 <= settings.factor <= 64:
        raise AwError(f"--factor must be between 1 and 64, got {settings.factor}")
    name = check_name("scene name", settings.name or target.name)
    if target.resolve().is_relative_to(root) or root.is_relative_to(target.resolve()):
        raise AwError(
            f"{target} and the dataset {root} lie inside each other; choose a folder outside for -o"
        )
    foreign, why = read_foreign(root, settings.kind, settings.model)
    foreign = with_masks(foreign) if settings.masks else dataclasses.replace(foreign, masks={})
    for side in SIDES:
        if side not in foreign.split.values():
            raise AwError(
                f"{root} has no {side} photo: {counted(len(foreign.split), 'photo')} in the split; add "
                "photos, or write train_list.txt and test_list.txt"
            )
    foreign = _at_photo_size(foreign, settings)
    foreign = dataclasses.replace(foreign, notes=(*foreign.notes, *what_is_left_out(foreign)))
    plans = plan_photos(foreign)
    key = _key(foreign, plans, settings, name)
    target = check_output(target)
    with folder_lock(target, "aw import"):
        existing = _existing(target, key, overwrite)
        if existing is not None:
            return ImportResult(target, existing, why, True)
        work = target.parent / f".{target.name}.import-{key[:16]}"
        bar = Bar(progress)
        largest = max(plan.camera.width * plan.camera.height for plan in plans)
        try:
            _write_scene(work, foreign, plans, settings, name, key, jobs or photo_threads(largest), bar)
        except SfmCrash:  # its log is in the work folder
            raise
        except AwError as error:
            shutil.rmtree(work, ignore_errors=True)
            error.args = (str(error).replace(str(work / "scene"), str(root)),)  # what the user knows
            raise
        finally:
            bar.finish()
        replace_folder(work / "scene", target)
        for left in target.parent.glob(f".{glob.escape(target.name)}.import-*"):
            shutil.rmtree(left, ignore_errors=True)
    info = json.loads((target / "scene.json").read_text(encoding="utf-8"))
    return ImportResult(target, info, why, False)


def _at_photo_size(foreign: ForeignScene, settings: ImportSettings) -> ForeignScene:
    """Return the scene with cameras at the size of its photos, and with the factor that then remains."""
    alone = foreign.only_small
    if alone and settings.factor is not None:
        foreign = dataclasses.replace(foreign, factor=settings.factor)  # chooses which photos are read
    foreign, times = at_photo_size(foreign)
    if times > LARGER and not alone:  # images_N without images/ stays N
        # The published factor refers to the cameras; photos that were reduced before are not reduced again.
        note = f"photos are {times:.3g} times smaller than the model's cameras: intrinsics are scaled to them"
        factor = max(1, round(foreign.factor / times))
        foreign = dataclasses.replace(foreign, factor=factor, notes=(*foreign.notes, note))
    if settings.factor is None or alone:
        return foreign
    cameras, images = foreign.model.cameras, foreign.model.images.values()
    sizes = ((cameras[i.camera_id], i.name) for i in images)
    check_factor(settings.factor, [(min(c.width, c.height), name) for c, name in sizes])
    return dataclasses.replace(foreign, factor=settings.factor)


def _key(foreign: ForeignScene, plans: list[PhotoPlan], settings: ImportSettings, name: str) -> str:
    """Hash what the result depends on; photos by name, size and time, because hashing them takes long."""
    model = foreign.model
    files = [p.source for p in plans] + [p.small for p in plans if p.small] + list(foreign.masks.values())
    states = [[str(f), f.stat().st_size, f.stat().st_mtime_ns] for f in files if f.exists()]
    cameras = [[c.model, c.width, c.height, *c.params, c.shear] for c in model.cameras.values()]
    poses = [[i.name, *i.qvec.tolist(), *i.tvec.tolist()] for i in model.images.values()]
    split = sorted(foreign.split.items())
    kept = dataclasses.asdict(settings) | {"factor": foreign.factor, "name": name, "kind": foreign.kind}
    points = [len(model.points.ids), float(model.points.xyz.sum()), foreign.points]
    # Other layouts imply both.
    stated = [[foreign.evaluation, foreign.dataset]] if foreign.kind == "nerfbaselines" else []
    return content_key(versions(), states, cameras, poses, split, kept, points, *stated)


def _existing(target: Path, key: str, overwrite: bool) -> ImportRecord | None:
    info = read_scene_json(target)
    if info is not None and info.get("build_key") == key:
        try:
            verify_files(target, info, quick=True)
            return cast(ImportRecord, info)  # the key shows that this code wrote it
        except AwError:
            if not overwrite:
                raise
    elif info is not None and not overwrite:
        raise AwError(
            f"{target} exists, from other files or settings; pass --overwrite to replace it, or "
            "choose another -o"
        )
    ours = None if info is None else {"scene.json", *info.get("files", {})}
    check_replaceable(target, "scene of 'aw import'", ours)
    return None


def _write_scene(
    work: Path,
    foreign: ForeignScene,
    plans: list[PhotoPlan],
    settings: ImportSettings,
    name: str,
    key: str,
    jobs: int,
    bar: Bar,
) -> None:
    begun = time.perf_counter()
    folder = work / "scene"
    folder.mkdir(parents=True, exist_ok=True)
    notes = list(foreign.notes)
    model = _with_points(work, foreign, settings, jobs, bar, notes)
    foreign = dataclasses.replace(foreign, model=model)
    if settings.drop_test_only_points:
        model, dropped = drop_test_only(model, foreign.split)
        notes.append(f"{dropped} points that no training photo sees are dropped")
    by_name = {image.name: image for image in model.images.values()}
    plans = [dataclasses.replace(plan, image=by_name[plan.image.name]) for plan in plans]
    bar.start("photos", len(plans))

    def one(plan: PhotoPlan) -> PlacedPhoto:
        placed = place_photo(plan, foreign, folder)
        if settings.masks and place_mask(plan, placed, foreign, folder):
            placed = dataclasses.replace(placed, notes=(*placed.notes, HIDDEN))
        bar.step()
        return placed

    with ThreadPoolExecutor(jobs) as pool:
        placed = list(pool.map(one, plans))
    bar.finish()
    shares = {str(m): float((read_gray(m) > 0).mean()) for m in (folder / "masks").rglob("*.png")}
    hidden = [p.image.name for p in placed if HIDDEN in p.notes]
    notes += mask_warnings({"kept_share": shares, "alpha": hidden})
    if lost := [note for p in placed for note in p.notes if note.startswith("undistorted without")]:
        notes.append(f"{counted(len(lost), 'photo')} {max(lost)}: the lens sees more than a pinhole camera")
    if any(note.startswith("downsampled by") for p in placed for note in p.notes):
        notes.append("photos are reduced in linear light, papers' loaders do it in sRGB: 40 to 44 dB apart")
    if profiles := [note for p in placed for note in p.notes if note.startswith(FROM_PROFILE)]:
        notes.append(f"{counted(len(profiles), 'photo')}: {shortlist(sorted(set(profiles)))}")
    sides = {p.image.name: foreign.split[plan.image.name] for plan, p in zip(plans, placed)}
    scene_model = _write_model(folder, model, placed)
    if settings.motion:
        train = sorted(n for n, s in sides.items() if s == "train")
        images = f"images_{foreign.factor}" if foreign.only_small else "images"
        motion = find_motion(folder, images, work / "motion", train, seed=settings.seed, jobs=jobs, bar=bar)
        notes.append(f"{motion['static']} features of train photos are static, {motion['moving']} move")
        notes += unfit_warnings(motion["unfit"])
    for side in SIDES:
        lines = sorted(n for n, s in sides.items() if s == side)
        write_text(folder / f"{side}_list.txt", "".join(f"{n}\n" for n in lines))
    half = foreign.evaluation.get("protocol") == "half"
    write_json(folder / "nb-info.json", nerfbaselines_info(foreign.factor, name, half=half))
    record = _record(foreign, settings, name, sides, scene_model, placed, notes, key)
    sweep(folder)  # remove temporary files of killed calls
    record["files"] = list_files(folder, jobs)
    record["seconds"] = {"import": round(time.perf_counter() - begun, 3)}
    write_json(folder / "scene.json", record)
    load_scene(folder, verify=False)  # asks what every reader of the scene will ask


def _with_points(
    work: Path, foreign: ForeignScene, settings: ImportSettings, jobs: int, bar: Bar, notes: list[str]
) -> ColmapModel:
    model = foreign.model
    if foreign.points == "triangulate":
        scratch = work / "points"
        shutil.rmtree(scratch, ignore_errors=True)
        model = triangulate(
            scratch, model, foreign.photo_folder, foreign.split, seed=settings.seed, jobs=jobs, bar=bar
        )
        if not len(model.points.ids):
            notes.append("too few points could be triangulated: initial points are random")
    if not len(model.points.ids):
        if foreign.points == "model":
            notes.append("the model has no points: training starts from random ones")
        points = random_points(model, foreign.split, blender=foreign.points == "random", seed=settings.seed)
        model = ColmapModel(model.cameras, model.images, points)
    return model


def _write_model(folder: Path, model: ColmapModel, placed: list[PlacedPhoto]) -> ColmapModel:
    """Write sparse/0 with the placed photos; a camera whose photos share one size keeps its number."""
    cameras: dict[int, ModelCamera] = {}
    images = {}
    taken: dict[tuple[int, int, int, tuple[float, ...]], int] = {}
    for photo in placed:
        camera = photo.camera
        same = (camera.camera_id, camera.width, camera.height, camera.params)
        if same not in taken:
            number = camera.camera_id
            while number in cameras:  # another size of the same camera
                number = max(max(cameras), max(model.cameras)) + 1
            taken[same] = number
            cameras[number] = dataclasses.replace(camera, camera_id=number)
        images[photo.image.image_id] = dataclasses.replace(photo.image, camera_id=taken[same])
    written = ColmapModel(cameras, images, model.points.seen_in(images))
    write_model(folder / "sparse" / "0", written)
    return written


def _record(
    foreign: ForeignScene,
    settings: ImportSettings,
    name: str,
    sides: Mapping[str, Split],
    model: ColmapModel,
    placed: list[PlacedPhoto],
    notes: list[str],
    key: str,
) -> ImportRecord:
    """Assemble scene.json without its files and times."""
    tests = {n for n, s in sides.items() if s == "test"}
    only_test, short = point_checks(model, tests)
    warnings = [
        f"{counted(len(names), f'listed {side} photo')} not in the model: {shortlist(names)}"
        for side, names in foreign.missing.items()
        if names
    ]
    divisor = 1 if foreign.only_small else foreign.factor
    size = min(((p.camera.width // divisor, p.camera.height // divisor) for p in placed), key=min)
    if min(size) < SMALL_SIDE:
        warnings.append(
            f"the scene trains on photos of {size[0]}x{size[1]} px; is factor {foreign.factor} meant?"
        )
    suite = suite_of(settings.dataset, foreign.root)
    if suite is not None:
        full = {(c.width, c.height) for c in foreign.model.cameras.values()}
        warnings += differences(suite, settings.name or foreign.root.name, sorted(full), foreign.factor)
    record: ImportRecord = {
        "schema": "ambiguous_wild.scene",
        "schema_version": SCENE_SCHEMA,
        "name": name,
        "license": settings.license or "not stated",
        "factor": foreign.factor,
        "images": "images" if foreign.factor == 1 else f"images_{foreign.factor}",
        "split": "list",
        "imported": {"layout": foreign.kind, "folder": foreign.root.name, "notes": notes},
        "counts": {
            "photos": len(foreign.split) + sum(len(v) for v in foreign.missing.values()),
            "registered": len(placed),
            "train": len(sides) - len(tests),
            "test": len(tests),
            "cameras": len(model.cameras),
            "points": len(model.points.ids),
            "points_seen_in_test_only": only_test,
            "points_of_track_length_2": short,
        },
        "warnings": warnings,
        "photos": {
            p.image.name: {"source": p.source, "split": sides[p.image.name], "notes": list(p.notes)}
            for p in placed
        },
        "build_key": key,
        "inputs": {"settings": dataclasses.asdict(settings), "versions": versions()},
    }
    if settings.dataset or foreign.dataset:
        record["dataset"] = settings.dataset or foreign.dataset
    if foreign.background is not None:
        record["background"] = list(foreign.background)
    if foreign.evaluation:
        record["evaluation"] = foreign.evaluation
    return record
