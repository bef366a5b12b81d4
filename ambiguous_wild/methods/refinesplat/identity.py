"""Identities: instances of different photos that are one object, and psi, their frozen classifier (stage 0).

psi is trained once on the features of the photos. The paper takes ids from a video tracker. Unordered photos
have none, so instances are associated by the SfM tracks that run through them, then by their mean features.
Two instances of one photo never merge.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy import sparse
from torch import Tensor, nn

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.refinesplat.threshold import Variant

MAX_IDENTITIES = 255


@dataclass(frozen=True)
class Identities:
    """Identity of every instance of every photo, 1..count; 0 = none."""

    of_instance: list[np.ndarray]  # per photo [K + 1] int32, index = label; entry 0 is 0
    count: int  # P
    photos_of: np.ndarray  # [P] int32, number of photos with each identity


def associate(
    labels: Sequence[np.ndarray],  # per photo [H, W] int32, 0 = none
    means: Sequence[np.ndarray],  # per photo [K, C] float, mean feature of each instance, unit length
    tracks: tuple[np.ndarray, np.ndarray, np.ndarray],  # point, photo, xy of each observation
    *,
    min_shared: int = 3,
    min_share: float = 0.25,
    min_similarity: float = 0.8,
    most: int = MAX_IDENTITIES,
) -> Identities:
    """Merge instances of different photos into identities.

    Args:
        labels: instance labels; gaps are allowed, negative labels count as none.
        means: mean feature of labels 1..K.
        tracks: (point [L] int64, photo [L] int32, xy [L, 2] px), observations of SfM points.
        min_shared: tracks that must run through both instances.
        min_share: least share of these in the tracks of the instance that has fewer.
        min_similarity: least cosine of mean features for instances that tracks do not join.
        most: largest number of identities; those in most photos are kept, then large ones.
    """
    counts = [max(int(label.max(initial=0)), 0) for label in labels]
    offsets = np.r_[0, np.cumsum(counts)]
    total = int(offsets[-1])
    if total == 0:
        return Identities([np.zeros(1, np.int32) for _ in labels], 0, np.zeros(0, np.int32))
    photo_of = np.repeat(np.arange(len(labels)), counts)
    groups = _Groups(photo_of)
    for i, j in _track_pairs(labels, offsets, tracks, min_shared, min_share):
        groups.join(int(i), int(j))
    features = np.concatenate([np.asarray(m, dtype=np.float64) for m in means])
    _join_by_features(groups, features, min_similarity)

    areas = np.concatenate(
        [np.bincount(np.maximum(x, 0).ravel(), minlength=k + 1)[1:] for x, k in zip(labels, counts)]
    )
    roots = np.array([groups.root(i) for i in range(total)])
    unique, inverse = np.unique(roots, return_inverse=True)
    photos = np.bincount(inverse, weights=areas > 0).astype(np.int64)  # at most one instance in a photo
    size = np.bincount(inverse, weights=areas)
    order = np.lexsort((np.arange(len(unique)), -size, -photos))[:most]
    order = order[photos[order] > 0]
    rank = np.zeros(len(unique), dtype=np.int32)
    rank[order] = np.arange(1, len(order) + 1)
    flat = np.where(areas > 0, rank[inverse], 0).astype(np.int32)
    per_photo = [np.r_[np.int32(0), flat[a:b]].astype(np.int32) for a, b in itertools.pairwise(offsets)]
    return Identities(per_photo, len(order), photos[order].astype(np.int32))


def _track_pairs(
    labels: Sequence[np.ndarray],
    offsets: np.ndarray,
    tracks: tuple[np.ndarray, np.ndarray, np.ndarray],
    min_shared: int,
    min_share: float,
) -> np.ndarray:
    """Return pairs of instances [n, 2] that tracks join, the surest first."""
    point, photo, xy = tracks
    instance = np.full(len(point), -1, dtype=np.int64)
    for index, label in enumerate(labels):
        in_photo = np.flatnonzero(photo == index)
        column = np.floor(xy[in_photo, 0]).astype(np.int64)
        row = np.floor(xy[in_photo, 1]).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < label.shape[1]) & (row < label.shape[0])
        at_track = label[row[inside], column[inside]]
        instance[in_photo[inside]] = np.where(at_track > 0, offsets[index] + at_track - 1, -1)
    used = instance >= 0
    if not used.any():
        return np.zeros((0, 2), dtype=np.int64)
    _, rows = np.unique(point[used], return_inverse=True)
    shape = (int(rows.max()) + 1, int(offsets[-1]))
    incidence = sparse.coo_matrix((np.ones(len(rows)), (rows, instance[used])), shape=shape).tocsr()
    incidence.data[:] = 1.0  # a track that crosses an instance twice counts once
    shared = sparse.triu(incidence.T @ incidence, k=1).tocoo()
    runs = np.asarray(incidence.sum(0)).ravel()
    share = shared.data / np.minimum(runs[shared.row], runs[shared.col])
    keep = (shared.data >= min_shared) & (share >= min_share)
    pairs = np.stack([shared.row[keep], shared.col[keep]], axis=1).astype(np.int64)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], -shared.data[keep], -share[keep]))
    return pairs[order]


def _join_by_features(groups: _Groups, features: np.ndarray, min_similarity: float) -> None:
    """Join instances without shared tracks to the most similar group that has no instance of their photo."""
    alone = [i for i in range(len(features)) if groups.size(i) == 1]
    norms = np.linalg.norm(features, axis=1, keepdims=True)
    unit = features / np.maximum(norms, 1e-12)
    for i in alone:
        similarity = unit @ unit[i]
        for j in np.argsort(-similarity, kind="stable")[:12]:
            if similarity[j] < min_similarity:
                break
            if j != i and groups.join(i, int(j)):
                break


class _Groups:
    """Union-find that refuses to join groups which share a photo."""

    def __init__(self, photo_of: np.ndarray) -> None:
        self.parent = list(range(len(photo_of)))
        self.photos = [1 << int(p) for p in photo_of]  # a bit per photo

    def root(self, i: int) -> int:
        while self.parent[i] != i:
            self.parent[i] = self.parent[self.parent[i]]
            i = self.parent[i]
        return i

    def size(self, i: int) -> int:
        return self.photos[self.root(i)].bit_count()

    def join(self, i: int, j: int) -> bool:
        a, b = self.root(i), self.root(j)
        if a == b:
            return True
        if self.photos[a] & self.photos[b]:
            return False
        low, high = min(a, b), max(a, b)
        self.parent[high] = low
        self.photos[low] |= self.photos[high]
        return True


@dataclass(frozen=True)
class PsiConfig:
    """psi's size and training. The paper states neither."""

    hidden: int = 64  # units of the one hidden layer
    steps: int = 1000  # Adam steps
    batch: int = 1024  # cells a step
    rate: float = 3e-3  # learning rate, decayed to a tenth by a cosine

    def __post_init__(self) -> None:
        whole = (1, math.inf)
        check_limits(self, "refinesplat.psi", hidden=whole, steps=whole, batch=whole, rate=(1e-9, math.inf))


