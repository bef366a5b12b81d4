"""What the methods ask of vision: dense frozen features and per-photo instance labels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
from torch import Tensor


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


class Instances(Protocol):
    """Instance label maps of photos."""

    name: str  # part of every cache key

    def labels(self, photo: Tensor) -> np.ndarray:
        """Labels [H, W] int32 of a photo [H, W, 3] float32 in [0, 1]; 0 = none, instances from 1."""
        ...
