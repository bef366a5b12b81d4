"""What every back end of features shares: its unit of distance, and the check of its input."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.labhog import blurred_noisy_copy

_LEAST_PX = 8


@torch.no_grad()
def degraded_distance(features: Callable[[Tensor], Tensor], photos: Sequence[Tensor], most: int) -> float:
    """Mean cosine distance between photos [H, W, 3] and blurred, noisy copies of them.

    Args:
        features: of an image, [h, w, C].
        photos: of the scene.
        most: photos to use, evenly spaced.

    Raises:
        AwError: there is no photo.
    """
    if not photos:
        raise AwError("cannot fit features to a scene without training photos")
    chosen = sorted({round(k * (len(photos) - 1) / max(most - 1, 1)) for k in range(most)})
    means = []
    for index in chosen:
        one, two = features(photos[index]), features(blurred_noisy_copy(photos[index], index))
        means.append((1.0 - F.cosine_similarity(one, two, dim=2)).double().mean().item())
    # rounded, because it is part of cache keys and its last bits depend on the number of threads
    return float(f"{max(sum(means) / len(means), 1e-6):.4g}")


def check_image(image: Tensor) -> None:
    """Raise AwError where the image is not [H, W, 3] or smaller than 8 px."""
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < _LEAST_PX:
        raise AwError(f"features need an image of [H, W, 3], at least 8x8 px, got {list(image.shape)}")


def whole_cells(image: Tensor, rows: int, columns: int, cell: int) -> Tensor:
    """The image [H, W, 3] as [1, 3, rows * cell, columns * cell], resized if needed."""
    pixels = image.permute(2, 0, 1)[None]
    size = (rows * cell, columns * cell)
    if size == tuple(image.shape[:2]):
        return pixels
    return F.interpolate(pixels, size=size, mode="bilinear", align_corners=False, antialias=True)


def cell_grid(height: int, width: int, size: int, cell: int) -> tuple[int, int]:
    """Rows and columns of cells for an image whose longer side is resized to `size` px; 0 = not resized."""
    scale = size / max(height, width) if size else 1.0
    return max(round(height * scale / cell), 1), max(round(width * scale / cell), 1)
