"""COLMAP in a child process, which `sfm.run_job` starts with the path of a job as its argument.

COLMAP writes to the terminal, ignores Ctrl-C and may crash; in a child process none of that reaches the
command. Every seed is fixed, so features and matches are the same for any number of threads. Bundle
adjustment sums in the order of its threads, so mapping uses one (40 photos: 11.5 s on one thread,
12.0-14.4 s on two; equal bits on one thread only).

SIFT is computed by OpenCV, as precisely as by COLMAP and in a third to a fifth of the time, unless the plan
asks for COLMAP's. Both double each photo first. The options are COLMAP's defaults where OpenCV has them: peak
threshold 0.02 over three levels, edge threshold 10, descriptors as square roots of their L1 norm (RootSIFT:
Arandjelovic and Zisserman, CVPR 2012).
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import sqlite3
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.builder.fixed_to_camera import FIXED, FixedArea, find_fixed, moving_matches
from ambiguous_wild.builder.mapping import run_mapping, triangulate_known
from ambiguous_wild.builder.matched import MatchedPhotos, largest_component
from ambiguous_wild.builder.records import FixedMask
from ambiguous_wild.builder.retrieval import (
    PAIRS,
    RELATIVE_POSES,
    pairs_of_test_set,
    retrieval_pairs,
    sequential_pairs,
    vlad_vectors,
)
from ambiguous_wild.builder.sfm import (
    FeatureJob,
    MatchJob,
    RelativePoseJob,
    SfmJob,
    TriangulationJob,
)
from ambiguous_wild.core.machine import in_order
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.images import read_gray, read_png_rgb, write_png
from ambiguous_wild.io.safe_pycolmap import pycolmap

PEAK, EDGE, LEVELS, BLUR = 0.02, 10.0, 3, 1.6
SCALE = 512.0  # descriptors are stored as bytes; of a unit vector few elements exceed a half
OCTAVES = 4  # octaves used, from the doubled photo on; features of coarser ones are badly localised
GRAY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # as COLMAP reads
# Positions per requested feature: COLMAP finishes the octave that exceeds its limit, so it returns more.
POSITIONS_A_FEATURE = 1.4
# For characters of names in a list of pairs: COLMAP splits its lines at blanks, and # begins a comment. None
# of these ends a line for `splitlines`, as "\x1e" does.
_ESCAPED = {" ": "\x1f", "#": "\x10"}


def sift(gray: np.ndarray, most: int, mask: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Compute keypoints and descriptors of one photo, the largest first.

    Args:
        gray: [H, W] uint8.
        most: largest number of positions; one with several orientations gives several features.
        mask: [H, W], zero where nothing is wanted.

    Returns:
        [N, 4] float32 x, y (in COLMAP's pixels: the corner of the photo is 0, 0), scale in px, angle in
        radians; [N, 128] uint8. The same for any number of threads.
    """
    finder = cv2.SIFT.create(0, LEVELS, PEAK, EDGE, BLUR, enable_precise_upscale=True)
    # OpenCV packs the octave into the lowest byte; the doubled photo's, -1, is 255.
    keypoints = [k for k in finder.detect(gray, mask) if (k.octave + 1 & 255) < OCTAVES]
    if not keypoints:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    positions = np.array([(k.size, *k.pt) for k in keypoints], np.float32)
    order = np.lexsort((positions[:, 1], positions[:, 2], -positions[:, 0]))  # by size, then position
    next_position = np.any(np.diff(positions[order], axis=0) != 0.0, axis=1)
    kept = order[np.concatenate([[0], np.cumsum(next_position)]) < most]
    described, words = finder.compute(gray, [keypoints[i] for i in kept])
    points = np.array([(*k.pt, k.size / 2, np.radians(k.angle)) for k in described], np.float32)
    points[:, :2] += 0.5  # OpenCV counts from the centre of the first pixel
    roots = np.sqrt(words / np.maximum(words.sum(1, keepdims=True), 1e-12))
    return points, np.clip(np.rint(SCALE * roots), 0, 255).astype(np.uint8)


