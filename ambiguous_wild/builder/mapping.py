"""Map matched photos with COLMAP, register every photo anew, and merge the components of the pose graph."""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.builder.bundle_adjustment import (
    deterministic_pipeline_options,
    has_parallax,
    plausible_distortion,
)
from ambiguous_wild.builder.component_merging import merge_components
from ambiguous_wild.builder.matched import MatchedPhotos, connected_photos
from ambiguous_wild.builder.records import PURE_ROTATION, ModelSummary, no_model
from ambiguous_wild.builder.registration import MIN_MODEL_PHOTOS, Registration
from ambiguous_wild.builder.retrieval import FEW_PHOTOS, RELATIVE_POSES
from ambiguous_wild.builder.settings import MIN_REGISTERED
from ambiguous_wild.builder.sfm import MappingJob
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.safe_pycolmap import pycolmap

FOCAL_CHANGE = 0.05  # relative change of half of the focal lengths after which pairs are verified again
FOCAL_DOUBT = 0.015  # relative change after which a competing model is built; votes lie on a grid of 2 %


def run_mapping(job: MappingJob) -> None:
    """Register all photos, from COLMAP's models; write `mapping.json`.

    Where COLMAP's incremental mapper leaves photos out, its global mapper is asked too: it needs no pair to
    start from, and registers photos that overlap little. Where photos look outwards, a wrong focal length on
    a bent path explains nearly all matches (yard, seed 2: 4.4 % too long, no photo right). So if the pairs
    voted for another focal length than the mapper found, the mapper runs again with the voted one constant,
    and the model with more observations is kept.
    """
    output, database = Path(job["output"]), Path(job["database"])
    if job["known"] is not None:
        placed = _with_known_cameras(job, database, Path(job["known"]))
        _write(job, output, placed, [placed], len(placed.poses))
        return
    ThreadPoolExecutor(1).submit(importlib.import_module, "networkx")  # while COLMAP maps
    matched = MatchedPhotos.read(database)
    models = _models(job, output, matched)
    if models and not plausible_distortion(models[0]):
        matched.distorted = False
        models = _models(job, output, matched)
    components: list[Registration] = []
    if models:
        change = matched.take_cameras(max(models, key=_size))
        competing = _models(job, output, matched, constant_focal=True) if change > FOCAL_DOUBT else []
        if competing:
            other = MatchedPhotos.read(
                database
            )  # read now, while the database has the focal length of the votes
            other.distorted = matched.distorted
        if change > FOCAL_CHANGE:
            # The poses of pairs were wrong by as much, so verify and map again with the model's focal length.
            matched.write_consistent(database, matched.find_relative_poses(job["jobs"]))
            models = _models(job, output, matched) or models
        else:
            matched.load_relative_poses(Path(job["relative_poses"]))
        components = _register(job, database, matched, models)
        if competing:
            other.load_relative_poses(Path(job["relative_poses"]))
            components = max(
                components, _register(job, database, other, competing), key=lambda p: _explained(p[0])
            )
    chosen = components[job["part"] - 1] if len(components) >= job["part"] else None
    for component in {*components[:1], *([chosen] if chosen else [])}:
        component.mark_provisional()
    reliable = len(components[0].poses.keys() - components[0].provisional) if components else 0
    why = "no pair of photos to start from"
    if chosen is not None and len(chosen.poses) >= MIN_MODEL_PHOTOS and not has_parallax(chosen.model):
        chosen, components, reliable, why = None, [], 0, PURE_ROTATION
    if chosen is None or len(chosen.poses) < MIN_MODEL_PHOTOS:
        left_out = dict.fromkeys(matched.names, why)
        left_out |= _left_out(components[0], components) if components else {}
        names = [_names(component, component.poses) for component in components if component.poses]
        write_json(
            output / "mapping.json",
            {**no_model(), "left_out": left_out, "components": names, "reliable": reliable},
        )
        return
    _write(job, output, chosen, components, reliable)


def _with_known_cameras(job: MappingJob, database: Path, known: Path) -> Registration:
    """Return all photos at their exact poses, with points triangulated from the matches that fit these."""
    matched = MatchedPhotos.read(database)  # with the exact cameras
    matched.find_relative_poses(job["jobs"])
    # Points that only two photos observe are kept, as when mapping: twice the points to begin training with.
    model = triangulate_known(database, known, job["photos"], known, job["seed"], pairs=True)
    placed = Registration(matched, database, model, job["seed"])
    placed.accept_all()
    return placed


