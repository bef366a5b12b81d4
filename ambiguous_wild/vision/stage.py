"""The frozen stage: features and instances of all photos, each an entry of the cache, with a bar."""

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
    scene_wide: bool  # an id means the same thing in every photo


@runtime_checkable
class PreciseFeatures(Protocol):
    """Features whose precision depends on where they are computed; offered beside `Features`."""

    def precision(self, device: torch.device) -> str:
        """What is left of float32 there, e.g. ``"bfloat16"``: part of cache keys; "" = all of it."""
        ...


def photo_features(
    features: Features, photos: Sequence[Tensor], folder: Path, bar: Bar | None = None
) -> list[Tensor]:
    """Features [h, w, C] of every photo [H, W, 3]; call `features.fit` first.

    A stopped stage goes on where it was: what is in the cache is not computed again. It is kept by precision:
    features of a render are compared with those of its photo, and another precision is a distance.
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
    """Stands for a tensor in a cache key: weights as text would cost more than the features."""
    array = np.ascontiguousarray(tensor.detach().cpu().numpy())
    return f"{array.dtype}{array.shape}{hashlib.sha256(array.tobytes()).hexdigest()}"


def instance_labels(
    instances: Instances,
    photos: Sequence[Tensor],
    names: Sequence[str],
    folder: Path,
    bar: Bar | None = None,
) -> SceneLabels:
    """Label maps of every photo, with the scene's identities where the back end knows them.

    Args:
        instances: back end; `SceneInstances` and `NamedInstances` are made use of.
        photos: [H, W, 3] in [0, 1].
        names: of the photos.
        folder: of the cache; photos and chunks that are in it are not computed again.
        bar: for progress; by default one on a terminal.
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
