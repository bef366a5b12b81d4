"""Lens distortion, rolling shutter and motion blur in one resampling.

The pinhole image is traced larger than the photo, and finer by a whole factor; each fine pixel of the photo
is looked up in it. All weights are non-negative, so a mask resampled with them is positive exactly where
masked pixels contribute.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.core.errors import AwError

_MAX_BORDER = 2  # greatest border, in longer sides of the photo


def fine_points(camera: Camera, fine: int) -> np.ndarray:
    """Normalised coordinates [H fine, W fine, 2] of the photo's fine pixels."""
    u = ((np.arange(camera.width * fine) + 0.5) / fine - camera.cx) / camera.fx
    v = ((np.arange(camera.height * fine) + 0.5) / fine - camera.cy) / camera.fy
    return np.stack(np.meshgrid(u, v), axis=-1)


def turned(points: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """The points in the camera before it turned.

    Args:
        points: [H, W, 2] normalised, of the turned camera.
        turns: [H, 3] rotation vector of each row, camera axes.

    Returns:
        [H, W, 2] normalised.
    """
    rays = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1)
    rays = rays @ Rotation.from_rotvec(turns).as_matrix().transpose(0, 2, 1)
    if not (rays[..., 2] > 0).all():
        raise AwError(
            "the hand's motion turns the edge of the photo behind the camera: raise focal_35mm, or lower "
            "speed_deg_s of motion_blur and rolling_shutter"
        )
    return rays[..., :2] / rays[..., 2:]


def in_pixels(points: np.ndarray, camera: Camera) -> np.ndarray:
    """[..., 2] px of the pinhole camera."""
    return points * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def enlarged(camera: Camera, sources: list[np.ndarray], fine: int) -> tuple[Camera, int]:
    """A finer camera that covers all sources, and its border in coarse px."""
    low = min(float(s.min()) for s in sources)
    high = max(float((s - (camera.width, camera.height)).max()) for s in sources)
    border = int(np.ceil(max(-low, high, 0.0))) + 1
    if border > _MAX_BORDER * max(camera.width, camera.height):
        raise AwError(
            f"lens and hand reach {border} px beyond a photo of {camera.width} x {camera.height} px: "
            "raise focal_35mm, or lower lens_distortion or speed_deg_s"
        )
    width, height = camera.width + 2 * border, camera.height + 2 * border
    shifted = replace(camera, width=width, height=height, cx=camera.cx + border, cy=camera.cy + border)
    return shifted.resized(width * fine, height * fine), border


def resample(image: np.ndarray, sources: list[np.ndarray], border: int, fine: int) -> np.ndarray:
    """The photo: mean over the sources and over the fine pixels of each pixel.

    Args:
        image: [H', W'] or [H', W', 3] float32 of the enlarged camera.
        sources: [H fine, W fine, 2] px of the pinhole camera, one array per instant of the exposure.
        border: of the enlarged camera, coarse px.
        fine: fine pixels a side of a pixel.
    """
    total: np.ndarray = np.zeros((), np.float32)
    for source in sources:
        index = ((source + border) * fine - 0.5).astype(np.float32)
        total = total + cv2.remap(
            image, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
    mean = total / np.float32(len(sources))
    height, width = mean.shape[0] // fine, mean.shape[1] // fine
    blocks = mean.reshape(height, fine, width, fine, *mean.shape[2:])
    return np.asarray(blocks.mean((1, 3)), np.float32)
