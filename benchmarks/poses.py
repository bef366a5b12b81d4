"""Camera poses of `aw build-scene` against the truth, beside COLMAP's own mappers.

    python benchmarks/poses.py --data DIR --out DIR [--bases monstree ...] [--presets yard ...]
        [--kinds clean cutouts patches] [--every 1 2 3 4] [--seeds 0 1 2]
        [--ways auto thorough colmap colmap-global before-auto ...] [--before CHECKOUT] [--results NAME]

--data holds a folder of clean photos a base (its photos, or images/ with them), and cut-outs in cutouts/.
Distractors are pasted before structure from motion (`aw composite`), cut-outs and pieces of other photos;
the truth is a careful model of all clean photos, or the GPS positions in NAME-gps.json: {stem: [x, y] in m}.
Presets are simulated, with exact truth. With --every 3 only every third photo is used, so that the photos
overlap little. Ways that begin with "before-" are built by --before, another checkout. Everything that is
finished is kept. Writes benchmarks/results/poses.json and .md, or those of --results.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from job_queue import exit_code

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.cell import environment
from ambiguous_wild.io.colmap_model import read_model
from ambiguous_wild.io.files import write_json, write_text
from ambiguous_wild.io.photos import PHOTO_SUFFIXES

RESULTS = Path(__file__).parent / "results" / "poses"
BASES = ("monstree", "sceaux", "seneca", "skull")
WAYS = ("auto", "thorough", "colmap", "colmap-global")
KINDS = ("cutouts", "patches")
ROTATION_DEG, POSITION_PERCENT = 1.0, 5.0  # a pose is right if both errors are below
POSITION_M = 20.0  # the same by GPS, whose own error is several metres in a street
MAX_TRIPLES = 2000  # of photos, to which the similarity is fitted
MIN_COMPOSITE = 6  # photos: `aw composite` refuses fewer
COLMAP = """
import os, sys, zlib, pycolmap
photos, out, mapper, seed = sys.argv[1:]
pycolmap.set_random_seed(int(seed))
extraction = pycolmap.FeatureExtractionOptions(use_gpu=False, max_image_size=1600)
extraction.sift.max_num_features = 3000
database = out + "/../colmap.db"  # of both mappers
if not os.path.exists(database):
    part, matching = database + ".part", pycolmap.FeatureMatchingOptions(use_gpu=False)
    pycolmap.extract_features(part, photos, extraction_options=extraction)
    pycolmap.match_exhaustive(part, matching_options=matching)
    os.rename(part, database)
mapping = pycolmap.global_mapping if mapper == "colmap-global" else pycolmap.incremental_mapping
models = mapping(database, photos, out)
if not models:
    sys.exit(2)
