"""Content of scene.json, and the lines that 'aw build-scene' prints from it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from ambiguous_wild.builder.fixed_to_camera import area_text
from ambiguous_wild.builder.keep_masks import mask_warnings
from ambiguous_wild.builder.records import (
    BuildInputs,
    BuildRecord,
    CameraFact,
    ExifRecord,
    FeatureResult,
    FixedRecord,
    LostPhoto,
    MappingResult,
    MapResult,
    MaskResult,
    MatchResult,
    MotionResult,
    PhotoSplit,
    ResampleResult,
    SceneCamera,
    ScenePhoto,
    SceneRecord,
    ScreenedPhoto,
    ScreenResult,
)
from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.builder.sfm import exif_focal
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.core.errors import counted, shortlist
from ambiguous_wild.io.colmap_records import ColmapModel, ModelCamera
from ambiguous_wild.io.scene_folder import MAP

FOCAL_DIFFERENCE = 0.1  # relative; EXIF is rounded to millimetres
MUCH_MISSING = 1 / 3  # of the readable photos; then the scene lacks a part of the place
ENOUGH_PHOTOS = 20  # with fewer, most of a place is seen in one or two of them
MIN_PARALLAX_DEG = 1.5  # COLMAP's own limit for a point
NO_TEST_SET = "no test set given"
SFM_STAGES = ("features", "matches", "mapping")


@dataclass(frozen=True)
class BuildResults:
    """Results of the stages that scene.json tells of."""

    photos: Sequence[ScreenedPhoto]
    screened: ScreenResult
    features: FeatureResult
    matches: MatchResult
    mapping: MappingResult
    masks: MaskResult | None
    resampled: ResampleResult
    motion: MotionResult
    map: MapResult


def scene_record(
    settings: BuildSettings, results: BuildResults, model: ColmapModel, split: PhotoSplit
) -> BuildRecord:
    """Assemble scene.json without its files, inputs and timings."""
    photos, features = results.photos, results.features["features"]
    screened, matches, mapping = results.screened, results.matches, results.mapping
    summary, factor = mapping["model"], results.resampled["factor"]
    assert summary is not None  # a build without a model has ended before
    sources = {photo.name: photo.source for photo in photos}
    lenses = {image.name: model.cameras[image.camera_id] for image in model.images.values()}
    cameras = [_camera(camera, lenses[camera["photos"][0]], sources) for camera in mapping["cameras"]]
    only_test, short = point_checks(model, set(split.test))
    return {
        "name": settings.name,
        "license": settings.license or "not stated",
        "factor": factor,
        "images": "images" if factor == 1 else f"images_{factor}",
        "split": split.how,
        "seed": settings.seed,
        "settings": to_plain(settings),
        "chosen": {
            "camera": results.features["camera"],
            "sfm": mapping["plan"],
            "matcher": matches["matcher"],
            "mapper": settings.mapper,
        },
        "counts": {
            "photos": len(photos) + len(screened["skipped"]),
            "readable": len(photos),
            "registered": len(model.images),
            "train": len(split.train),
            "test": len(split.test),
            "cameras": len(model.cameras),
            "points": summary["points"],
            "points_seen_in_test_only": only_test,
            "points_of_track_length_2": short,
            "pairs": matches["pairs"],
            "pairs_verified": matches["verified"],
            "features_that_stay": results.motion["static"],
            "features_that_move": results.motion["moving"],
            "photos_of_sequence": results.motion["sequence"],
        },
        "reprojection_error_px": summary["error_px"],
        "mean_track_length": summary["track_length"],
        "cameras": cameras,
        "lost": _lost_photos(photos, mapping["left_out"], features),
        "skipped": screened["skipped"],
        "warnings": [
            *screened["warnings"],
            *_focal_warnings(cameras, photos),
            *_parallax_warnings(model),
            *part_lines(mapping["components"], sources, settings.part),
            *provisional_warnings([sources[name] for name in mapping["provisional"]]),
            *unfit_warnings([sources[name] for name in results.motion["unfit"]]),
            *mask_warnings(results.masks),
            *split.warnings,
            *map_warnings(results.map),
        ],
        "photos": {photo.name: _photo(photo, split, features, mapping) for photo in photos},
        "masks": results.masks,
        "fixed_to_camera": [
            {
                "photos": [sources[name] for name in area["photos"]],
                "width": area["width"],
                "height": area["height"],
                "share": area["share"],
                "where": area["where"],
            }
            for area in matches["fixed"]
        ],
        "truth": results.resampled["truth"],
    }


def _camera(camera: CameraFact, lens: ModelCamera, sources: Mapping[str, str]) -> SceneCamera:
    return {
        **camera,
        "photos": [sources[name] for name in camera["photos"]],
        "model": lens.model,
        "width": lens.width,
        "height": lens.height,
        "params": [float(value) for value in lens.params],
    }


def point_checks(model: ColmapModel, test: set[str]) -> tuple[int, int]:
    """Count the points that only test photos see (leaked) and those of track length 2 (poorly determined)."""
    points = model.points
    tests = [i.image_id for i in model.images.values() if i.name in test]
    lengths = np.diff(points.track_offsets)
    if not len(lengths):
        return 0, 0
    in_train = ~np.isin(points.track_image_ids, tests)
    trained = np.bincount(points.owners, weights=in_train, minlength=len(lengths))
    return int(((trained == 0) & (lengths > 0)).sum()), int((lengths == 2).sum())


def unfit_warnings(photos: Sequence[str]) -> list[str]:
    """Return a warning on photos whose neighbours' optical flow does not fit their poses."""
    if not photos:
        return []
    return [
        f"optical flow does not fit the poses of {counted(len(photos), 'photo')}: {shortlist(photos, 5)}; "
        "what fills much of them may move with the camera: mask it (--keep-masks), or leave them out"
    ]


