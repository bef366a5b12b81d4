"""Stage 0: what is frozen before the first step - features, instances, identities, psi - cached on disk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Scene
from ambiguous_wild.methods.refinesplat.association import Identities, associate
from ambiguous_wild.methods.refinesplat.config import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.identity import Psi, psi_arrays, psi_from_arrays, train_psi
from ambiguous_wild.methods.refinesplat.masking import grid_labels, instance_means
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.vision.cache import cache_key, cached
from ambiguous_wild.vision.protocols import Features, Instances


@dataclass
class FrozenInputs:
    """What the mask policy looks up by train view."""

    features: Features
    phi: list[Tensor]  # [h, w, C] of each photo
    labels: list[np.ndarray]  # [H, W] int32, 0 = none
    counts: list[int]  # K of each photo
    identities: list[Tensor]  # [h, w] int64, 0 = none: L_id's target
    grid: list[Tensor]  # [h, w] int64, instance labels on the feature grid
    static: list[np.ndarray]  # [K] bool, instances that structure from motion vouches for
    psi: Psi | None  # None where no instance has an identity
    found: Identities


def prepare(
    data: TrainData, features: Features, instances: Instances, config: RefineSplatConfig
) -> FrozenInputs:
    """Everything frozen, from the cache where it is there."""
    features.fit(data.photos)
    arrays = [photo.detach().cpu().numpy() for photo in data.photos]
    phi = [_features(data, features, i, array) for i, array in enumerate(arrays)]
    labels = [_labels(data, instances, config, i, array) for i, array in enumerate(arrays)]
    counts = [max(int(label.max(initial=0)), 0) for label in labels]
    found = associate(
        labels,
        _mean_features(phi, labels, counts),
        train_tracks(data.scene),
        min_shared=config.identity_tracks,
        min_share=config.identity_share,
        min_similarity=config.identity_similarity,
        most=config.identities,
    )
    grid, identities = [], []
    for index, label in enumerate(labels):
        cells = grid_labels(np.maximum(label, 0), *phi[index].shape[:2])
        grid.append(torch.from_numpy(cells.astype(np.int64)).to(data.device))
        ids = found.of_instance[index][cells].astype(np.int64)
        identities.append(torch.from_numpy(ids).to(data.device))
    psi = _psi(data, phi, identities, found.count, config)
    static = static_instances(labels, counts, train_tracks(data.scene), config.mask.static_tracks)
    return FrozenInputs(features, phi, labels, counts, identities, grid, static, psi, found)


def train_tracks(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """SfM observations in train views: (point [L], train index [L], xy px [L, 2])."""
    points = scene.points
    index_of = {view.name: i for i, view in enumerate(scene.train)}
    # the last entry answers view -1: observations in views outside the split
    table = np.array([index_of.get(v.name, -1) for v in scene.views] + [-1], dtype=np.int64)
    point = np.repeat(np.arange(len(points)), np.diff(points.track_offsets))
    photo = table[points.track_views]
    used = (photo >= 0) & (points.track_views >= 0)
    return point[used], photo[used], points.track_xy[used]


def static_instances(
    labels: list[np.ndarray],
    counts: list[int],
    tracks: tuple[np.ndarray, np.ndarray, np.ndarray],
    share: float,
    shortest: int = 3,
    fewest: int = 100,
) -> list[np.ndarray]:
    """Per photo [K] bool: instances with so many triangulated tracks that they cannot have moved.

    A track of three or more views that triangulates was at the same place each time. On 30 simulated photos,
    0.6 % of all observations fell on distractors that cover 19 % of the area; instances above a third of the
    photo's mean density hold 87 % of the static area and 8 % of the distractors'.

    Args:
        labels: [H, W] int32 of each photo.
        counts: K of each photo.
        tracks: from `train_tracks`.
        share: of the photo's mean density that vouches for an instance; 0 = none is vouched for.
        shortest: views a track has at least.
        fewest: observations below which a photo's density says nothing.
    """
    point, photo, xy = tracks
    long = np.bincount(point)[point] >= shortest if len(point) else np.zeros(0, bool)
    result = []
    for index, (label, count) in enumerate(zip(labels, counts)):
        here = np.floor(xy[(photo == index) & long]).astype(np.int64)
        inside = (here >= 0).all(1) & (here[:, 0] < label.shape[1]) & (here[:, 1] < label.shape[0])
        here = here[inside]
        if share <= 0 or len(here) < fewest:
            result.append(np.zeros(count, dtype=bool))
            continue
        found = np.clip(label[here[:, 1], here[:, 0]], 0, None)
        runs = np.bincount(found, minlength=count + 1)[1:]
        areas = np.bincount(np.clip(label, 0, None).ravel(), minlength=count + 1)[1:]
        result.append(runs > share * len(here) / label.size * np.maximum(areas, 1))
    return result


def _features(data: TrainData, features: Features, index: int, array: np.ndarray) -> Tensor:
    state = {k: v.tolist() if isinstance(v, Tensor) else v for k, v in features.state_dict().items()}
    key = cache_key("features", features.name, state, array)

    def compute() -> dict[str, np.ndarray]:
        with torch.no_grad():
            return {"phi": features(data.photos[index]).cpu().numpy()}

    found = cached(data.cache_dir, key, {"phi": np.float32}, compute)["phi"]
    return torch.from_numpy(found).to(data.device)


def _labels(
    data: TrainData, instances: Instances, config: RefineSplatConfig, index: int, array: np.ndarray
) -> np.ndarray:
    key = cache_key("instances", instances.name, config.segments, array)
    return cached(
        data.cache_dir, key, {"labels": np.int32}, lambda: {"labels": instances.labels(data.photos[index])}
    )["labels"]


def _mean_features(phi: list[Tensor], labels: list[np.ndarray], counts: list[int]) -> list[np.ndarray]:
    """Mean standardised feature [K, C] of every instance, unit length; zeros for labels without pixels."""
    stack = torch.cat([p.reshape(-1, p.shape[2]) for p in phi]).double()
    mean, std = stack.mean(0), stack.std(0, correction=0).clamp(min=1e-6)
    result = []
    for p, label, count in zip(phi, labels, counts):
        standard = ((p.double() - mean) / std).cpu().numpy()
        columns = [instance_means(standard[:, :, c], label, count)[0] for c in range(standard.shape[2])]
        means = np.nan_to_num(np.stack(columns, axis=1))
        result.append(means / np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1e-12))
    return result


def _psi(
    data: TrainData, phi: list[Tensor], identities: list[Tensor], count: int, config: RefineSplatConfig
) -> Psi | None:
    cells = torch.cat([p.reshape(-1, p.shape[2]) for p in phi]).cpu()
    ids = torch.cat([i.reshape(-1) for i in identities]).cpu()
    if count == 0 or not bool((ids > 0).any()):
        return None
    settings = [config.psi, config.mask.variant, data.seed, count]
    key = cache_key("psi", "psi-1", settings, cells.numpy(), ids.numpy())
    names = ["mean", "std", "first.weight", "first.bias", "last.weight", "last.bias"]

    def compute() -> dict[str, np.ndarray]:
        return psi_arrays(train_psi(cells, ids, count, config.psi, config.mask.variant, data.seed))

    return psi_from_arrays(cached(data.cache_dir, key, dict.fromkeys(names, np.float32), compute)).to(
        data.device
    )