def features_of(
    photos: Path, masks: Path | None, names: Sequence[str], most: int, side: int, jobs: int
) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield name, keypoints in px of the full-size photo, and descriptors, in the order of the names.

    Args:
        photos: folder.
        masks: folder of NAME.png, black where nothing is wanted; a photo without one is used whole.
        names: files in `photos`.
        most: largest number of positions a photo.
        side: px; larger photos are reduced to this longer side first.
        jobs: threads, one photo each.

    Raises:
        OSError: a photo that cannot be read.
    """

    def one(name: str) -> tuple[str, np.ndarray, np.ndarray]:
        gray = cv2.imread(str(photos / name), GRAY)
        if gray is None:
            raise OSError(f"{photos / name} cannot be read")
        mask = cv2.imread(str(masks / f"{name}.png"), GRAY) if masks else None
        height, width = gray.shape
        share = side / max(height, width)
        if share < 1.0:
            size = (max(round(width * share), 1), max(round(height * share), 1))
            gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        if mask is not None and mask.shape != gray.shape:
            mask = cv2.resize(mask, gray.shape[::-1], interpolation=cv2.INTER_NEAREST)
        points, words = sift(gray, most, mask)
        points[:, 0] *= width / gray.shape[1]
        points[:, 1] *= height / gray.shape[0]
        points[:, 2] *= width / gray.shape[1]
        return name, points, words

    cv2.setNumThreads(1)  # a photo a thread: nothing is left to share inside one
    yield from in_order(one, names, jobs)


_PR_SET_PDEATHSIG = 1


def run_features(job: FeatureJob) -> None:
    """Create the database with cameras and images, and write SIFT features computed on the CPU."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "SIMPLE_RADIAL"
    if job["masks"]:
        reader.mask_path = job["masks"]
    mode = pycolmap.CameraMode.PER_IMAGE if job["camera"] == "per-image" else pycolmap.CameraMode.SINGLE
    # Photos are imported first, ordered by name: extraction numbers them in the order its threads finish,
    # and later random choices depend on these numbers.
    pycolmap.Database.open(job["database"]).close()
    for names in job["groups"] or [job["names"]]:
        pycolmap.import_images(
            job["database"], job["photos"], camera_mode=mode, image_names=names, options=reader
        )
    if job["sift"] == "opencv":
        _extract_with_opencv(job)
        return
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    options.num_threads = job["jobs"]
    options.max_image_size = job["max_side"]
    options.sift.max_num_features = job["max_features"]
    options.sift.estimate_affine_shape = options.sift.domain_size_pooling = job["sift"] == "covariant"
    pycolmap.extract_features(
        job["database"],
        job["photos"],
        image_names=job["names"],
        camera_mode=pycolmap.CameraMode.PER_IMAGE if job["groups"] else mode,
        reader_options=reader,
        extraction_options=options,
    )


def _extract_with_opencv(job: FeatureJob) -> None:
    database = pycolmap.Database.open(job["database"])
    try:
        numbers = {image.name: image.image_id for image in database.read_all_images()}
        masks = Path(job["masks"]) if job["masks"] else None
        for name, points, words in features_of(
            Path(job["photos"]),
            masks,
            job["names"],
            round(POSITIONS_A_FEATURE * job["max_features"]),
            job["max_side"],
            job["jobs"],
        ):
            database.write_keypoints(numbers[name], points)
            kind = pycolmap.FeatureExtractorType.SIFT
            database.write_descriptors(numbers[name], pycolmap.FeatureDescriptors(kind, words))
    finally:
        database.close()


def run_matches(job: MatchJob) -> None:
    """Match all pairs or those that are likely to overlap, then find the relative poses of each pair."""
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu = False
    options.num_threads = job["jobs"]
    options.skip_geometric_verification = True
    options.sift.max_ratio = job["ratio"]
    database = Path(job["database"])
    if job["matcher"] == "exhaustive":
        pycolmap.match_exhaustive(job["database"], matching_options=options)
    else:
        path = database.with_name(PAIRS)
        earlier = Path(job["earlier"]).read_text(encoding="utf-8").splitlines() if job["earlier"] else []
        escapes = str.maketrans(_ESCAPED)
        likely = [" ".join(name.translate(escapes) for name in pair) for pair in _likely_pairs(job)]
        # COLMAP skips pairs that are matched already.
        path.write_text("".join(f"{line}\n" for line in dict.fromkeys(earlier + likely)), encoding="utf-8")
        pairing = pycolmap.ImportedPairingOptions()
        pairing.match_list_path = str(path)
        _replace_in_names(database, _ESCAPED)
        pycolmap.match_image_pairs(job["database"], matching_options=options, pairing_options=pairing)
        _replace_in_names(database, {escaped: plain for plain, escaped in _ESCAPED.items()})
    if job["focals"] is None:  # poses are known: triangulation takes the matches that fit them
        return
    matched = MatchedPhotos.read(database)
    if job["photos"] and _take_out_fixed(job, matched):
        matched = MatchedPhotos.read(database)
    matched.find_focals(job["focals"], job["jobs"])
    consistent = matched.find_relative_poses(job["jobs"])
    matched.write_consistent(database, consistent)
    matched.save_relative_poses(database.with_name(RELATIVE_POSES))
    planar = [
        len(matched.relative_poses[pair][number].rotations) > 1 for pair, (number, _) in consistent.items()
    ]
    counts = {"verified": len(consistent), "planar": sum(planar), "connected": largest_component(consistent)}
    write_json(database.with_name("pairs.json"), counts)


