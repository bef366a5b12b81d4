"""Initial points of imported scenes: from PLY files, random, triangulated; those of test photos dropped."""

from __future__ import annotations

import dataclasses
import shutil
import sqlite3
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import cast

import numpy as np

from ambiguous_wild.builder.moving import write_motion
from ambiguous_wild.builder.progress import Bar
from ambiguous_wild.builder.records import MotionResult, ScreenedPhoto
from ambiguous_wild.builder.retrieval import MOTIONS
from ambiguous_wild.builder.settings import BuildSettings, Effort, plans
from ambiguous_wild.builder.sfm import DATABASE, MotionJob, TriangulationJob, extract_features, match, run_job
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.core.scene import Split
from ambiguous_wild.datasets.foreign import no_points, points_without_tracks
from ambiguous_wild.io import colmap_binary
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.colmap_records import MODELS, Model, ModelImage, ModelPoints

RANDOM_POINTS = 100_000  # as 3DGS has for Blender scenes, and gsplat for its random start
BLENDER_SIDE = 1.3  # half the side of 3DGS's cube for Blender scenes
CAMERA_SIDE = 3.0  # half the side of gsplat's cube, over the largest distance of a camera from their mean
LEAST_POINTS = 100  # fewer triangulated points are no start
_LARGEST_PLY = 2_000_000_000  # bytes
_PLY_TYPES = {
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1",
    "char": "i1", "int8": "i1", "short": "<i2", "int16": "<i2", "ushort": "<u2", "uint16": "<u2",
    "int": "<i4", "int32": "<i4", "uint": "<u4", "uint32": "<u4",
}  # fmt: skip


def drop_test_only(model: Model, split: Mapping[str, Split]) -> tuple[Model, int]:
    """The model without points that no training photo sees, and how many those were.

    Points without any track stay: who sees them is not known.
    """
    points = model.points
    train = [i.image_id for i in model.images.values() if split.get(i.name) == "train"]
    lengths = np.diff(points.track_offsets)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    seen = np.bincount(owner, weights=np.isin(points.track_image_ids, train), minlength=len(lengths))
    keep = (seen > 0) | (lengths == 0)
    rows = keep[owner] if len(owner) else np.zeros(0, bool)
    kept = ModelPoints(
        points.ids[keep],
        points.xyz[keep],
        points.rgb[keep],
        points.error_px[keep],
        np.concatenate([[0], np.cumsum(lengths[keep])]).astype(np.int64),
        points.track_image_ids[rows],
        points.track_point2d[rows],
    )
    images = {
        number: dataclasses.replace(
            image, point_ids=np.where(np.isin(image.point_ids, kept.ids), image.point_ids, -1)
        )
        for number, image in model.images.items()
    }
    return Model(model.cameras, images, kept), int((~keep).sum())


def random_points(model: Model, split: Mapping[str, Split], *, blender: bool, seed: int = 0) -> ModelPoints:
    """Points of random place and colour, as the reference trainers start without a model.

    Args:
        model: its training cameras place the cube, except for Blender's, which is fixed.
        split: sides by name.
        blender: 3DGS's cube of side 2.6 about the origin.
        seed: of the generator.
    """
    generator = np.random.default_rng(seed)
    centre, half = np.zeros(3), BLENDER_SIDE
    if not blender:
        poses = [i.cam_from_world() for i in model.images.values() if split.get(i.name) == "train"]
        centres = np.array([-p[:3, :3].T @ p[:3, 3] for p in poses])
        centre = centres.mean(axis=0)
        half = CAMERA_SIDE * float(np.linalg.norm(centres - centre, axis=1).max())
    xyz = centre + (half or 1.0) * generator.uniform(-1, 1, (RANDOM_POINTS, 3))
    return points_without_tracks(xyz, generator.integers(0, 256, (RANDOM_POINTS, 3), dtype=np.uint8))


