"""Fewer Gaussians for a page: those that can cover most of the photos stay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ambiguous_wild.core import Camera
from ambiguous_wild.io.splat_formats.arrays import finite, sigmoid

_NEAR = 0.01  # as in training
_MARGIN = 0.15  # of the picture on each side still counts


def reduced(
    gaussians: Mapping[str, np.ndarray], cameras: Sequence[Camera], most: int
) -> dict[str, np.ndarray]:
    """At most so many Gaussians: the ones with the largest opacity times projected area, summed over cameras.

    A Gaussian's area in one camera counts up to a hundredth of the picture, so that a few large ones in the
    background do not displace all detail. Order is kept.

    Args:
        gaussians: raw parameters.
        cameras: of the photos.
        most: Gaussians to keep.
    """
    kept = finite(gaussians)
    if len(kept["means"]) <= most:
        return kept
    score = importance(kept, cameras)
    rows = np.sort(np.argsort(-score, kind="stable")[:most])
    return {name: value[rows] for name, value in kept.items()}


def importance(gaussians: Mapping[str, np.ndarray], cameras: Sequence[Camera]) -> np.ndarray:
    """Opacity times projected area in px, summed over cameras; [N] float64."""
    means = gaussians["means"].astype(np.float64)
    scales = np.sort(np.exp(gaussians["log_scales"].astype(np.float64)), axis=1)
    area = np.pi * scales[:, 1] * scales[:, 2]  # of the two longest axes, world units squared
    total = np.zeros(len(means))
    for camera in cameras:
        seen = means @ camera.cam_from_world[:3, :3].T + camera.cam_from_world[:3, 3]
        depth = np.where(seen[:, 2] > _NEAR, seen[:, 2], np.inf)
        u, v = camera.fx * seen[:, 0] / depth + camera.cx, camera.fy * seen[:, 1] / depth + camera.cy
        inside = (np.abs(u / camera.width - 0.5) < 0.5 + _MARGIN) & (
            np.abs(v / camera.height - 0.5) < 0.5 + _MARGIN
        )
        covered = area * camera.fx * camera.fy / depth**2
        total += np.where(inside, np.minimum(covered, 0.01 * camera.width * camera.height), 0.0)
    return total * sigmoid(gaussians["opacity_logits"])
