"""The account a scene gives of itself: scene.json, the verdict line, and what changed since."""

from __future__ import annotations

import math
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.builder.settings import BuildSettings
from ambiguous_wild.core.config import to_plain
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.colmap_model import Model

LEAST_PARALLAX_DEG = 1.5  # what COLMAP itself asks of a point
SFM_STAGES = ("features", "matches", "mapping")


def account(
    settings: BuildSettings,
    screened: dict[str, Any],
    features: dict[str, Any],
    matches: dict[str, Any],
    mapping: dict[str, Any],
    best: int,
    model: Model,
    others: dict[int, Model],
    database: Path,
    *,
    train: list[str],
    test: list[str],
    how: str,
    factor: int,
    truth: dict[str, int] | None,
    masks: dict[str, Any] | None,
    warnings: list[str],
) -> dict[str, Any]:
    """scene.json without its files, hashes and timings."""
    from ambiguous_wild.builder.select_model import lost_photos

    facts = screened["photos"]
    lost = lost_photos(facts, model, others, database, features["features"])
    chosen = next(m for m in mapping["models"] if m["model"] == best)
    sides = {**dict.fromkeys(train, "train"), **dict.fromkeys(test, "test")}
    only_test, short = point_checks(model, {f["work_name"]: f"{f['stem']}.png" for f in facts}, set(test))
    return {
        "name": settings.name,
        "license": settings.license or "not stated",
        "factor": factor,
        "images": "images" if factor == 1 else f"images_{factor}",
        "split": how,
        "seed": settings.seed,
        "settings": to_plain(settings),
        "chosen": {
            "camera": features["camera"],
            "matcher": matches["matcher"],
            "mapper": settings.mapper,
            "model": best,
        },
        "counts": {
            "photos": len(facts) + len(screened["skipped"]),
            "readable": len(facts),
            "registered": len(model.images),
            "train": len(train),
            "test": len(test),
            "cameras": len(model.cameras),
            "points": chosen["points"],
            "points_seen_in_test_only": only_test,
            "points_of_track_length_2": short,
            "pairs": matches["pairs"],
            "pairs_verified": matches["verified"],
        },
        "reprojection_error_px": chosen["error_px"],
        "mean_track_length": chosen["track_length"],
        "models": mapping["models"],
        "lost": lost,
        "skipped": screened["skipped"],
        "warnings": [
            *screened["warnings"],
            *_model_warnings(mapping["models"], best),
            *_turned(model),
            *warnings,
        ],
        "photos": {f"{f['stem']}.png": _photo(f, sides, features["features"]) for f in facts},
        "masks": masks,
        "truth": truth,
    }


def point_checks(model: Model, names: dict[str, str], test: set[str]) -> tuple[int, int]:
    """(points seen in test photos only, points seen twice): what leaks, and what rests on little."""
    points = model.points
    tests = [i.image_id for i in model.images.values() if names[i.name] in test]
    lengths = np.diff(points.track_offsets)
    if not len(lengths):
        return 0, 0
    in_train = ~np.isin(points.track_image_ids, tests)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    trained = np.bincount(owner, weights=in_train, minlength=len(lengths))
    return int((trained == 0).sum()), int((lengths == 2).sum())


def parallax_deg(model: Model) -> float:
    """Median over points of the widest angle from the first ray that found it; NaN without points."""
    points = model.points
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.track_offsets))
    numbers = sorted(model.images)
    at = {number: k for k, number in enumerate(numbers)}
    poses = np.array([model.images[n].cam_from_world() for n in numbers]).reshape(-1, 4, 4)
    centres = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    rows = np.array([at[int(i)] for i in points.track_image_ids], dtype=np.intp)
    rays = centres[rows] - points.xyz[owner]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
    # the widest of all pairs is at most twice that, and costs the square
    first = rays[points.track_offsets[owner]]
    angles = np.zeros(len(points.xyz))
    np.maximum.at(angles, owner, np.arccos(np.clip((rays * first).sum(axis=1), -1.0, 1.0)))
    return math.degrees(float(np.median(angles))) if len(angles) else math.nan


def verdict(info: dict[str, Any], size: tuple[int, int], scene: Path) -> str:
    """One line: what came out, and the next command."""
    counts = info["counts"]
    points = f"{counts['points']:,}".replace(",", " ")
    return (
        f"registered {counts['registered']} of {counts['photos']}, {points} points, "
        f"{info['reprojection_error_px']:.2f} px, {size[0]}x{size[1]} at factor {info['factor']}: ready; "
        f"next: aw bench --method refinesplat --scene {shlex.quote(str(scene))} -o runs"
    )


def lines(info: dict[str, Any]) -> list[str]:
    """What a person should know before training: the split, what was lost, every warning."""
    counts = info["counts"]
    found = [f"{counts['train']} training and {counts['test']} test photos (split: {info['split']})"]
    if info["lost"]:
        reasons = shortlist([f"{p['source']} ({p['reason']})" for p in info["lost"]], 4)
        found.append(f"{len(info['lost'])} not placed: {reasons}")
    return found + [f"warning: {w}" for w in info["warnings"]]


def sfm_share(info: dict[str, Any]) -> float:
    """Share of the build's stages that COLMAP took, 0..1."""
    seconds = info["seconds"]
    return sum(seconds.get(s, 0.0) for s in SFM_STAGES) / max(sum(seconds.values()), 1e-9)


def what_changed(old: dict[str, Any], new: dict[str, Any]) -> str:
    """Which inputs differ, for the message that refuses to overwrite."""
    parts = [k.replace("_", " ") for k in ("photos", "masks", "truth", "test_list") if old.get(k) != new[k]]
    for group in ("settings", "versions"):
        before = old.get(group) or {}
        keys = [k for k, v in new[group].items() if before.get(k) != v]
        parts += [f"{group} ({shortlist(f'{k} {before.get(k)} -> {new[group][k]}' for k in keys)})"] * bool(
            keys
        )
    return ", ".join(parts) or "inputs"


def _photo(fact: dict[str, Any], sides: dict[str, str], features: dict[str, int]) -> dict[str, Any]:
    # Where the photographer stood is theirs to publish: GPS stays out of the scene.
    exif = {k: v for k, v in fact["exif"].items() if k not in ("latitude_deg", "longitude_deg", "altitude_m")}
    return {
        "source": fact["source"],
        "sha256": fact["sha256"],
        "split": sides.get(f"{fact['stem']}.png"),
        "width": fact["width"],
        "height": fact["height"],
        "blur": fact["blur"],
        "mean_luma": fact["mean_luma"],
        "features": features.get(fact["work_name"], 0),
        "notes": fact["notes"],
        "exif": exif,
    }


def _model_warnings(listing: list[dict[str, Any]], best: int) -> list[str]:
    rest = [f"{m['images']} photos" for m in listing if m["model"] != best]
    if not rest:
        return []
    return [
        f"the capture fell apart into {len(listing)} models; the largest is used, left out: {', '.join(rest)}"
    ]


def _turned(model: Model) -> list[str]:
    angle = parallax_deg(model)
    if not angle < LEAST_PARALLAX_DEG:
        return []
    return [
        f"the camera hardly moved: half of the points are seen under less than {angle:.2f} deg, so their "
        "depth is a guess and views from aside will be wrong; walk between photos"
    ]
