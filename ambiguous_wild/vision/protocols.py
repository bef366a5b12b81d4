"""What the methods ask of vision: dense frozen features and per-photo instance labels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from torch import Tensor

from ambiguous_wild.vision.progress import Bar, no_bar


class Features(Protocol):
    """Dense features of an image, frozen after `fit`, differentiable in the image."""

    name: str  # part of every cache key
    channels: int  # C
    unit: float  # cosine distance that blur and noise alone make, mean over the scene; set by `fit`

    def fit(self, photos: Sequence[Tensor]) -> None:
        """Measure per-scene statistics on the training photos [H, W, 3]; no truth is used."""
        ...

    def __call__(self, image: Tensor) -> Tensor:
        """Features [h, w, C] float32 of an sRGB image [H, W, 3] float32 in [0, 1]."""
        ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


@runtime_checkable
class SceneFeatures(Protocol):
    """Features that learn from the scene: `fit_scene` takes the place of `fit` the first time."""

    def fit_scene(
        self,
        photos: Sequence[Tensor],
        tracks: tuple[np.ndarray, np.ndarray, np.ndarray],
        folder: Path | None = None,
    ) -> None:
        """Train on photos [H, W, 3] and SfM observations: point [L], photo [L], xy px [L, 2]."""
        ...


class Instances(Protocol):
    """Instance label maps of photos."""

    name: str  # part of every cache key

    def labels(self, photo: Tensor) -> np.ndarray:
        """Labels [H, W] int32 of a photo [H, W, 3] float32 in [0, 1]; 0 = none, instances from 1."""
        ...


@runtime_checkable
class NamedInstances(Protocol):
    """Instances that are found by the photo's name; a back end offers this beside `Instances`."""

    name: str

    def labels_of(self, photos: Sequence[Tensor], names: Sequence[str]) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, each with ids of its own; 0 = none."""
        ...


@runtime_checkable
class SceneInstances(Protocol):
    """Instances that know what is the same thing in different photos; offered beside `Instances`.

    Where a back end has this, its ids are the scene's identities and nothing is associated.
    """

    name: str

    def identities(
        self, photos: Sequence[Tensor], names: Sequence[str], folder: Path | None = None, bar: Bar = no_bar
    ) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, one id for one thing in the scene; 0 = none, gaps allowed.

        Args:
            photos: [H, W, 3] float32 in [0, 1].
            names: of the photos, with a suffix; their natural order is the order of a sequence.
            folder: of the cache (`vision.cache`), for what a stopped stage shall not do again.
            bar: wraps a list of what is gone through.
        """
        ...
