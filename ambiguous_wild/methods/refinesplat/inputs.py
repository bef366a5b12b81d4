"""Stage 0: the frozen inputs - features, instances, identities, psi - which are cached on disk."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Scene
from ambiguous_wild.methods.masking_common import nearest
from ambiguous_wild.methods.refinesplat.hyperparameters import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.identity import (
    Identities,
    Psi,
    associate,
    psi_from_arrays,
    train_psi,
)
from ambiguous_wild.methods.refinesplat.masks import instance_means, label_dtype
from ambiguous_wild.splat.cpu.compile import threads
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.vision.mask_ops import add_untracked
from ambiguous_wild.vision.precompute import cache_key, cached, instance_labels, photo_features
from ambiguous_wild.vision.protocols import Features, Instances
from ambiguous_wild.vision.sceneconv import SceneConv

SHORTEST = 3  # views of a track at least
FEWEST = 100  # observations that a photo needs to be judged


@dataclass(frozen=True)
class Semantics:
    """Inputs and outputs of psi, by train view."""

    phi: list[Tensor]  # [h, w, C] of each photo
    identities: list[Tensor]  # [h, w] int64, 0 = none: L_id's target
    grid: list[Tensor]  # [h, w] int64, instance labels on the feature grid
    psi: Psi | None  # None if no instance has an identity
    association: Identities


class FrozenInputs:
    """Frozen inputs of the mask policy by train view; features and identities are computed at first use."""

    def __init__(
        self, data: TrainData, features: Features, instances: Instances, config: RefineSplatConfig
    ) -> None:
        self._data, self.features, self._config = data, features, config
        names = [view.name for view in data.scene.train]
        segmented = instance_labels(instances, data.photos, names, data.cache_dir, threads())
        self._scene_wide = segmented.scene_wide
        own = segmented.labels
        # ids of a whole scene have gaps in a photo: labels count from 1, and `_ids` holds their ids
        compact = [_compact(label) for label in own] if segmented.scene_wide else []
        self.labels = [label for label, _ in compact] if compact else own  # [H, W] int, 0 = none
        self._ids = [ids for _, ids in compact]
        # [H, W] int32 of each photo: instances that a tracker left out, with labels above its own
        self._added: list[np.ndarray] = []
        single: Instances | None = getattr(instances, "single", None)  # a tracker's back end for one photo
        if segmented.scene_wide and single is not None and config.untracked == "add":
            everything = instance_labels(single, data.photos, names, data.cache_dir).labels
            self._added = [
                untracked_instances(label, all_found) for label, all_found in zip(self.labels, everything)
            ]
            self.labels = [np.maximum(label, added) for label, added in zip(self.labels, self._added)]
        self.counts = [max(int(label.max(initial=0)), 0) for label in self.labels]  # K of each photo
        kind = label_dtype(max(self.counts, default=0))
        self.labels = [np.maximum(label, 0).astype(kind) for label in self.labels]
        # [K] bool of each photo: instances that structure from motion shows to be static
        self.static = static_instances(
            self.labels, self.counts, train_tracks(data.scene), config.mask.static_tracks
        )

    @property
    def has_semantics(self) -> bool:
        """Whether features and identities were computed yet."""
        return "semantics" in self.__dict__

    @functools.cached_property
    def semantics(self) -> Semantics:
        data, config = self._data, self._config
        if isinstance(self.features, SceneConv):
            self.features.fit_scene(data.photos, train_tracks(data.scene), data.cache_dir)
        else:
            self.features.fit(data.photos)
        phi = photo_features(self.features, data.photos, data.cache_dir)
        association = self._identities(phi)
        grid, identities = [], []
        for index, label in enumerate(self.labels):
            cells = nearest(torch.from_numpy(np.maximum(label, 0)), *phi[index].shape[:2]).numpy()
            grid.append(torch.from_numpy(cells.astype(np.int64)).to(data.device))
            ids = association.of_instance[index][cells].astype(np.int64)
            identities.append(torch.from_numpy(ids).to(data.device))
        with torch.enable_grad():  # the first access may be inside of no_grad
            psi = _psi(data, phi, identities, association.count, config)
        return Semantics(phi, identities, grid, psi, association)

    def _identities(self, phi: list[Tensor]) -> Identities:
        """Take identities from the back end's ids, else associate by SfM tracks, then by features."""
        config = self._config
        if not self._scene_wide:
            return self._associated(phi, self.labels, config.identities)
        tracked = identities_by_photos(self._ids, config.identities)
        room = config.identities - tracked.count
        if not self._added or room <= 0:
            return _with_unknown(tracked, self.counts)
        return _joined(tracked, self._associated(phi, self._added, room), self.counts)

    def _associated(self, phi: list[Tensor], labels: list[np.ndarray], most: int) -> Identities:
        config = self._config
        return associate(
            labels,
            _mean_features(phi, labels, [max(int(label.max(initial=0)), 0) for label in labels]),
            train_tracks(self._data.scene),
            min_shared=config.identity_tracks,
            min_share=config.identity_share,
            min_similarity=config.identity_similarity,
            most=most,
        )


