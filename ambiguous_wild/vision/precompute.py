"""Features and instances of all photos, computed before training; each photo is one cache entry."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.vision.cache import cache_key, cached
from ambiguous_wild.vision.progress import Bar, terminal_bar
from ambiguous_wild.vision.protocols import Features, Instances, NamedInstances, SceneInstances


@dataclass(frozen=True)
class SceneLabels:
    """Label maps of all photos."""

    labels: list[np.ndarray]  # [H, W] int32 each, 0 = none
    scene_wide: bool  # all photos share the ids


@runtime_checkable
class PreciseFeatures(Protocol):
    """Features whose precision depends on the device; optional, in addition to `Features`."""

    def precision(self, device: torch.device) -> str:
        """Precision on the device, e.g. ``"bfloat16"``, part of cache keys; "" = float32."""
        ...


def photo_features(
    features: Features, photos: Sequence[Tensor], folder: Path, bar: Bar | None = None
) -> list[Tensor]:
    """Features [h, w, C] of every photo [H, W, 3]; call `features.fit` first.

    Cached photos are not computed again. The precision is part of the key: features of a photo and of its
    render are compared, and a different precision would add to their distance.
    """
    state = {k: _digest(v) if isinstance(v, Tensor) else v for k, v in features.state_dict().items()}
    result = []
    for photo in (bar or terminal_bar("features"))(photos):
        precision = features.precision(photo.device) if isinstance(features, PreciseFeatures) else ""
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
    bar: Bar | None = None,
) -> SceneLabels:
    """Label maps of every photo, with the scene's identities if the back end provides them.

    Args:
        instances: back end; `SceneInstances` and `NamedInstances` are used if implemented.
        photos: [H, W, 3] in [0, 1].
        names: of the photos.
        folder: of the cache; cached photos and chunks are not computed again.
        bar: progress bar; by default one on a terminal.
    """
    shown = bar or terminal_bar(f"instances ({instances.name.partition('-')[0]})")
    if isinstance(instances, SceneInstances):
        return SceneLabels(instances.identities(photos, names, folder, shown), True)
    if isinstance(instances, NamedInstances):
        return SceneLabels(instances.labels_of(photos, names), False)
    result = []
    for photo in shown(photos):
        key = cache_key("instances", instances.name, None, photo.detach().cpu().numpy())

        def compute(photo: Tensor = photo) -> dict[str, np.ndarray]:
            return {"labels": instances.labels(photo)}

        result.append(cached(folder, key, {"labels": np.int32}, compute)["labels"])
    return SceneLabels(result, False)
