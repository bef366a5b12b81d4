"""Mip pyramids of all textures in one array; conversion between sRGB and linear light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

_MAX_LEVELS = 12


@dataclass(frozen=True)
class Atlas:
    """Mip pyramids of all textures in one flat array; level l of texture t starts at ``offset[t, l]``."""

    texels: np.ndarray  # [N, 3] float32, linear light
    offset: np.ndarray  # [T, L] int64
    width: np.ndarray  # [T, L] int32
    height: np.ndarray  # [T, L] int32
    levels: np.ndarray  # [T] int32
    index: Mapping[str, int]


def srgb_to_linear(image: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    return np.where(image <= 0.04045, image / 12.92, ((image + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_to_srgb(image: np.ndarray) -> np.ndarray:
    """Linear light to sRGB, clipped to [0, 1] (IEC 61966-2-1)."""
    clipped = np.clip(image, 0.0, 1.0)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


def build_atlas(textures: Mapping[str, np.ndarray]) -> Atlas:
    """Mip pyramids by area averaging, in linear light.

    Args:
        textures: name -> [H, W, 3] float32, linear light.
    """
    count = len(textures)
    offset = np.zeros((count, _MAX_LEVELS), np.int64)
    width = np.ones((count, _MAX_LEVELS), np.int32)
    height = np.ones((count, _MAX_LEVELS), np.int32)
    levels = np.zeros(count, np.int32)
    chunks: list[np.ndarray] = []
    used = 0
    for t, image in enumerate(textures.values()):
        level: np.ndarray = np.ascontiguousarray(np.clip(image, 0.0, None), np.float32)
        for k in range(_MAX_LEVELS):
            h, w = level.shape[:2]
            offset[t, k], width[t, k], height[t, k], levels[t] = used, w, h, k + 1
            chunks.append(level.reshape(-1, 3))
            used += h * w
            if min(h, w) == 1:
                break
            level = cv2.resize(level, (max(w // 2, 1), max(h // 2, 1)), interpolation=cv2.INTER_AREA)
    index = {name: t for t, name in enumerate(textures)}
    return Atlas(np.concatenate(chunks), offset, width, height, levels, index)
