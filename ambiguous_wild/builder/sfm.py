"""Structure from motion: the stages features, matches and mapping, each in a child process.

A job for that process is written as JSON, which `sfm_worker` reads.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import shutil
import sqlite3
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal, NotRequired, TypedDict, cast

from ambiguous_wild.builder.fixed_to_camera import FIXED
from ambiguous_wild.builder.known_poses import set_cameras
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import (
    FeatureResult,
    MappingResult,
    MatchResult,
    ScreenedPhoto,
    no_model,
)
from ambiguous_wild.builder.retrieval import PAIRS, RELATIVE_POSES
from ambiguous_wild.builder.settings import BuildSettings, SfmPlan
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.processes import last_lines, python_command
from ambiguous_wild.io.colmap_records import ColmapModel
from ambiguous_wild.io.files import write_json

LOG = "colmap.log"
DATABASE = "database.db"
_POLL_S = 0.25
# Diagonal of a 36 x 24 mm frame: "35 mm equivalent" focal lengths refer to it (CIPA DCG-001).
_DIAGONAL_35MM = math.hypot(36.0, 24.0)


class FeatureJob(TypedDict):
    """Job: extract features."""

    task: Literal["features"]
    database: str
    photos: str  # folder
    names: list[str]
    camera: str
    groups: list[list[str]]  # names that share a camera, where the camera is "per-device" or "per-folder"
    masks: str | None  # folder
    max_features: int
    max_side: int  # px
    sift: str  # of `SfmPlan`
    seed: int
    jobs: int
    parent: NotRequired[int]  # process id, added when the job is written


class MatchJob(TypedDict):
    """Job: match and verify pairs."""

    task: Literal["matches"]
    database: str
    names: list[str]
    test_names: list[str]
    matcher: str  # of `SfmPlan`, as the two below
    ratio: float
    similar: int
    neighbours: int
    only: list[str] | None  # names that look for pairs; None: all
    focals: dict[str, float] | None  # name -> EXIF focal length over the longer side; None: poses are known
    earlier: str | None  # file of the pairs that are matched already
    photos: str | None  # folder; None: what is fixed to the camera stays matched
    seed: int
    jobs: int
    parent: NotRequired[int]


class MappingJob(TypedDict):
    """Job: build models."""

    task: Literal["mapping"]
    database: str
    relative_poses: str  # file that the stage `matches` wrote
    known: str | None  # folder of a model with the exact cameras, numbered as in the database; None: map
    photos: str  # folder
    output: str  # folder
    progress: str  # file that holds the number of registered photos
    mapper: str
    part: int  # component, from 1, the largest
    ba_global_ratio: float  # of `SfmPlan`, as the four below
    ba_global_max_refinements: int
    ba_global_tolerance: float
    ba_local_max_refinements: int
    ba_local_num_images: int
    seed: int
    jobs: int
    parent: NotRequired[int]


class TriangulationJob(TypedDict):
    """Job: triangulate points with known poses."""

    task: Literal["triangulation"]
    database: str
    photos: str  # folder
    model: str  # folder; cameras and poses, numbered as in the database
    output: str  # folder
    seed: int
    parent: NotRequired[int]


class RelativePoseJob(TypedDict):
    """Job: find the relative poses of matched pairs whose cameras are known."""

    task: Literal["relative_poses"]
    database: str
    model: str  # folder; cameras, numbered as in the database
    output: str  # file
    seed: int
    jobs: int
    parent: NotRequired[int]


SfmJob = FeatureJob | MatchJob | MappingJob | TriangulationJob | RelativePoseJob


class SfmCrash(AwError):
    """COLMAP ended without a result; the work folder stays, and the same command continues from it."""


def choose_camera(photos: Sequence[ScreenedPhoto], wanted: str) -> str:
    """Choose which photos share a camera: "single", "per-device", "per-folder" or "per-image".

    "single" where size, camera model and focal length are the same in all photos. Photos of one size and
    folder without EXIF count as frames of one camera: internet photos differ in size. "per-device" where EXIF
    or the folder tells two or more photos of one camera from the others, or one camera was held upright and
    across.
    """
    if wanted != "auto":
        return wanted
    groups = camera_groups(photos, wanted)
    if len(groups) == 1:
        return "single"
    return "per-device" if any(len(group) > 1 for group in groups) else "per-image"


def _device(photo: ScreenedPhoto) -> tuple[Any, ...]:
    exif = photo.exif
    return (*photo.size, photo.camera, exif.get("focal_mm"), exif.get("focal_35mm"))


def _folder(photo: ScreenedPhoto) -> tuple[str, ...]:
    return tuple(p for p in PurePosixPath(photo.source).parent.parts if p != photo.side)


def camera_groups(photos: Sequence[ScreenedPhoto], camera: str = "per-device") -> list[list[int]]:
    """Group the indices of photos that share a camera by EXIF and size; "per-folder": by folder and size.

    Photos without make and focal length share one if all photos of their folder may be of one camera, turned
    or not: EXIF does not tell the cameras of two folders (of a rig, of two videos) apart.
    """
    turned: dict[tuple[str, ...], set[tuple[Any, ...]]] = {}
    for photo in photos:
        device = _device(photo)
        turned.setdefault(_folder(photo), set()).add((*sorted(device[:2]), *device[2:]))
    groups: dict[tuple[Any, ...], list[int]] = {}
    for index, photo in enumerate(photos):
        device, folder = _device(photo), _folder(photo)
        if camera == "per-folder":
            key: tuple[Any, ...] = (device[:2], folder)
        elif photo.camera and ("focal_mm" in photo.exif or "focal_35mm" in photo.exif):
            key = device
        else:
            key = (device, folder) if len(turned[folder]) == 1 else (index,)
        groups.setdefault(key, []).append(index)
    return list(groups.values())


def exif_focal(photo: ScreenedPhoto) -> float | None:
    """Return the focal length over the longer side, from the 35 mm equivalent; None if EXIF has none."""
    focal_mm = photo.exif.get("focal_35mm")
    if not focal_mm:
        return None
    diagonal = math.hypot(*photo.size)
    return focal_mm / _DIAGONAL_35MM * diagonal / max(photo.size)


@dataclass(frozen=True)
class StructureFromMotion:
    """One attempt: each method runs a stage in a child process, in a folder of its own."""

    photos: Sequence[ScreenedPhoto]
    folder: Path  # of the photos' files
    settings: BuildSettings
    plan: SfmPlan
    jobs: int  # threads
    bar: Bar

    def extract_features(self, folder: Path, camera: str, masks: Path | None = None) -> FeatureResult:
        """Write the SIFT features of every photo to `folder/database.db`.

        Args:
            folder: folder of the stage.
            camera: which photos share a camera, see `choose_camera`.
            masks: folder of `<name>.png`, black where no features are wanted; None: there are none.
        """
        database = folder / DATABASE
        self.bar.start("features", len(self.photos))
        grouped = camera_groups(self.photos, camera) if camera in ("per-device", "per-folder") else []
        job: FeatureJob = {
            "task": "features",
            "database": str(database),
            "photos": str(self.folder),
            "names": [photo.name for photo in self.photos],
            "camera": camera,
            "groups": [[self.photos[k].name for k in group] for group in grouped],
            "masks": str(masks) if masks else None,
            "max_features": self.plan.max_features,
            "max_side": self.settings.max_side,
            "sift": self.plan.sift,
            "seed": self.settings.seed,
            "jobs": self.jobs,
        }
        run_job(job, folder, lambda: self.bar.at(_count(database, "keypoints")))
        self.bar.finish()
        with closing(sqlite3.connect(database)) as db:
            rows = db.execute(
                "SELECT images.name, keypoints.rows FROM images LEFT JOIN keypoints USING (image_id)"
            ).fetchall()
        features = {name: int(count or 0) for name, count in rows}
        lost = [photo.source for photo in self.photos if photo.name not in features]
        if lost:
            raise SfmCrash(
                f"COLMAP dropped {len(lost)} photos without a message, the first is {lost[0]} "
                f"(log: {_kept_log(folder)})"
            )
        return {"camera": camera, "features": features}

    def match(
        self,
        folder: Path,
        features: Path,
        earlier: Path | None = None,
        left_out: Sequence[str] | None = None,
        posed: bool = False,
    ) -> MatchResult:
        """Match pairs, and find their relative poses.

        Args:
            folder: gets the database and the list of pairs.
            features: folder of the database with features.
            earlier: folder of an earlier result whose pairs are kept.
            left_out: names of the photos that look for pairs; None: all.
            posed: the poses are known, so pairs are matched only, and what is fixed to the camera stays.
        """
        matcher, photos = self.plan.matcher, self.photos
        database = folder / DATABASE
        shutil.copyfile((earlier or features) / DATABASE, database)
        every = len(photos) * (len(photos) - 1) // 2
        # The number of pairs that retrieval chooses is not known in advance.
        self.bar.start("matching pairs", every if matcher == "exhaustive" else None)
        focals = {photo.name: focal for photo in photos if (focal := exif_focal(photo)) is not None}
        job: MatchJob = {
            "task": "matches",
            "database": str(database),
            "names": [photo.name for photo in photos],
            "test_names": [photo.name for photo in photos if photo.side == "test"],
            "matcher": matcher,
            "ratio": self.plan.ratio,
            "similar": self.plan.similar,
            "neighbours": self.plan.neighbours,
            "only": list(left_out) if left_out is not None else None,
            "focals": None if posed else focals,
            "earlier": str(earlier / PAIRS) if earlier else None,
            "photos": None if posed else str(self.folder),
            "seed": self.settings.seed,
            "jobs": self.jobs,
        }
        run_job(job, folder, lambda: self.bar.at(_count(database, "matches")))
        self.bar.finish()
        listed = folder / PAIRS
        pairs = every if matcher == "exhaustive" else len(listed.read_text(encoding="utf-8").splitlines())
        if posed:
            counts, fixed = dict.fromkeys(("verified", "planar", "connected"), 0), []
        else:
            counts = json.loads((folder / "pairs.json").read_text())
            fixed = json.loads((folder / FIXED).read_text(encoding="utf-8"))
        return cast(MatchResult, {"matcher": matcher, "pairs": pairs, **counts, "fixed": fixed})

    def map(
        self, folder: Path, matches: Path, connected: int, known: ColmapModel | None = None
    ) -> MappingResult:
        """Build the model into `folder/0`; it has none if pairs connect too few photos for the plan.

        Args:
            folder: folder of the stage.
            matches: folder of the stage `matches`.
            connected: photos that verified pairs connect.
            known: exact cameras, which are taken instead of mapping; None: there are none.
        """
        plan, settings = self.plan, self.settings
        if known is None and connected < plan.worth * len(self.photos):
            return {**no_model(), "plan": plan.name}
        progress, database = folder / "progress", folder / DATABASE
        counted = settings.mapper == "incremental"
        self.bar.start("placing photos", len(self.photos) if counted else None)
        shutil.copyfile(matches / DATABASE, database)  # the mapper may write to it
        cameras = None
        if known is not None:
            cameras = folder / "known"
            set_cameras(database, cameras, known, {image.name: image for image in known.images.values()})
        job: MappingJob = {
            "task": "mapping",
            "database": str(database),
            "relative_poses": str(matches / RELATIVE_POSES),
            "known": str(cameras) if cameras else None,
            "photos": str(self.folder),
            "output": str(folder),
            "progress": str(progress),
            "mapper": settings.mapper,
            "part": settings.part,
            "ba_global_ratio": plan.ba_global_ratio,
            "ba_global_max_refinements": plan.ba_global_max_refinements,
            "ba_global_tolerance": plan.ba_global_tolerance,
            "ba_local_max_refinements": plan.ba_local_max_refinements,
            "ba_local_num_images": plan.ba_local_num_images,
            "seed": settings.seed,
            "jobs": self.jobs,
        }
        with ThreadPoolExecutor(1) as ahead:
            # The map is drawn next; these imports take a second, in which this process has nothing to do.
            ahead.map(importlib.import_module, ("networkx", "matplotlib.figure"))
            run_job(job, folder, lambda: self.bar.at(_number(progress)))
        self.bar.finish()
        database.unlink()
        progress.unlink(missing_ok=True)
        if cameras is not None:
            shutil.rmtree(cameras)
        result = json.loads((folder / "mapping.json").read_text(encoding="utf-8"))
        return cast(MappingResult, {**result, "plan": plan.name})


def run_job(job: SfmJob, folder: Path, watch: Callable[[], None]) -> None:
    """Run one task of the worker; `watch` is called while it runs."""
    work = folder / "job.json"
    write_json(work, {**job, "parent": os.getpid()})
    log = folder / LOG
    with open(log, "ab") as sink:
        process = subprocess.Popen(
            python_command("from ambiguous_wild.builder import sfm_worker; sfm_worker.main()", str(work)),
            stdin=subprocess.DEVNULL,
            stdout=sink,
            stderr=sink,
        )
        try:
            while True:
                try:
                    code = process.wait(_POLL_S)
                    break
                except subprocess.TimeoutExpired:
                    watch()
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    work.unlink()
    if code != 0:
        (*_, last) = last_lines(log) or ["its log is empty"]
        raise SfmCrash(
            f"COLMAP ended with code {code} while computing {job['task']}: {last[-200:]} "
            f"(log: {_kept_log(folder)}); run the same command again: it continues before this step"
        )


def _kept_log(folder: Path) -> Path:
    """Copy the log beside the stage's folder, which is removed after an error."""
    return Path(shutil.copyfile(folder / LOG, folder.parent / LOG))


def _count(database: Path, table: str) -> int:
    """Count the rows of a table that another process writes; 0 while it is locked or absent."""
    if not database.is_file():
        return 0
    try:
        with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=0)) as db:
            return int(db.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:
        return 0


def _number(path: Path) -> int:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return 0
