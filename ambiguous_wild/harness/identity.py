"""What a run and a scene are known by: hashes that others can compute again from the files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ambiguous_wild.core import Scene
from ambiguous_wild.core.config import config_hash

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
        # A plain COLMAP scene lists no hashes: cameras and points stand for it.
        poses = np.concatenate([v.camera.cam_from_world.ravel() for v in scene.views])
        known = {"poses": poses.round(9).tolist(), "points": len(scene.points)}
    return config_hash({"files": known, "split": split})
