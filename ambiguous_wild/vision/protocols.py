"""Interfaces that methods use: dense frozen features and per-photo instance labels."""

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
    unit: float  # mean cosine distance that blur and noise alone cause; set by `fit`

    def fit(self, photos: Sequence[Tensor]) -> None:
        """Measure statistics of the scene on the training photos [H, W, 3], without ground truth."""
        ...

    def __call__(self, image: Tensor) -> Tensor:
        """Features [h, w, C] float32 of an sRGB image [H, W, 3] float32 in [0, 1]."""
        ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...


@runtime_checkable
class SceneFeatures(Protocol):
    """Features that are trained on the scene: call `fit_scene` in place of `fit` the first time."""

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
    """Instances that are found by the photo's name; optional, in addition to `Instances`."""

    name: str

    def labels_of(self, photos: Sequence[Tensor], names: Sequence[str]) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, with ids per photo; 0 = none."""
        ...


@runtime_checkable
class PromptedInstances(Protocol):
    """Instances at given points; optional, in addition to `Instances`."""

    name: str

    def at_points(self, photo: Tensor, groups: Sequence[np.ndarray], outside: np.ndarray) -> np.ndarray:
        """Mask [n, H, W] bool of the instance under each group of points [k, 2] px, not under `outside`."""
        ...


@runtime_checkable
class SceneInstances(Protocol):
    """Instances with one id per object over all photos; optional, in addition to `Instances`.

    The ids are used as the scene's identities, without association.
    """

    name: str

    def identities(
        self, photos: Sequence[Tensor], names: Sequence[str], folder: Path | None = None, bar: Bar = no_bar
    ) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, one id per object of the scene; 0 = none, gaps allowed.

        Args:
            photos: [H, W, 3] float32 in [0, 1].
            names: of the photos, with a suffix; their natural order is the order of a sequence.
            folder: of the cache (`vision.cache`), from which a stopped stage resumes.
            bar: wraps the list of items, for a progress bar.
        """
        ...
