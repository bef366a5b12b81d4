"""Interfaces that methods use: dense frozen features, instance labels of photos; and what back ends share."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import State
from ambiguous_wild.io.progress_bar import Progress

_MIN_PX = 8
_BLUR_PX, _NOISE = 1.5, 0.02  # blur and noise of the copies that set units and weights of features


class Features(ABC):
    """Dense features of an image, frozen after `fit`, differentiable in the image."""

    name: str  # part of every cache key
    channels: int  # C
    unit = 0.1  # mean cosine distance that blur and noise alone cause; set by `fit`
    fit_photos = 8  # photos that `fit` uses

    @abstractmethod
    def __call__(self, image: Tensor) -> Tensor:
        """Features [h, w, C] float32 of an sRGB image [H, W, 3] float32 in [0, 1]."""

    def fit(self, photos: Sequence[Tensor]) -> None:
        """Measure statistics of the scene on the training photos [H, W, 3], without ground truth.

        By default that is `unit` alone, see `degraded_distance`.

        Raises:
            AwError: there is no photo.
        """
        self.unit = degraded_distance(self, photos, self.fit_photos)

    def precision(self, device: torch.device) -> str:
        """Precision on the device, e.g. ``"bfloat16"``, part of cache keys; "" = float32."""
        return ""

    def state_dict(self) -> State:
        return {"unit": self.unit}

    def load_state_dict(self, state: State) -> None:
        self.unit = float(state["unit"])


class Instances(Protocol):
    """Instance label maps of photos."""

    name: str  # part of every cache key

    def labels(self, photo: Tensor) -> np.ndarray:
        """Labels [H, W] int32 of a photo [H, W, 3] float32 in [0, 1]; 0 = none, instances from 1."""
        ...


@runtime_checkable
class SceneInstances(Protocol):
    """Instances with one id per object over all photos; optional, in addition to `Instances`.

    The ids are used as the scene's identities, without association.
    """

    name: str

    def identities(
        self,
        photos: Sequence[Tensor],
        names: Sequence[str],
        folder: Path | None = None,
        progress: Progress = iter,
    ) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, one id per object of the scene; 0 = none, gaps allowed.

        Args:
            photos: [H, W, 3] float32 in [0, 1].
            names: names of the photos, with a suffix; their natural order is the order of a sequence.
            folder: the cache (`vision.precompute`), from which a stopped stage resumes.
            progress: wraps the list of items, for a progress bar.
        """
        ...


def evenly_spaced_indices(count: int, most: int) -> list[int]:
    """Return indices of `most` of `count` training photos, evenly spaced; of all if there are fewer.

    Raises:
        AwError: there is no photo.
    """
    if not count:
        raise AwError("cannot fit features to a scene without training photos")
    return sorted({round(k * (count - 1) / max(most - 1, 1)) for k in range(most)})


def blurred_noisy_copy(photo: Tensor, seed: int) -> Tensor:
    """Blur the photo and add noise, so that it resembles a good render of it."""
    blurred = gaussian_blur(photo.permute(2, 0, 1), _BLUR_PX).permute(1, 2, 0)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(photo.shape, generator=generator).to(photo.device) * _NOISE
    return (blurred + noise).clamp(0.0, 1.0)


def gaussian_blur(maps: Tensor, sigma: float) -> Tensor:
    """Gaussian blur of [C, H, W], `sigma` in px; border pixels are repeated."""
    radius = max(math.ceil(3.0 * sigma), 1)
    taps = torch.arange(-radius, radius + 1, dtype=maps.dtype, device=maps.device)
    kernel = torch.exp(-0.5 * (taps / sigma) ** 2)
    kernel = kernel / kernel.sum()
    padded = F.pad(maps[:, None], (radius, radius, radius, radius), mode="replicate")
    return F.conv2d(F.conv2d(padded, kernel.reshape(1, 1, 1, -1)), kernel.reshape(1, 1, -1, 1))[:, 0]


@torch.no_grad()
def degraded_distance(features: Callable[[Tensor], Tensor], photos: Sequence[Tensor], most: int) -> float:
    """Mean cosine distance between photos [H, W, 3] and blurred, noisy copies of them.

    Args:
        features: computes the features [h, w, C] of an image.
        photos: the scene's photos.
        most: number of photos to use, evenly spaced.

    Raises:
        AwError: there is no photo.
    """
    means = []
    for index in evenly_spaced_indices(len(photos), most):
        one, two = features(photos[index]), features(blurred_noisy_copy(photos[index], index))
        means.append((1.0 - F.cosine_similarity(one, two, dim=2)).double().mean().item())
    # rounded, because it is part of cache keys and its last bits depend on the number of threads
    return float(f"{max(sum(means) / len(means), 1e-6):.4g}")


def check_sizes(name: str, size: int, cell: int, fit_photos: int) -> None:
    """Raise AwError for a size in px below one cell (0 = the image's), or for no photos to fit."""
    if size < 0 or 0 < size < cell or fit_photos < 1:
        raise AwError(
            f"{name}: size must be 0 or at least one cell of {cell} px and fit_photos at least 1, "
            f"got {size} and {fit_photos}"
        )


def check_image(image: Tensor) -> None:
    """Raise AwError if the image is not [H, W, 3] or smaller than 8 px."""
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < _MIN_PX:
        raise AwError(f"features need an image of [H, W, 3], at least 8x8 px, got {list(image.shape)}")


def whole_cells(image: Tensor, rows: int, columns: int, cell: int) -> Tensor:
    """Convert an image [H, W, 3] to [1, 3, rows * cell, columns * cell], resized if needed."""
    pixels = image.permute(2, 0, 1)[None]
    size = (rows * cell, columns * cell)
    if size == tuple(image.shape[:2]):
        return pixels
    return F.interpolate(pixels, size=size, mode="bilinear", align_corners=False, antialias=True)


def cell_grid(height: int, width: int, size: int, cell: int) -> tuple[int, int]:
    """Return rows and columns of cells of an image, its longer side resized to `size` px; 0 = not resized."""
    scale = size / max(height, width) if size else 1.0
    return max(round(height * scale / cell), 1), max(round(width * scale / cell), 1)
