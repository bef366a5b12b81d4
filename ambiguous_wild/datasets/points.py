"""Initial points of imported scenes: random or triangulated points, and points of test photos dropped."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ambiguous_wild.builder.known_poses import set_cameras
from ambiguous_wild.builder.moving_features import write_motion
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import MotionResult, ScreenedPhoto
from ambiguous_wild.builder.retrieval import RELATIVE_POSES
from ambiguous_wild.builder.settings import BuildSettings, Effort, plans
from ambiguous_wild.builder.sfm import (
    DATABASE,
    RelativePoseJob,
    StructureFromMotion,
    TriangulationJob,
    run_job,
)
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.scene import Split, inlier_centers
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.colmap_records import (
    ColmapModel,
    ModelImage,
    ModelPoints,
    points_without_tracks,
)

RANDOM_POINTS = 100_000  # as in 3DGS for Blender scenes and in gsplat's random start
BLENDER_SIDE = 1.3  # half the side of 3DGS's cube for Blender scenes
CAMERA_SIDE = 3.0  # half the side of gsplat's cube over the largest distance of a camera from their mean
MIN_POINTS = 100  # smallest number of triangulated points to start from


def drop_test_only(model: ColmapModel, split: Mapping[str, Split]) -> tuple[ColmapModel, int]:
    """Return the model without points that no training photo sees, and the number of dropped points.

    Points without a track are kept, because the photos that see them are not known.
    """
    points = model.points
    train = [i.image_id for i in model.images.values() if split.get(i.name) == "train"]
    lengths, in_train = np.diff(points.track_offsets), np.isin(points.track_image_ids, train)
    keep = (np.bincount(points.owners, weights=in_train, minlength=len(lengths)) > 0) | (lengths == 0)
    kept = points.subset(keep, np.ones(len(in_train), bool))
    images = {
        number: dataclasses.replace(
            image, point_ids=np.where(np.isin(image.point_ids, kept.ids), image.point_ids, -1)
        )
        for number, image in model.images.items()
    }
    return ColmapModel(model.cameras, images, kept), int((~keep).sum())


def random_points(
    model: ColmapModel, split: Mapping[str, Split], *, blender: bool, seed: int = 0
) -> ModelPoints:
    """Return points of random position and colour, as the reference trainers use without a model.

    Args:
        model: its training cameras set the cube of points, unless `blender`.
        split: sides by name.
        blender: use 3DGS's cube of side 2.6 about the origin.
        seed: seed of the generator.
    """
    generator = np.random.default_rng(seed)
    centre, half = np.zeros(3), BLENDER_SIDE
    if not blender:
        poses = [i.cam_from_world() for i in model.images.values() if split.get(i.name) == "train"]
        centres = np.array([-p[:3, :3].T @ p[:3, 3] for p in poses])
        centres = centres[inlier_centers(centres)]
        centre = centres.mean(axis=0)
        half = CAMERA_SIDE * float(np.linalg.norm(centres - centre, axis=1).max())
    xyz = centre + (half or 1.0) * generator.uniform(-1, 1, (RANDOM_POINTS, 3))
    return points_without_tracks(xyz, generator.integers(0, 256, (RANDOM_POINTS, 3), dtype=np.uint8))


def triangulate(
    folder: Path,
    model: ColmapModel,
    photos: Path,
    split: Mapping[str, Split],
    *,
    seed: int,
    jobs: int,
    bar: Bar,
) -> ColmapModel:
    """Match the photos and triangulate points with the known poses, which do not change.

    Args:
        folder: empty folder for COLMAP's files.
        model: cameras and poses.
        photos: folder that the model's names refer to.
        split: photos of neither side are not used.
        seed: seed of matching.
        jobs: threads of features and matching.
        bar: progress.

    Returns:
        The same cameras and poses, with points; without any if fewer than `MIN_POINTS` were found.
    """
    used = {i.name: i for i in model.images.values() if i.name in split}
    database = _match_posed(folder, model, photos, split, "thorough", seed, jobs, bar)
    (folder / "points").mkdir()
    job: TriangulationJob = {
        "task": "triangulation",
        "database": str(database),
        "photos": str(photos),
        "model": str(folder / "known"),
        "output": str(folder / "points"),
        "seed": seed,
    }
    bar.start("triangulating", None)
    run_job(job, folder, lambda: None)
    bar.finish()
    triangulated = read_model(folder / "points")
    if len(triangulated.points.ids) < MIN_POINTS:
        return model
    # The given poses are kept, not the rounded ones of COLMAP's files.
    by_name: dict[str, ModelImage] = {i.name: i for i in triangulated.images.values()}
    images = {
        by_name[name].image_id: dataclasses.replace(
            by_name[name], qvec=i.qvec, tvec=i.tvec, camera_id=i.camera_id
        )
        for name, i in used.items()
        if name in by_name
    }
    return ColmapModel(model.cameras, images, triangulated.points)


def find_motion(
    scene: Path, images: str, scratch: Path, train: Sequence[str], *, seed: int, jobs: int, bar: Bar
) -> MotionResult:
    """Match the train photos of a scene folder and write their motion points (motion.npz) into it.

    Args:
        scene: folder with the photos and sparse/0, undistorted.
        images: its folder of the photos at the size of the cameras.
        scratch: folder for COLMAP's files; emptied first.
        train: names of the photos.
        seed: seed of matching.
        jobs: threads.
        bar: progress.

    Returns:
        Numbers of static and moving features, and photos whose poses optical flow does not fit.

    Raises:
        AwError: the poses do not fit the photos' own matches.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    model = read_model(scene / "sparse" / "0")
    split: dict[str, Split] = dict.fromkeys(train, "train")
    database = _match_posed(scratch, model, scene / images, split, "auto", seed, jobs, bar)
    job: RelativePoseJob = {
        "task": "relative_poses",
        "database": str(database),
        "model": str(scratch / "known"),
        "output": str(scratch / RELATIVE_POSES),
        "seed": seed,
        "jobs": jobs,
    }
    bar.start("motions", None)
    run_job(job, scratch, lambda: None)
    bar.finish()
    known = scratch / "known"
    stats = write_motion(
        scene,
        database,
        scratch / RELATIVE_POSES,
        known,
        scene / "sparse" / "0",
        scene / images,
        train,
        jobs,
    )
    if 2 * stats["silent"] > len(train):
        raise AwError(
            f"in {stats['silent']} of {len(train)} train photos no matches fit the given poses, so it is "
            "unknown what moves; import without --motion, or place the photos anew with 'aw build-scene'"
        )
    return stats


def _match_posed(
    folder: Path,
    model: ColmapModel,
    photos: Path,
    split: Mapping[str, Split],
    sfm: Effort,
    seed: int,
    jobs: int,
    bar: Bar,
) -> Path:
    """Make COLMAP's database of the matched photos in `split` with known cameras; write poses to known/."""
    used = {i.name: i for i in model.images.values() if i.name in split}
    used_photos = [ScreenedPhoto(source=name, name=name, side=split[name]) for name in sorted(used)]
    settings = BuildSettings(seed=seed, sfm=sfm)
    camera = "single" if len(model.cameras) == 1 else "per-image"
    for part in ("features", "matches", "known"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    plan = replace(plans(used_photos, settings)[0], max_features=settings.max_features)
    attempt = StructureFromMotion(used_photos, photos, settings, plan, jobs, bar)
    attempt.extract_features(folder / "features", camera)
    set_cameras(folder / "features" / DATABASE, folder / "known", model, used)
    attempt.match(folder / "matches", folder / "features", posed=True)
    return folder / "matches" / DATABASE