def parallax_deg(model: ColmapModel) -> float:
    """Return the median over points of the widest angle between first ray and another; NaN without points."""
    points = model.points
    owner = points.owners
    numbers = sorted(model.images)
    at = {number: k for k, number in enumerate(numbers)}
    poses = np.array([model.images[n].cam_from_world() for n in numbers]).reshape(-1, 4, 4)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    rows = np.array([at[int(i)] for i in points.track_image_ids], dtype=np.intp)
    rays = centres[rows] - points.xyz[owner]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    # The widest angle between any two rays is at most twice this one, but costs quadratic time.
    first = rays[points.track_offsets[owner]]
    angles = np.zeros(len(points.xyz))
    np.maximum.at(angles, owner, np.arccos(np.clip((rays * first).sum(axis=1), -1.0, 1.0)))
    return math.degrees(float(np.median(angles))) if len(angles) else math.nan


def verdict(info: SceneRecord, size: tuple[int, int], scene: Path | None) -> str:
    """Return one line with the counts and, if `scene` is given, the command that trains on it."""
    counts = info["counts"]
    points = f"{counts['points']:,}".replace(",", " ")
    named = f", {len(info['lost'])} left out" if info["lost"] else ""
    few = counts["registered"] < ENOUGH_PHOTOS
    ready = f"few photos, about {ENOUGH_PHOTOS} are needed for a good model" if few else "ready"
    out = counts["readable"] - counts["registered"]
    if out >= MUCH_MISSING * counts["readable"]:
        ready = (
            f"not whole: what the {out} photos left out show is missing ('aw screen' says where to take more)"
        )
    after = ""
    if scene is not None:
        after = f"; next: aw bench --method refinesplat --scene {shlex.quote(str(scene))} -o runs"
    return (
        f"registered {counts['registered']} of {counts['photos']}{named}, {points} points, "
        f"{info['reprojection_error_px']:.2f} px, {size[0]}x{size[1]} at factor {info['factor']}: "
        f"{ready}{after}"
    )


def summary_lines(info: SceneRecord, *, test_advice: bool = True) -> list[str]:
    """Return the lines about the split, the lost photos and every warning.

    Without `test_advice` that of `NO_TEST_SET` is left out: for commands that take no test photos.
    """
    counts = info["counts"]
    lines = [f"{counts['train']} training and {counts['test']} test photos (split: {info['split']})"]
    if info["lost"]:
        reasons = shortlist([f"{p['source']} ({p['reason']})" for p in info["lost"]], 4)
        lines.append(f"{len(info['lost'])} not registered: {reasons}")
    lines += fixed_lines(info["fixed_to_camera"])
    return lines + [f"warning: {w}" for w in info["warnings"] if test_advice or not w.startswith(NO_TEST_SET)]


def fixed_lines(fixed: Sequence[FixedRecord]) -> list[str]:
    """Return a line for each mask of something that is fixed to the camera."""
    lines = []
    for area in fixed:
        what = area_text(area["share"], area["where"])
        what += f" of {area['width']}x{area['height']}" if len(fixed) > 1 else ""
        masked = counted(len(area["photos"]), "photo")
        lines.append(
            f"{what} stands still while the rest moves (bonnet, rig or watermark?): masked in {masked}"
        )
    return lines


def sfm_time_share(info: SceneRecord) -> float:
    """Return the share of the build's time that COLMAP took, 0 to 1."""
    seconds = info["seconds"]
    return sum(seconds.get(s, 0.0) for s in SFM_STAGES) / max(sum(seconds.values()), 1e-9)


