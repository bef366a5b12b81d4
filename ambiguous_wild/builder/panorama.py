"""Split 360 degree photos (equirectangular) into overlapping pinhole views."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

YAWS_DEG = tuple(range(0, 360, 45))  # neighbours share half of their field of view, which is 90 degrees
MIN_WIDTH = 2048  # px; a smaller photo of twice its height is taken for a crop


def is_panorama(width: int, height: int, tagged: bool, focal: bool) -> bool:
    """Whether a photo shows the whole sphere.

    Args:
        width, height: px.
        tagged: its metadata (GPano) say so.
        focal: its metadata state a focal length, as those of a camera with one lens do.
    """
    return width == 2 * height and (tagged or (width >= MIN_WIDTH and not focal))


def pinhole_views(
    pixels: np.ndarray,  # [H, 2 H, 3] uint8
) -> Iterator[tuple[int, np.ndarray]]:
    """Yield yaw in degrees and view [H / 2, H / 2, 3] uint8: level, of 90 degrees, as fine as the photo."""
    height, width = pixels.shape[:2]
    side = width // 4
    x, y = np.meshgrid(*2 * [(np.arange(side) + 0.5) / side * 2 - 1])
    latitude = np.arctan2(y, np.hypot(x, 1.0))
    rows = ((latitude / np.pi + 0.5) * height - 0.5).astype(np.float32)
    seamless = np.concatenate([pixels, pixels[:, :1]], axis=1)  # the last column borders on the first
    for yaw in YAWS_DEG:
        longitude = np.arctan2(x, 1.0) + np.radians(yaw)
        columns = ((longitude / (2 * np.pi) + 0.5) * width - 0.5) % width
        at = columns.astype(np.float32), rows
        yield yaw, cv2.remap(seamless, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
