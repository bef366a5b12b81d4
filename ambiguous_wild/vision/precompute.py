"""Features and instances of all photos, computed before training; each photo is one entry of a cache on disk.

An entry is computed once and shared between runs. It carries a hash over its key and its arrays: one that was
damaged, changed or put under the name of another is computed anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core.config import config_hash, to_plain
from ambiguous_wild.core.machine import in_order
from ambiguous_wild.io.files import atomic_path, sha256_array
from ambiguous_wild.io.progress_bar import terminal_bar
from ambiguous_wild.vision.label_maps import LabelMaps
from ambiguous_wild.vision.protocols import Features, Instances, SceneInstances
from ambiguous_wild.vision.segments import GraphSegments

Arrays = dict[str, np.ndarray]
STALE_S = 24 * 3600.0  # older temporary files are leftovers of a killed process
_SEAL = "sha256"  # member of an entry with the hash over its key and its arrays


def cache_key(kind: str, backend: str, settings: Any, *arrays: np.ndarray) -> str:
    """Make the key of an entry: a hash of the pixels, the back end's name and version, and every setting.

    Args:
        kind: kind of content, e.g. ``"segments"``; the first part of the file's name.
        backend: name of the back end, with its version.
        settings: dataclass or plain data; everything that changes the result.
        arrays: the inputs, hashed with shape and dtype.
    """
    digest = hashlib.sha256()
    digest.update(json.dumps([kind, backend, to_plain(settings)], sort_keys=True).encode())
    for array in arrays:
        digest.update(sha256_array(array).encode())
    return f"{kind}-{digest.hexdigest()[:32]}"


def cached(
    folder: Path, key: str, expected: Mapping[str, type | str], compute: Callable[[], Arrays]
) -> Arrays:
    """Load the arrays stored under `key`, else compute and store them.

    Args:
        folder: the cache; created if needed.
        key: from `cache_key`.
        expected: name and dtype of every array. A damaged or different entry is computed again.
        compute: computes the arrays.
    """
    _tidy(folder)
    path = folder / f"{key}.npz"
    stored = _load(path, key, expected)
    if stored is not None:
        return stored
    arrays = compute()
    with atomic_path(path) as temporary, open(temporary, "wb") as f:
        np.savez_compressed(f, **arrays, **{_SEAL: np.array(_seal(key, arrays))})  # type: ignore[arg-type]
    return arrays


def _seal(key: str, arrays: Arrays) -> str:
    return config_hash([key, {name: sha256_array(array) for name, array in arrays.items()}])


@cache  # once per process and folder, because it lists every entry
def _tidy(folder: Path) -> None:
    """Remove temporary files of killed processes; a recent one may still be in use."""
    for left in folder.glob(".*.tmp*"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > STALE_S:
                left.unlink()


def _load(path: Path, key: str, expected: Mapping[str, type | str]) -> Arrays | None:
    try:
        with np.load(path, allow_pickle=False) as entry:
            arrays = {name: entry[name] for name in expected}
            whole = str(entry[_SEAL]) == _seal(key, arrays)
    # np.load, zipfile, zlib and tokenize raise many types for a damaged entry
    except Exception:
        return None
    return arrays if whole and all(arrays[name].dtype == expected[name] for name in expected) else None


@dataclass(frozen=True)
class SceneLabels:
    """Label maps of all photos."""

    labels: list[np.ndarray]  # [H, W] int32 each, 0 = none
    scene_wide: bool  # all photos share the ids


def photo_features(features: Features, photos: Sequence[Tensor], folder: Path) -> list[Tensor]:
    """Features [h, w, C] of every photo [H, W, 3]; call `features.fit` first.

    Cached photos are not computed again. The precision is part of the key: features of a photo and of its
    render are compared, and a different precision would add to their distance.
    """
    state = {k: _digest(v) if isinstance(v, Tensor) else v for k, v in features.state_dict().items()}
    result = []
    for photo in terminal_bar("features")(photos):
        precision = features.precision(photo.device)
        name = f"{features.name}-{precision}" if precision else features.name
        key = cache_key("features", name, state, photo.detach().cpu().numpy())

        def compute(photo: Tensor = photo) -> dict[str, np.ndarray]:
            with torch.no_grad():
                return {"phi": features(photo).cpu().numpy()}

        phi = cached(folder, key, {"phi": np.float32}, compute)["phi"]
        result.append(torch.from_numpy(phi).to(photo.device))
    return result


def _digest(tensor: Tensor) -> str:
    """Hash of a tensor, for a cache key."""
    array = np.ascontiguousarray(tensor.detach().cpu().numpy())
    return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"


def instance_labels(
    instances: Instances,
    photos: Sequence[Tensor],
    names: Sequence[str],
    folder: Path,
    threads: int = 1,
) -> SceneLabels:
    """Label maps of every photo, with the scene's identities if the back end provides them.

    Args:
        instances: back end; of `SceneInstances` the ids are the scene's.
        photos: [H, W, 3] in [0, 1].
        names: names of the photos.
        folder: the cache; photos and chunks in it are not computed again.
        threads: photos that are segmented at a time, by back ends without a network.
    """
    shown = terminal_bar(f"instances ({instances.name.partition('-')[0]})")
    if isinstance(instances, SceneInstances):
        return SceneLabels(instances.identities(photos, names, folder, shown), True)
    if isinstance(instances, LabelMaps):
        return SceneLabels(instances.labels_of(photos, names), False)
    labels_of = partial(photo_labels, instances, folder=folder)
    threads = threads if isinstance(instances, GraphSegments) else 1
    return SceneLabels(list(in_order(labels_of, shown(photos), threads)), False)


def photo_labels(instances: Instances, photo: Tensor, folder: Path | None) -> np.ndarray:
    """Labels [H, W] int32 of one photo [H, W, 3] in [0, 1]; not computed again if the folder holds them."""
    if folder is None:
        return instances.labels(photo)
    key = cache_key("instances", instances.name, None, photo.detach().cpu().numpy())
    return cached(folder, key, {"labels": np.int32}, lambda: {"labels": instances.labels(photo)})["labels"]
