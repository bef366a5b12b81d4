"""Shapes filled with texture of the scene, so that they have its colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.simulate.composite.cutouts import SMALLEST_PX, Cutout, filled
from ambiguous_wild.simulate.composite.placement import CompositeConfig, VisiblePoints

_LARGEST = 0.6  # of the photo's sides: largest window


def cut_patches(
    shapes: Sequence[Cutout],
    sites: Sequence[VisiblePoints],
    pictures: Mapping[str, Path],
    config: CompositeConfig,
    rng: np.random.Generator,
) -> tuple[list[Cutout], dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Fill every shape from a window of a train photo, about as large as the shape will appear.

    Args:
        shapes: cut-outs; only their alpha is used.
        sites: from `visible_points`; windows are cut from their photos.
        pictures: view name -> its largest image file.
        config: coverage and presence, which give the size.
        rng: source of randomness.

    Returns:
        The patches; by index the mean CIELAB colour [3]; by index the world position of the window [3].
    """
    patches, colours, origins = [], {}, {}
    for k, shape in enumerate(shapes):
        site = sites[int(rng.integers(len(sites)))]
        photo = read_png_rgb(pictures[site.view.name])
        height, width = _window(shape, photo.shape, config, len(shapes))
        top = int(rng.integers(0, photo.shape[0] - height + 1))
        left = int(rng.integers(0, photo.shape[1] - width + 1))
        patches.append(filled(shape, photo, (top, left), (height, width)))
        window = photo[top : top + height, left : left + width].astype(np.float32) / 255
        colours[k] = cv2.cvtColor(window, cv2.COLOR_RGB2LAB).reshape(-1, 3).mean(0)
        camera = site.view.camera
        scale = np.array([camera.width / photo.shape[1], camera.height / photo.shape[0]])
        middle = np.array([left + width / 2, top + height / 2]) * scale
        origins[k] = site.xyz[np.linalg.norm(site.uv - middle, axis=1).argmin()]
    return patches, colours, origins


def _window(shape: Cutout, photo: tuple[int, ...], config: CompositeConfig, count: int) -> tuple[int, int]:
    """Height and width of the window, px: the area that one of `count` patches will cover."""
    area = config.coverage * photo[0] * photo[1] / (count * config.presence)
    height = np.sqrt(area / (shape.aspect * shape.filled))
    shrink = min(1.0, _LARGEST * photo[0] / height, _LARGEST * photo[1] / (height * shape.aspect))
    height = height * shrink
    sides = max(SMALLEST_PX, round(height)), max(SMALLEST_PX, round(height * shape.aspect))
    return min(sides[0], photo[0]), min(sides[1], photo[1])