def _replace_in_names(database: Path, new_of: Mapping[str, str]) -> None:
    with closing(sqlite3.connect(database)) as db, db:
        for pair in new_of.items():
            db.execute("UPDATE images SET name = replace(name, ?1, ?2) WHERE instr(name, ?1)", pair)


def _take_out_fixed(job: MatchJob, matched: MatchedPhotos) -> bool:
    """Remove the matches of what is fixed to the camera from the database; tell whether there was any.

    Writes `FIXED` and the keep masks beside the database. What an earlier attempt found stays.
    """
    database, photos = Path(job["database"]), Path(str(job["photos"]))
    earlier = Path(job["earlier"]).parent if job["earlier"] else None
    numbers = {name: k for k, name in enumerate(matched.names)}
    records: list[FixedMask] = []
    if earlier is not None:
        records = json.loads((earlier / FIXED).read_text(encoding="utf-8"))
    if earlier is not None and records:
        areas = []
        for record in records:
            shutil.copyfile(earlier / record["mask"], database.with_name(record["mask"]))
            covered = read_gray(earlier / record["mask"]) == 0
            size = (record["width"], record["height"])
            areas.append(FixedArea(size, [numbers[name] for name in record["photos"]], covered))
    else:

        def read(photo: int) -> np.ndarray:
            return cv2.cvtColor(read_png_rgb(photos / matched.names[photo]), cv2.COLOR_RGB2GRAY)

        sizes = [(camera.width, camera.height) for camera in matched.cameras]
        cameras = [camera.camera_id for camera in matched.cameras]
        areas = find_fixed(matched.features, sizes, cameras, matched.matches, read)
        tests = {numbers[name] for name in job["test_names"]}
        areas = [
            area.without(k for k in area.photos if k in tests and not area.shown_by(read(k)))
            for area in areas
        ]
        for number, area in enumerate(areas):
            records.append(area.record(matched.names, f"fixed-{number}.png"))
            write_png(database.with_name(records[-1]["mask"]), area.keep_mask())
    write_json(database.with_name(FIXED), records)
    if areas:
        matched.replace_matches(database, moving_matches(matched.features, matched.matches, areas))
    return bool(areas)


def _likely_pairs(job: MatchJob) -> list[tuple[str, str]]:
    """Choose pairs by the order of capture, by similar features, or by both."""
    tests = set(job["test_names"])
    sequential = job["matcher"] == "sequential"
    if sequential and not tests:
        return sequential_pairs(job["names"], tests)
    database = pycolmap.Database.open(job["database"])
    try:
        numbers = {image.name: image.image_id for image in database.read_all_images()}

        def read(name: str) -> np.ndarray:
            return np.asarray(database.read_descriptors(numbers[name]).data)

        if sequential:
            vectors = vlad_vectors(read, job["names"], job["seed"])
            pairs = {*sequential_pairs(job["names"], tests), *pairs_of_test_set(vectors, job["names"], tests)}
            return sorted(pairs)
        return retrieval_pairs(
            read,
            job["names"],
            tests,
            job["similar"],
            job["neighbours"],
            job["only"],
            job["seed"],
            job["jobs"],
        )
    finally:
        database.close()


def run_triangulation(job: TriangulationJob) -> None:
    """Triangulate points from the inliers of the poses; poses and intrinsics do not change."""
    triangulated = triangulate_known(
        Path(job["database"]), Path(job["model"]), job["photos"], Path(job["output"]), job["seed"]
    )
    triangulated.write_binary(job["output"])


def run_relative_poses(job: RelativePoseJob) -> None:
    """Find the relative poses of every matched pair, with known cameras."""
    matched = MatchedPhotos.read(Path(job["database"]))
    matched.take_cameras(pycolmap.Reconstruction(job["model"]))
    matched.find_relative_poses(job["jobs"])
    matched.save_relative_poses(Path(job["output"]))


def main() -> None:
    """Read the job file and run its task."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides, and ends this process
    if sys.platform == "linux":  # end when the parent ends, even if the parent is killed
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    job: SfmJob = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    if os.getppid() != job["parent"]:  # the parent ended before the line above
        sys.exit(1)
    pycolmap.set_random_seed(job["seed"])
    if job["task"] == "features":
        run_features(job)
    elif job["task"] == "matches":
        run_matches(job)
    elif job["task"] == "mapping":
        run_mapping(job)
    elif job["task"] == "relative_poses":
        run_relative_poses(job)
    else:
        run_triangulation(job)