def triangulate_known(
    database: Path, known: Path, photos: str, output: Path, seed: int, *, pairs: bool = False
) -> Any:
    """Triangulate points from the inliers of known poses; poses and intrinsics do not change.

    Args:
        database: its verified pairs are replaced.
        known: folder of the model with the cameras, numbered as in the database.
        photos: folder.
        output: folder for COLMAP's files.
        seed: of its random choices.
        pairs: also triangulate points that only two photos observe.

    Returns:
        the model of pycolmap.
    """
    posed = pycolmap.Reconstruction(str(known))
    matched = MatchedPhotos.read(database)
    matched.take_cameras(posed)
    matched.write_verified(database, matched.verified_pairs(matched.poses(posed)))
    options = deterministic_pipeline_options(seed)
    if pairs:
        options.triangulation.ignore_two_view_tracks = False
    return pycolmap.triangulate_points(
        posed, str(database), photos, str(output), options=options, refine_intrinsics=False
    )


def _write(
    job: MappingJob,
    output: Path,
    chosen: Registration,
    components: Sequence[Registration],
    reliable: int,  # photos of the largest component that are not provisional
) -> None:
    """Write the chosen component: its relative poses, its model with colours, and `mapping.json`."""
    chosen.matched.save_relative_poses(output / RELATIVE_POSES)
    model = chosen.model
    model.tear_down()
    model.extract_colors_for_all_images(job["photos"])
    (output / "0").mkdir()
    model.write(str(output / "0"))
    summary: ModelSummary = {
        "images": model.num_reg_images(),
        "points": model.num_points3D(),
        "error_px": round(model.compute_mean_reprojection_error(), 4),
        "track_length": round(model.compute_mean_track_length(), 3),
    }
    name = chosen.matched.names
    write_json(
        output / "mapping.json",
        {
            "model": summary,
            "left_out": dict(sorted(_left_out(chosen, components).items())),
            "partners": {
                name[k]: len(hypothesis.support)
                for k, hypothesis in chosen.accepted.items()
                if k in chosen.poses
            },
            "provisional": _names(chosen, chosen.provisional),
            "hypotheses": {
                name[k]: (-pose[:, :3].T @ pose[:, 3]).tolist()
                for k, pose in chosen.hypotheses.items()
                if k not in chosen.poses and np.isfinite(pose).all()
            },
            "links": [[name[a], name[b], count] for (a, b), count in chosen.links.items()],
            "unregistered_links": [
                [name[a], name[b], len(relative_poses[0].matches)]
                for (a, b), relative_poses in chosen.matched.relative_poses.items()
                if relative_poses and not {a, b} <= chosen.poses.keys()
            ],
            "components": [_names(component, component.poses) for component in components],
            "reliable": reliable,
            "cameras": chosen.cameras(),
        },
    )


def _names(registration: Registration, photos: Collection[int]) -> list[str]:
    return [registration.matched.names[photo] for photo in sorted(photos)]


def _left_out(registration: Registration, components: Sequence[Registration]) -> dict[str, str]:
    """Return the name of each photo that is left out, with the reason."""
    reasons = dict(registration.left_out)
    for number, component in enumerate(components, 1):
        if component is not registration:
            why = f"in part {number}: {len(component.poses)} photos that no photo joins to the others"
            reasons |= dict.fromkeys(component.poses.keys() - registration.poses.keys(), why)
    return {registration.matched.names[photo]: reason for photo, reason in reasons.items()}


def _explained(registration: Registration) -> int:
    """Count the observations of a model; 0 where it lost its photos, because its points are then outdated."""
    enough = len(registration.poses) >= MIN_MODEL_PHOTOS
    return int(registration.model.compute_num_observations()) if enough else 0


def _models(
    job: MappingJob, output: Path, matched: MatchedPhotos, *, constant_focal: bool = False
) -> list[Any]:
    """Return the models of COLMAP's mapper, and of the global one if it leaves photos out; largest first."""
    models: list[Any] = []
    connected = connected_photos(Path(job["database"]))
    enough = connected if len(matched.ids) <= FEW_PHOTOS else MIN_REGISTERED * connected
    for mapper in dict.fromkeys((job["mapper"], "global")):
        run = _map_globally if mapper == "global" else _map_incrementally
        models += sorted(
            run(job, output, matched.distorted and not constant_focal, constant_focal).values(),
            key=_size,
            reverse=True,
        )
        for folder in output.glob("[0-9]*"):
            shutil.rmtree(folder)
        if any(model.num_reg_images() >= enough for model in models):
            break
    # The global mapper may return negative focal lengths.
    models = [m for m in models if all(c.mean_focal_length() > 0 for c in m.cameras.values())]
    return [model for model in models if model.num_reg_images() >= MIN_MODEL_PHOTOS]