def triangulate(
    folder: Path,
    model: Model,
    photos: Path,
    split: Mapping[str, Split],
    *,
    seed: int,
    jobs: int,
    bar: Bar,
) -> Model:
    """Points by matching the photos and triangulating with the known poses, which stay as they are.

    Args:
        folder: empty, for COLMAP's files.
        model: cameras and poses.
        photos: folder that the model's names refer to.
        split: photos of neither side are not used.
        seed: of matching.
        jobs: threads of features and matching.
        bar: progress.

    Returns:
        The same cameras and poses; no points where fewer than `LEAST_POINTS` were found.
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
    found = read_model(folder / "points")
    if len(found.points.ids) < LEAST_POINTS:
        return model
    # Poses as given, not as they come back from COLMAP's files.
    by_name: dict[str, ModelImage] = {i.name: i for i in found.images.values()}
    images = {
        by_name[name].image_id: dataclasses.replace(
            by_name[name], qvec=i.qvec, tvec=i.tvec, camera_id=i.camera_id
        )
        for name, i in used.items()
        if name in by_name
    }
    return Model(model.cameras, images, found.points)


def find_motion(
    scene: Path, scratch: Path, train: Sequence[str], *, seed: int, jobs: int, bar: Bar
) -> MotionResult:
    """Match the train photos of a scene folder and write what moves in them (motion.npz) into it.

    Args:
        scene: folder with images/ and sparse/0, undistorted.
        scratch: for COLMAP's files; emptied first.
        train: names of the photos.
        seed: of matching.
        jobs: threads.
        bar: progress.

    Returns:
        Numbers of features that stay and move.

    Raises:
        AwError: the poses do not fit the photos' own matches.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    model = read_model(scene / "sparse" / "0")
    split: dict[str, Split] = dict.fromkeys(train, "train")
    database = _match_posed(scratch, model, scene / "images", split, "auto", seed, jobs, bar)
    job: MotionJob = {
        "task": "motions",
        "database": str(database),
        "model": str(scratch / "known"),
        "output": str(scratch / MOTIONS),
        "seed": seed,
        "jobs": jobs,
    }
    bar.start("motions", None)
    run_job(job, scratch, lambda: None)
    bar.finish()
    names = {name: name for name in train}
    found = write_motion(scene, database, scratch / MOTIONS, scratch / "known", scene / "sparse" / "0", names)
    if 2 * found["silent"] > len(names):
        raise AwError(
            f"in {found['silent']} of {len(names)} train photos no matches fit the given poses, so nothing "
            "tells what moves; import without --motion, or place the photos anew with 'aw build-scene'"
        )
    return found