class Psi(nn.Module):
    """Maps features [..., C] to identity logits [..., P]: standardise, Linear, ReLU, Linear."""

    mean: Tensor
    std: Tensor

    def __init__(self, channels: int, hidden: int, identities: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("std", torch.ones(channels))
        self.first = nn.Linear(channels, hidden)
        self.last = nn.Linear(hidden, identities)

    def forward(self, features: Tensor) -> Tensor:
        standard = (features - self.mean) / self.std
        return self.last(torch.relu(self.first(standard)))


def train_psi(
    features: Tensor,  # [n, C] cells of all photos
    identities: Tensor,  # [n] int64, 0 = none
    count: int,  # P
    config: PsiConfig,
    variant: Variant,
    seed: int,
) -> Psi:
    """Train psi and freeze it.

    With `sigmoid` the loss is binary cross-entropy, one against rest, and cells without identity count as
    rest for all. With `softmax` it is cross-entropy over cells with an identity.

    Raises:
        AwError: no cell has an identity, or the count is not from 1 to 255.
    """
    if not 1 <= count <= 255 or not bool((identities > 0).any()):
        raise AwError(f"psi needs 1 to 255 identities with cells, got {count}: check the instance masks")
    if variant == "softmax":
        features, identities = features[identities > 0], identities[identities > 0]
    generator = torch.Generator().manual_seed(seed)
    psi = Psi(features.shape[1], config.hidden, count)
    with torch.no_grad():
        psi.mean.copy_(features.double().mean(0).float())
        psi.std.copy_(features.double().std(0, correction=0).float().clamp(min=1e-6))
        for layer in (psi.first, psi.last):
            bound = layer.in_features**-0.5
            layer.weight.uniform_(-bound, bound, generator=generator)
            layer.bias.zero_()
        if variant == "sigmoid":
            psi.last.bias.fill_(-3.0)  # most identities are absent from most cells
    optimiser = torch.optim.Adam(psi.parameters(), lr=config.rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, config.steps, config.rate / 10)
    for _ in range(config.steps):
        rows = torch.randint(len(features), (config.batch,), generator=generator)
        loss = _loss(psi(features[rows]), identities[rows], variant)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return psi.requires_grad_(False).eval()


def _loss(logits: Tensor, identities: Tensor, variant: Variant) -> Tensor:
    if variant == "softmax":
        return F.cross_entropy(logits, identities - 1)
    # binary cross-entropy, cells of no identity included: sum_k softplus(E_k), minus the target's logit
    target = logits.gather(1, (identities - 1).clamp(min=0)[:, None])[:, 0]
    return (F.softplus(logits).sum(1) - target * (identities > 0)).mean()


def psi_from_arrays(arrays: dict[str, np.ndarray]) -> Psi:
    """Restore psi from the arrays of its `state_dict`, frozen."""
    hidden, channels = arrays["first.weight"].shape
    psi = Psi(channels, hidden, arrays["last.weight"].shape[0])
    psi.load_state_dict({name: torch.from_numpy(array) for name, array in arrays.items()})
    return psi.requires_grad_(False).eval()