def changed_inputs(
    old: Mapping[str, object],  # `BuildInputs`, perhaps of another version
    new: BuildInputs,
) -> str:
    """Name the inputs that differ, for the message that refuses to overwrite."""
    pairs = {k: v for k, v in new.items() if k not in ("settings", "versions")}
    parts = [k.replace("_", " ") for k, v in pairs.items() if old.get(k) != v]
    groups: dict[str, Mapping[str, object]] = {"settings": new["settings"], "versions": new["versions"]}
    for group, values in groups.items():
        earlier = old.get(group)
        before = earlier if isinstance(earlier, dict) else {}
        changed = [f"{k} {before.get(k)} -> {v}" for k, v in values.items() if before.get(k) != v]
        parts += [f"{group} ({shortlist(changed)})"] if changed else []
    return ", ".join(parts) or "inputs"


def _lost_photos(
    photos: Sequence[ScreenedPhoto], left_out: Mapping[str, str], features: Mapping[str, int]
) -> list[LostPhoto]:
    """List the readable photos that are not in the scene, each with the reason."""
    lost: list[LostPhoto] = []
    for photo in photos:
        count = features.get(photo.name, 0)
        if photo.name in left_out:
            reason = left_out[photo.name] if count >= 50 else f"only {count} features"
            lost.append({"source": photo.source, "reason": reason})
    return lost


def _photo(
    photo: ScreenedPhoto, split: PhotoSplit, features: Mapping[str, int], mapping: MappingResult
) -> ScenePhoto:
    # Scenes are published: GPS positions stay out of them.
    exif = {k: v for k, v in photo.exif.items() if k not in ("latitude_deg", "longitude_deg", "altitude_m")}
    return {
        "source": photo.source,
        "sha256": photo.sha256,
        "split": "train" if photo.name in split.train else "test" if photo.name in split.test else None,
        "width": photo.width,
        "height": photo.height,
        "sharpness": photo.sharpness,
        "mean_luma": photo.mean_luma,
        "features": features.get(photo.name, 0),
        "partners": mapping["partners"].get(photo.name, 0),
        "provisional": photo.name in mapping["provisional"],
        "notes": list(photo.notes),
        "exif": cast(ExifRecord, exif),
    }


def _focal_warnings(cameras: Sequence[SceneCamera], photos: Sequence[ScreenedPhoto]) -> list[str]:
    """Warn of cameras whose focal length contradicts their photos' EXIF."""
    stated = {photo.source: (exif_focal(photo), max(photo.size)) for photo in photos}
    odd = []
    for camera in cameras:
        share, side = stated[camera["photos"][0]]
        if share is not None and abs(camera["focal_px"] / (share * side) - 1) > FOCAL_DIFFERENCE:
            odd.append(f"{camera['photos'][0]}: {camera['focal_px']:.0f} px, by EXIF {share * side:.0f}")
    if not odd:
        return []
    return [f"focal length of {len(odd)} of {len(cameras)} cameras contradicts EXIF: {shortlist(odd, 2)}"]


def part_lines(components: Sequence[Sequence[str]], sources: Mapping[str, str], built: int) -> list[str]:
    """Return one line if the pose graph has several components, the user's parts, else none.

    Args:
        components: names of each, the largest first.
        sources: name -> path in the capture.
        built: number of the part that is built, from 1.
    """
    if len(components) < 2:
        return []
    named = [
        f"part {number} of {len(photos)} ({shortlist([sources[name] for name in photos], 2)})"
        for number, photos in enumerate(components, 1)
    ]
    other = 1 if built > 1 else 2
    return [
        f"the photos fall into {len(components)} parts that no photo joins: {', '.join(named)}; take photos "
        f"that show two of them at once; --part {other} builds part {other}"
    ]


def provisional_warnings(photos: Sequence[str]) -> list[str]:
    """Return one warning that names the provisional photos of a capture, if there are any."""
    if not photos:
        return []
    return [
        f"{counted(len(photos), 'photo')} registered with little evidence, perhaps imprecisely or wrongly "
        f"('provisional' in scene.json): {shortlist(photos)}; take more photos beside these, or leave them "
        "out if they blur the model"
    ]


def map_warnings(result: MapResult) -> list[str]:
    """Return one warning with the advice of the map, if there is any."""
    advice = result["advice"]
    return [f"the capture has weak places, see {MAP}: {shortlist(advice, 2)}"] if advice else []


def _parallax_warnings(model: ColmapModel) -> list[str]:
    angle = parallax_deg(model)
    if not angle < MIN_PARALLAX_DEG:
        return []
    return [
        f"the camera hardly moved: half of the points have less than {angle:.2f} deg of parallax, so their "
        "depth is unreliable and renders from the side will be wrong; walk between photos"
    ]