def _size(model: Any) -> tuple[int, int]:
    return model.num_reg_images(), model.num_points3D()


def _register(
    job: MappingJob, database: Path, matched: MatchedPhotos, models: Sequence[Any]
) -> list[Registration]:
    """Register photos from the first model, and those it leaves out from the others; merge the components.

    Returns:
        The largest component, then those that no photo joins to it.
    """
    components: list[Registration] = []
    started: set[int] = set()  # photos of components that were registered alone
    for model in models:
        todo = set(range(len(matched.ids))).difference(*(component.poses for component in components))
        if not todo & matched.poses(model).keys():
            continue
        waiting = [Registration(matched.copy(), database, model, job["seed"])]
        while waiting:
            component = waiting.pop()
            component.run()
            components.append(component)
            for poses in component.split_off:
                if poses.keys() <= started:  # it grew into the photos that it was taken out of
                    continue
                started |= poses.keys()
                waiting.append(Registration(matched.copy(), database, component.model, job["seed"]))
                waiting[-1].poses = poses
        if len(components[-1].poses) == len(matched.ids):
            break
    components.sort(key=lambda component: -len(component.poses))
    best, *others = components
    merged = True
    while merged:
        before, cameras = dict(best.poses), best.matched.copy()
        for other in others:
            merge_components(best, other)
        merged = len(best.poses) > len(before)
        if merged:
            best.run()
            merged = len(best.poses) > len(before)
        if len(best.poses) < len(before):  # what was merged did not hold
            best.matched, best.poses, best.merged = cameras, before, []
            best.run()
    kept, registered = [best], set(best.poses)
    for other in others:
        if len(other.poses.keys() - registered) >= MIN_MODEL_PHOTOS:
            kept.append(other)
            registered |= other.poses.keys()
    return kept


def _map_incrementally(
    job: MappingJob, output: Path, distorted: bool, constant_focal: bool
) -> dict[int, Any]:
    options = deterministic_pipeline_options(job["seed"])
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not constant_focal
    options.min_model_size = MIN_MODEL_PHOTOS
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = distorted
    options.ba_global_frames_ratio = options.ba_global_points_ratio = job["ba_global_ratio"]
    options.ba_global_max_refinements = job["ba_global_max_refinements"]
    options.ba_global_function_tolerance = job["ba_global_tolerance"]
    options.ba_local_max_refinements = job["ba_local_max_refinements"]
    options.mapper.ba_local_num_images = job["ba_local_num_images"]
    counter = Path(job["progress"])
    state = {"best": 0, "now": 0}

    def first() -> None:
        state["now"] = 2

    def following() -> None:
        # COLMAP may build several models, each from two photos: the bar shows the largest so far.
        state["now"] += 1
        state["best"] = max(state["best"], state["now"])
        counter.write_text(str(state["best"]))

    return pycolmap.incremental_mapping(
        job["database"],
        job["photos"],
        str(output),
        options=options,
        initial_image_pair_callback=first,
        next_image_callback=following,
    )


def _map_globally(job: MappingJob, output: Path, distorted: bool, constant_focal: bool) -> dict[int, Any]:
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = job["seed"]
    options.mapper.rotation_averaging.random_seed = job["seed"]
    options.mapper.global_positioning.random_seed = job["seed"]
    options.mapper.global_positioning.use_gpu = False
    options.mapper.retriangulation.random_seed = job["seed"]
    adjustment = options.mapper.bundle_adjustment.ceres
    adjustment.use_gpu = False
    options.mapper.bundle_adjustment.refine_extra_params = distorted
    options.mapper.bundle_adjustment.refine_focal_length = not constant_focal
    adjustment.min_num_residuals_for_cpu_multi_threading = 10**9
    options.min_model_size = MIN_MODEL_PHOTOS
    return pycolmap.global_mapping(job["database"], job["photos"], str(output), options=options)