def _match_posed(
    folder: Path,
    model: Model,
    photos: Path,
    split: Mapping[str, Split],
    sfm: Effort,
    seed: int,
    jobs: int,
    bar: Bar,
) -> Path:
    """COLMAP's database of the photos in `split`, matched, with known cameras; known/ has their poses."""
    used = {i.name: i for i in model.images.values() if i.name in split}
    facts = [
        cast(ScreenedPhoto, {"work_name": name, "source": name, "side": split[name]}) for name in sorted(used)
    ]
    settings = BuildSettings(seed=seed, sfm=sfm)
    camera = "single" if len(model.cameras) == 1 else "per-image"
    for part in ("features", "matches", "known"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    plan = plans(facts, settings)[0]
    extract_features(folder / "features", photos, facts, settings, plan, jobs, camera, None, bar)
    _set_cameras(folder / "features" / DATABASE, folder / "known", model, used)
    match(folder / "matches", folder / "features", facts, settings, plan, jobs, bar, posed=True)
    colmap_binary.write_points(folder / "known" / "points3D.bin", no_points())
    return folder / "matches" / DATABASE


def _set_cameras(database: Path, known: Path, model: Model, used: Mapping[str, ModelImage]) -> None:
    """Give the database the known cameras, and write the model with the database's numbers."""
    with closing(sqlite3.connect(database)) as db, db:
        rows = db.execute("SELECT name, image_id, camera_id FROM images").fetchall()
        sizes = {n: (w, h) for n, w, h in db.execute("SELECT camera_id, width, height FROM cameras")}
        cameras, images = {}, []
        for name, image_id, camera_id in rows:
            camera = model.cameras[used[name].camera_id]
            if sizes[camera_id] != (camera.width, camera.height):
                raise AwError(
                    f"{name} is {sizes[camera_id][0]}x{sizes[camera_id][1]}, its camera {camera.width}x"
                    f"{camera.height}: points cannot be triangulated; use the photos that the poses belong to"
                )
            cameras[camera_id] = dataclasses.replace(camera, camera_id=camera_id)
            images.append(dataclasses.replace(used[name], image_id=image_id, camera_id=camera_id))
        for camera in cameras.values():
            params = np.array(camera.params, "<f8").tobytes()
            db.execute(
                "UPDATE cameras SET model = ?, params = ?, prior_focal_length = 1 WHERE camera_id = ?",
                (MODELS[camera.model][0], params, camera.camera_id),
            )
    colmap_binary.write_cameras(known / "cameras.bin", cameras.values())
    colmap_binary.write_images(known / "images.bin", images)


def read_point_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Positions [M, 3] and colours [M, 3] uint8 of a point cloud, ASCII or binary little-endian.

    Raises:
        AwError: unreadable, damaged, or without x, y, z.
    """
    try:
        if path.stat().st_size > _LARGEST_PLY:
            raise AwError(f"{path} is larger than {_LARGEST_PLY // 10**9} GB")
        data = path.read_bytes()
    except OSError as error:
        raise AwError(f"cannot read the points {path}: {error.strerror}") from error
    end = data.find(b"end_header\n", 0, 65536)
    if not data.startswith(b"ply") or end < 0:
        raise AwError(f"{path} is no PLY file")
    form, count, names, types = _ply_header(path, data[:end].decode("ascii", errors="replace"))
    body = data[end + len(b"end_header\n") :]
    try:
        if form == "ascii":
            rows = body.decode("ascii").split("\n")[:count]
            table = np.array([[float(v) for v in row.split()[: len(names)]] for row in rows])
            columns = {n: table[:, i] for i, n in enumerate(names)} if count else {}
        else:
            layout = np.dtype(list(zip(names, types)))
            records = np.frombuffer(body, layout, count)
            columns = {n: records[n] for n in names}
    except (ValueError, IndexError, UnicodeDecodeError) as error:
        raise AwError(f"{path} is cut short or damaged; copy it again") from error
    if not all(axis in columns for axis in "xyz"):
        raise AwError(f"{path} has no x, y and z")
    xyz = np.stack([columns[a].astype(np.float64) for a in "xyz"], axis=1)
    if not np.isfinite(xyz).all():
        raise AwError(f"{path} holds positions that are not finite")
    if all(c in columns for c in ("red", "green", "blue")):
        rgb = np.stack([columns[c] for c in ("red", "green", "blue")], axis=1)
        rgb = np.clip(rgb * (255.0 if rgb.dtype.kind == "f" and form != "ascii" else 1.0), 0, 255).astype(
            np.uint8
        )
    else:
        rgb = np.full(xyz.shape, 128, np.uint8)
    return xyz, rgb


def _ply_header(path: Path, text: str) -> tuple[str, int, list[str], list[str]]:
    form, count, names, types, inside = "", -1, [], [], False
    for line in text.splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1] if len(words) > 1 else ""
        elif words[:1] == ["element"]:
            inside = words[1:2] == ["vertex"]
            if inside and count < 0 and len(words) == 3 and words[2].isdigit():
                count = int(words[2])
            elif not inside and count < 0:
                raise AwError(f"{path}: its first element is not vertex")
        elif words[:1] == ["property"] and inside:
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise AwError(f"{path}: the property {line.strip()[:60]!r} is not supported")
            types.append(_PLY_TYPES[words[1]])
            names.append(words[2])
    if form not in ("ascii", "binary_little_endian") or count < 0:
        raise AwError(f"{path}: format {form[:30]!r} is not supported: ascii and binary_little_endian are")
    return form, count, names, types