largest = max(models.values(), key=lambda model: model.num_reg_images())
largest.write(out)
"""

Poses = dict[str, tuple[np.ndarray, np.ndarray, float]]  # rotation [3, 3] from world, centre [3], focal px


def model_poses(folder: Path) -> Poses:
    """Of a COLMAP model, by the name of the photo without its ending."""
    model, estimated = read_model(folder), {}
    for image in model.images.values():
        pose = image.cam_from_world()
        centre = -pose[:3, :3].T @ pose[:3, 3]
        focal_px = float(model.cameras[image.camera_id].params[0])
        estimated[Path(image.name).stem] = pose[:3, :3], centre, focal_px
    return estimated


def exact_poses(cameras: Path) -> Poses:
    """Of a simulated capture."""
    estimated = {}
    for name, camera in json.loads(cameras.read_text(encoding="utf-8")).items():
        pose = np.array(camera["cam_from_world"])
        estimated[Path(name).stem] = pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3], float(camera["fx"])
    return estimated


def compare(estimated: Poses, truth: Poses) -> dict[str, Any]:
    """How many poses are right, and which are not.

    The similarity between the two paths is fitted to the photos whose rotation is right: of those of every
    three of them, the one under which most positions are right. A photo that the truth lacks is not judged.
    """
    names = sorted(set(estimated) & set(truth))
    if len(names) < 3:
        return {"known": len(truth), "judged": len(names), "right": 0, "wrong": {}}
    # World of the truth from that of the model.
    world_rotations = np.array([truth[n][0].T @ estimated[n][0] for n in names])
    angles_deg = _angles_deg(np.einsum("aij,bkj->abik", world_rotations, world_rotations))
    rotation_deg = {n: float(np.median(np.delete(angles_deg[k], k))) for k, n in enumerate(names)}
    inliers = [n for n in names if rotation_deg[n] <= ROTATION_DEG]
    inliers = inliers if len(inliers) >= 3 else list(names)
    triples = list(itertools.combinations(inliers, 3))
    chosen = np.random.default_rng(0).permutation(len(triples))[:MAX_TRIPLES]
    position_percent, right = {}, -1
    for fitted in (inliers, *(triples[k] for k in chosen)):
        for _ in range(2):  # then to those that are right under it
            errors = _position_errors_percent(names, fitted, estimated, truth)
            near = [n for n in inliers if errors[n] <= POSITION_PERCENT]
            if len(near) > right:
                position_percent, right = errors, len(near)
            fitted = near if len(near) >= 3 else fitted
    wrong = {
        n: [round(rotation_deg[n], 2), round(position_percent[n], 2)]
        for n in names
        if rotation_deg[n] > ROTATION_DEG or position_percent[n] > POSITION_PERCENT
    }
    focal = [100 * (estimated[n][2] / truth[n][2] - 1) for n in names]
    return {
        "known": len(truth),  # photos
        "judged": len(names),
        "right": len(names) - len(wrong),
        "wrong": wrong,  # degrees, percent of the path's radius
        "position_percent": round(float(np.median(list(position_percent.values()))), 3),
        "focal_percent": round(float(np.median(focal)), 3),
    }


def _position_errors_percent(
    names: Sequence[str], inliers: Sequence[str], estimated: Poses, truth: Poses
) -> dict[str, float]:
    source, target = (np.array([poses[n][1] for n in inliers]) for poses in (estimated, truth))
    path = np.array([truth[n][1] for n in names])
    radius = np.linalg.norm(path - path.mean(0), axis=1).max()
    distances = _aligned_distances(source, target, np.array([estimated[n][1] for n in names]), path)
    return dict(zip(names, (100 * distances / radius).tolist()))


def _aligned_distances(
    source: np.ndarray, target: np.ndarray, points: np.ndarray, targets: np.ndarray
) -> np.ndarray:
    """Distances [N] of `points` from `targets` [N, D] after the similarity that fits `source` to `target`."""
    mean, target_mean = source.mean(0), target.mean(0)
    left, values, right = np.linalg.svd((target - target_mean).T @ (source - mean))
    signs = np.ones(len(values))
    signs[-1] = np.sign(np.linalg.det(left @ right))
    rotation = left @ np.diag(signs) @ right
    scale = (values * signs).sum() / max(float(((source - mean) ** 2).sum()), 1e-30)
    return np.linalg.norm(scale * (points - mean) @ rotation.T + target_mean - targets, axis=1)


def compare_gps(estimated: Poses, truth: Mapping[str, Sequence[float]]) -> dict[str, Any]:
    """Distances of the cameras from their GPS positions, in the plane of the cameras."""
    names = sorted(set(estimated) & set(truth))
    if len(names) < 3:
        return {"known": len(truth), "judged": len(names), "right": 0, "wrong": {}}
    centres, targets = np.array([estimated[n][1] for n in names]), np.array([truth[n] for n in names])
    axes = np.linalg.svd(centres - centres.mean(0), full_matrices=False)[2]
    plane = (centres - centres.mean(0)) @ axes[:2].T
    distances = min(
        (_aligned_distances(p, targets, p, targets) for p in (plane, plane * [1, -1])), key=np.median
    )
    wrong = {n: [0.0, round(float(m), 2)] for n, m in zip(names, distances) if m > POSITION_M}
    return {
        "known": len(truth),
        "judged": len(names),
        "right": len(names) - len(wrong),
        "wrong": wrong,  # 0, metres
        "position_m": round(float(np.median(distances)), 2),
    }


def _angles_deg(rotations: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(np.clip((np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def aw(*words: object, checkout: Path | None = None) -> str:
    """One command; "" or the last line of its refusal.

    Raises:
        AwError: it failed for another reason.
    """
    env = {**os.environ, "PYTHONPATH": str(checkout)} if checkout else None
    command = [sys.executable, "-m", "ambiguous_wild.cli.main", *map(str, words)]
    done = subprocess.run(command, env=env, cwd=checkout, capture_output=True, text=True)
    last = (done.stderr.strip().splitlines() or ["no output"])[-1]
    if done.returncode not in (0, 2):
        raise AwError(f"aw {words[0]} ended with code {done.returncode}: {last}")
    return last if done.returncode else ""


def capture_of(
    name: str, seed: int, kind: str, every: int, args: argparse.Namespace
) -> tuple[Path, Callable[[Poses], dict[str, Any]]] | None:
    """The raw capture and the comparison with its truth; both are made where they are missing.

    None where too few photos are left to paste on.

    Raises:
        AwError: a command failed.
    """
    thin = f"-every{every}" * (every > 1)
    raw = (
        args.out
        / "captures"
        / (f"{name}{thin}-{seed}" if kind == "simulated" else f"{name}{thin}-{kind}-{seed}")
    )
    if kind == "simulated":
        whole = args.out / "captures" / f"{name}-{seed}"
        problem = "" if whole.is_dir() else aw("simulate", name, "--seed", seed, "--width", 480, "-o", whole)
        if problem:
            raise AwError(problem)
        if not raw.is_dir():
            for side in ("train", "test"):
                _copy_every(whole / side, raw / side, every)
        return raw, _comparison(raw, exact_poses(whole / "truth" / "cameras.json"))
    source = args.data / name
    if not source.is_dir():
        raise AwError(f"{source}: no such folder; --data holds a folder of clean photos a base")
    source = source / "images" if (source / "images").is_dir() else source
    photos = args.out / "photos" / f"{name}{thin}"
    if not photos.is_dir():
        _copy_every(source, photos, every)
    if kind != "clean" and len(_photos(photos)) < MIN_COMPOSITE:
        return None
    if kind == "clean":
        raw = raw if raw.is_dir() else Path(shutil.copytree(photos, raw))
    elif not raw.is_dir():
        shapes = ("--patches",) if kind == "patches" else ("--cutouts", args.data / "cutouts")
        if problem := aw("composite", photos, "-o", raw, "--seed", seed, *shapes):
            raise AwError(problem)
    gps = args.data / f"{name}-gps.json"
    if gps.is_file():
        stems = {photo.stem for photo in _photos(raw)}
        known = {k: v for k, v in json.loads(gps.read_text(encoding="utf-8")).items() if k in stems}
        return raw, lambda estimated: compare_gps(estimated, known)
    truth = args.out / "truth" / name
    careful = ("--sfm", "thorough", "--max-features", 8000, "--factor", 4)
    problem = "" if truth.is_dir() else aw("build-scene", source, "-o", truth, *careful)
    if problem:
        raise AwError(problem)
    return raw, _comparison(raw, model_poses(truth / "sparse" / "0"))


def _photos(raw: Path) -> list[Path]:
    """The photos of a capture, with or without train/ and test/."""
    folders = [raw / side for side in ("train", "test") if (raw / side).is_dir()] or [raw]
    return [p for f in folders for p in sorted(f.iterdir()) if p.suffix.lower() in PHOTO_SUFFIXES]


def _copy_every(source: Path, target: Path, every: int) -> None:
    target.mkdir(parents=True)
    for photo in _photos(source)[::every]:
        shutil.copyfile(photo, target / photo.name)


def _comparison(raw: Path, truth: Poses) -> Callable[[Poses], dict[str, Any]]:
    stems = {photo.stem for photo in _photos(raw)}
    return lambda estimated: compare(estimated, {k: v for k, v in truth.items() if k in stems})


def build(raw: Path, way: str, seed: int, args: argparse.Namespace) -> dict[str, Any]:
    """Where the model lies and what the build says; a refused one has only `refused`."""
    out = args.out / "builds" / raw.name / way
    if way.startswith("colmap"):
        return _build_with_colmap(raw, way, seed, out)
    refused = out.with_name(f"{way}.refused")
    if not out.is_dir() and not refused.is_file():
        sfm = way.removeprefix("before-")
        checkout = args.before.resolve() if way.startswith("before-") else None
        words = ("-o", out, "--sfm", sfm, "--factor", 1, "--seed", seed)
        problem = aw("build-scene", raw, *words, checkout=checkout)
        if problem:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_text(refused, problem)
    if refused.is_file():
        return {"refused": refused.read_text(encoding="utf-8")}
    info = json.loads((out / "scene.json").read_text(encoding="utf-8"))
    return {
        "model": out / "sparse" / "0",
        "photos": info["counts"]["photos"],
        "placed": info["counts"]["registered"],
        "points": info["counts"]["points"],
        "chosen": info["chosen"]["sfm"],
        "provisional": [Path(name).stem for name, p in info["photos"].items() if p.get("provisional")],
        "seconds": {stage: info["seconds"].get(stage) for stage in ("features", "matches", "mapping")},
    }


def _build_with_colmap(raw: Path, way: str, seed: int, out: Path) -> dict[str, Any]:
    photos = _photos(raw)
    if not (out / "images.bin").is_file():
        shutil.rmtree(out, ignore_errors=True)
        together = out / "photos"
        together.mkdir(parents=True)
        for photo in photos:
            shutil.copyfile(photo, together / photo.name)
        done = subprocess.run([sys.executable, "-c", COLMAP, together, out, way, str(seed)])
        if done.returncode not in (0, 2):
            raise AwError(f"COLMAP ended with code {done.returncode} on {raw}")
        if done.returncode:
            return {"refused": "COLMAP found no model"}
    try:
        placed = len(read_model(out).images)
    except AwError as error:  # the global mapper may return a camera with a negative focal length
        return {"refused": str(error)}
    return {"model": out, "photos": len(photos), "placed": placed}


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    """A row a capture; of every way: right / registered poses, worst wrong angle, position, focal length."""
    ways = list(dict.fromkeys(row["way"] for row in rows))
    captures = list(dict.fromkeys(row["capture"] for row in rows))
    known = {(row["capture"], row["way"]): row for row in rows}
    head = ["capture", "photos", *ways]
    lines = [f"| {' | '.join(head)} |", "|---|---:|" + "---|" * len(ways)]
    for capture in captures:
        mine = [known.get((capture, way)) for way in ways]
        count = max((row.get("photos", 0) for row in mine if row), default=0)
        lines.append(f"| {capture} | {count} | {' | '.join(map(_cell, mine))} |")
    lines += ["", "Each cell: photos placed rightly of those judged; wrong ones, the worst in degrees;"]
    lines += ["median position error in % of the path's radius, or in m by GPS; focal length error in %.", ""]
    common = [c for c in captures if all((c, way) in known for way in ways)]
    lines.append(f"Over the {len(common)} captures that every way has:")
    photos = sum(max(known[c, way].get("known", 0) for way in ways) for c in common)
    for way in ways:
        of_way = [known[c, way] for c in common]
        right = sum(row.get("right", 0) for row in of_way)
        wrong = sum(row.get("judged", 0) - row.get("right", 0) for row in of_way)
        refused = sum("refused" in row for row in of_way)
        named = sum(len(row.get("wrong", {}).keys() & set(row.get("provisional", ()))) for row in of_way)
        lines.append(
            f"- {way}: {right} of {photos} photos right, {wrong} wrong ({named} of them named as "
            f"provisional), {photos - right - wrong} left out, {refused} captures refused"
        )
    return "\n".join(lines) + "\n"


def _cell(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    if "refused" in row:
        return "refused"
    text = f"{row['right']} of {row['judged']}"
    if row["wrong"]:
        text += f"; {len(row['wrong'])} wrong, {max(angle for angle, _ in row['wrong'].values()):.1f}"
    if "position_m" in row:
        return f"{text}; {row['position_m']:.1f} m"
    if "position_percent" not in row:
        return text
    return f"{text}; {row['position_percent']:.2f} %; {row['focal_percent']:+.2f} %"


def main(words: Sequence[str] | None = None) -> None:
    """Build and compare what is missing; write both files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--bases", nargs="*", default=list(BASES))
    parser.add_argument("--presets", nargs="*", default=[])
    parser.add_argument("--kinds", nargs="+", choices=("clean", *KINDS), default=list(KINDS))
    parser.add_argument("--every", nargs="+", type=int, default=[1])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--ways", nargs="+", default=list(WAYS))
    parser.add_argument("--before", type=Path, metavar="CHECKOUT")
    parser.add_argument("--report-only", action="store_true", help="only what was compared before")
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args(words)
    args.data, args.out = args.data.resolve(), args.out.resolve()  # other checkouts run in their own folder
    if args.before is not None and not (args.before / "ambiguous_wild").is_dir():
        parser.error(f"--before {args.before}: no checkout of this project")  # else it would compare itself
    if any(way.startswith("before-") for way in args.ways) and args.before is None:
        parser.error("ways that begin with before- need --before CHECKOUT")
    kinds = [(n, kind) for n in args.bases for kind in args.kinds]
    kinds += [(n, "simulated") for n in args.presets]
    rows = []
    for (name, kind), every, seed in itertools.product(kinds, args.every, args.seeds):
        thin = f"-every{every}" * (every > 1)
        capture = f"{name}{thin}-{seed}" if kind == "simulated" else f"{name}{thin}-{kind}-{seed}"
        for way in args.ways:
            kept = args.out / "rows" / f"{capture}-{way}.json"
            if not kept.is_file() and not args.report_only:
                made = capture_of(name, seed, kind, every, args)
                if made is None:
                    print(f"{capture}: too few photos to paste on, left out")
                    break
                raw, comparison = made
                row = build(raw, way, seed, args)
                model = row.pop("model", None)
                row |= comparison(model_poses(model) if model else {})
                kept.parent.mkdir(parents=True, exist_ok=True)
                write_json(kept, {"capture": capture, "way": way, **row})
            if kept.is_file():
                rows.append(json.loads(kept.read_text(encoding="utf-8")))
    write_json(
        args.results.with_name(args.results.name + ".json"), {"environment": environment("cpu"), "rows": rows}
    )
    write_text(args.results.with_name(args.results.name + ".md"), markdown(rows))
    print(markdown(rows))


if __name__ == "__main__":
    sys.exit(exit_code(main))