def untracked_instances(tracked: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Return labels [H, W] int32, above the tracker's own, of the instances that a tracker leaves out.

    Trackers follow only the largest instances (`SamVideoConfig.most`).

    Args:
        tracked: [H, W] int32, the tracker's labels of the photo, 1..K; 0 = none.
        found: [H, W] int32, all instances of the photo.
    """
    # the largest first; an instance is new unless the tracked ones cover half of it
    total = int(np.count_nonzero(np.bincount(np.maximum(found, 0).ravel())))
    most = len(np.unique(tracked[tracked > 0])) + total
    both, _ = add_untracked(tracked, found, int(tracked.max(initial=0)) + 1, most)
    return np.where(tracked > 0, 0, both).astype(np.int32)


def _with_unknown(identities: Identities, counts: list[int]) -> Identities:
    """Extend identities by 0 (none) for further labels up to `counts`."""
    rows = [
        np.r_[row, np.zeros(count + 1 - len(row), np.int32)].astype(np.int32)
        for row, count in zip(identities.of_instance, counts)
    ]
    return Identities(rows, identities.count, identities.photos_of)


def _joined(first: Identities, second: Identities, counts: list[int]) -> Identities:
    """Join the identities of tracked labels and those of labels that were added above them."""
    rows = []
    for a, b in zip(_with_unknown(first, counts).of_instance, _with_unknown(second, counts).of_instance):
        rows.append(np.where(b > 0, b + first.count, a).astype(np.int32))
    return Identities(
        rows, first.count + second.count, np.r_[first.photos_of, second.photos_of].astype(np.int32)
    )


def _compact(label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return labels counted from 1 [H, W], and the id of each [K]."""
    ids = np.unique(label[label > 0])
    return np.where(label > 0, np.searchsorted(ids, label) + 1, 0).astype(np.int32), ids


def identities_by_photos(ids: list[np.ndarray], most: int) -> Identities:
    """Return identities 1..P from scene-wide ids of each photo; those in most photos are kept."""
    every = np.concatenate([np.zeros(0, np.int64), *ids])
    unique, photos = np.unique(every, return_counts=True)
    order = np.lexsort((unique, -photos))[:most]
    rank = np.zeros(len(unique), dtype=np.int32)
    rank[order] = np.arange(1, len(order) + 1)
    of_instance = [np.r_[np.int32(0), rank[np.searchsorted(unique, i)]].astype(np.int32) for i in ids]
    return Identities(of_instance, len(order), photos[order].astype(np.int32))


def train_tracks(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return SfM observations in train views: point [L], train index [L], xy in px [L, 2]."""
    points = scene.points
    index_of = {view.name: i for i, view in enumerate(scene.train)}
    # the last entry is for view -1: observations in views outside the split
    table = np.array([index_of.get(v.name, -1) for v in scene.views] + [-1], dtype=np.int64)
    photo = table[points.track_views]
    used = (photo >= 0) & (points.track_views >= 0)
    return points.owners[used], photo[used], points.track_xy[used]


def static_instances(
    labels: list[np.ndarray],
    counts: list[int],
    tracks: tuple[np.ndarray, np.ndarray, np.ndarray],
    share: float,
) -> list[np.ndarray]:
    """Return for each photo the instances [K] bool with too many triangulated tracks to have moved.

    A track of three or more views that triangulates was at the same place in all of them. On 30 simulated
    photos, 0.6 % of all observations fell on distractors that cover 19 % of the area; instances above a third
    of the photo's mean density hold 87 % of the static area and 8 % of the distractors'.

    Args:
        labels: [H, W] int32 of each photo.
        counts: K of each photo.
        tracks: from `train_tracks`.
        share: share of the photo's mean density from which an instance is static; 0 = none is.
    """
    point, photo, xy = tracks
    long = np.bincount(point)[point] >= SHORTEST if len(point) else np.zeros(0, bool)
    result = []
    for index, (label, count) in enumerate(zip(labels, counts)):
        at = np.floor(xy[(photo == index) & long]).astype(np.int64)
        inside = (at >= 0).all(1) & (at[:, 0] < label.shape[1]) & (at[:, 1] < label.shape[0])
        at = at[inside]
        if share <= 0 or len(at) < FEWEST:
            result.append(np.zeros(count, dtype=bool))
            continue
        hit = np.clip(label[at[:, 1], at[:, 0]], 0, None)
        runs = np.bincount(hit, minlength=count + 1)[1:]
        areas = np.bincount(np.clip(label, 0, None).ravel(), minlength=count + 1)[1:]
        result.append(runs > share * len(at) / label.size * np.maximum(areas, 1))
    return result


def _mean_features(phi: list[Tensor], labels: list[np.ndarray], counts: list[int]) -> list[np.ndarray]:
    """Return the mean standardised feature [K, C] of every instance, unit length; zeros without pixels."""
    stack = torch.cat([p.reshape(-1, p.shape[2]) for p in phi]).double()
    mean, std = stack.mean(0), stack.std(0, correction=0).clamp(min=1e-6)
    result = []
    for p, label, count in zip(phi, labels, counts):
        standard, on_host = ((p.double() - mean) / std).cpu(), torch.from_numpy(label)
        columns = [instance_means(channel, on_host, count)[0] for channel in standard.unbind(2)]
        means = torch.stack(columns, 1).nan_to_num_().numpy()
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
        psi = train_psi(cells, ids, count, config.psi, config.mask.variant, data.seed)
        return {name: tensor.cpu().numpy() for name, tensor in psi.state_dict().items()}

    return psi_from_arrays(cached(data.cache_dir, key, dict.fromkeys(names, np.float32), compute)).to(
        data.device
    )
