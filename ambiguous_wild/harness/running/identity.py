"""Identities of runs and scenes: hashes that anybody can compute again from the files."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.io.hashing import sha256_file
from ambiguous_wild.io.motion_points import FILE as MOTION

# Keys of config.yaml that do not decide the result: how often it is saved and probed, what is done about
# values that are not finite (the result says so where there were any), where the scene lies.
IGNORED: dict[str, tuple[str, ...]] = {
    "train": ("checkpoint_every_s", "probes", "on_nonfinite"),
    "scene": ("path",),
}
# Files of a scene that say how it came to be, versions included, and that nothing is trained or scored on:
# the same photos simulated by a later version are the same scene.
RECORDS = ("truth/capture.json",)


def config_identity(config: Mapping[str, Any]) -> str:
    """sha256 of what decides a run's result.

    Args:
        config: the resolved configuration, as in config.yaml; its own "config_hash" does not count.

    Raises:
        ValueError: it holds a number that is not finite.
        TypeError: it holds what JSON does not.
    """
    known = {k: v for k, v in config.items() if k != "config_hash"}
    for part, keys in IGNORED.items():
        known[part] = {k: v for k, v in config[part].items() if k not in keys}
    return config_hash(known)


def scene_identity(scene: Scene) -> str:
    """sha256 that stands for the scene: over its files' hashes, its split and the size it is loaded at."""
    files = scene.info.get("files")
    known = (
        {name: entry["sha256"] for name, entry in files.items() if name not in RECORDS}
        if isinstance(files, dict)
        else {}
    )
    split = [(v.name, v.split, v.camera.width, v.camera.height) for v in scene.views]
    if not known:
        known = _of_plain(scene)
    # masks that were put into the folder later are in no list
    for view in scene.views:
        if view.keep_path is not None:
            name = view.keep_path.relative_to(scene.root).as_posix()
            if name not in known:
                known[name] = _digest(view.keep_path)
    if MOTION not in known and (scene.root / MOTION).is_file():
        known[MOTION] = _digest(scene.root / MOTION)
    return config_hash({"files": known, "split": split})


def _of_plain(scene: Scene) -> dict[str, Any]:
    """What stands for a plain COLMAP scene, which lists no hashes: cameras, points and photos."""
    cameras = [v.camera for v in scene.views]
    lenses = [(c.fx, c.fy, c.cx, c.cy) for c in cameras]
    return {
        "poses": np.concatenate([c.cam_from_world.ravel() for c in cameras]).round(9).tolist(),
        "lenses": np.array(lenses).round(9).tolist(),
        "points": hashlib.sha256(
            scene.points.xyz.round(9).astype("<f8").tobytes() + scene.points.rgb.tobytes()
        ).hexdigest(),
        "photos": [_digest(v.image_path) for v in scene.views],
    }


def _digest(path: Path) -> str:
    """sha256 of a file, computed once for each state of it."""
    state = path.stat()
    return _digest_of(path, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=16_384)
def _digest_of(path: Path, size: int, mtime_ns: int) -> str:
    return sha256_file(path)
