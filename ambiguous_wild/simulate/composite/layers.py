"""Draw the cut-outs of one photo as a transparent layer, once for all image sizes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ambiguous_wild.core.camera import Camera
from ambiguous_wild.simulate.atlas import linear_to_srgb, srgb_to_linear
from ambiguous_wild.simulate.composite.cutouts import Cutout

TRUTH_COVER = 0.25  # of a pixel: at this cover and above the truth marks a distractor
_SHADOW_BLUR = 0.03  # of the cut-out's height
_LYING_SHADOW = (0.07, 0.05)  # of the cut-out's height, to the right and down


@dataclass(frozen=True)
class CutoutPlacement:
    """One cut-out in one photo: a billboard that faces the camera."""

    which: int  # index into the cut-outs
    position: tuple[float, float, float]  # world: its foot if standing, its centre if lying
    turn_deg: float  # in the picture, clockwise
    standing: bool


def project(camera: Camera, position: Sequence[float]) -> tuple[float, float, float]:
    """(u, v, depth) of a world point: px, px, scene units."""
    x, y, z = camera.cam_from_world[:3] @ np.append(np.asarray(position, float), 1.0)
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, float(z)


def layer(
    cutouts: Sequence[Cutout],
    heights: Sequence[float],
    placements: Sequence[CutoutPlacement],
    camera: Camera,
    shadow: float = 0.0,
) -> np.ndarray:  # [H, W, 4] float32: linear RGB times alpha, alpha
    """All cut-outs of one photo, nearer ones over farther ones.

    Args:
        cutouts: all cut-outs.
        heights: of each, scene units.
        placements: of this photo.
        camera: of the photo; the layer has its size.
        shadow: darkness of the shadow's centre, 0 (none) to 1 (black).
    """
    out = np.zeros((camera.height, camera.width, 4), np.float32)
    placed = [(project(camera, s.position), s) for s in placements]
    for (u, v, depth), placement in sorted(placed, key=lambda item: -item[0][2]):
        source, tall = cutouts[placement.which].light, camera.fy * heights[placement.which] / depth
        if shadow > 0:
            dark = _warped(source[..., 3], tall, (u, v), placement, out.shape[:2], shadow=True)
            dark = cv2.GaussianBlur(dark, (0, 0), max(_SHADOW_BLUR * tall, 0.5)) * np.float32(shadow)
            out *= 1 - dark[..., None]
            out[..., 3] += dark
        over = _warped(source, tall, (u, v), placement, out.shape[:2], shadow=False)
        out = over + (1 - over[..., 3:]) * out
    return out


def _warped(
    source: np.ndarray,
    tall: float,
    at: tuple[float, float],
    placement: CutoutPlacement,
    shape: tuple[int, ...],
    shadow: bool,
) -> np.ndarray:
    """The source scaled to `tall` px height in an image of `shape`, antialiased; 0 outside."""
    h, w = source.shape[:2]
    if tall < h:  # area averaging first: sampling alone would alias
        w, h = max(1, round(w * tall / h)), max(1, round(tall))
        source = cv2.resize(source, (w, h), interpolation=cv2.INTER_AREA)
    scale = np.array([tall * (source.shape[1] / source.shape[0]) / w, tall / h])
    angle = np.deg2rad(placement.turn_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    place = np.asarray(at, float)
    if shadow and placement.standing:  # cast on the ground to the right: flat and slanted
        turn = np.array([[1.0, -0.55], [0.0, 0.22]]) @ turn
    elif shadow:
        place = place + tall * np.array(_LYING_SHADOW)
    matrix = turn * scale
    anchor = np.array([w / 2, h if placement.standing else h / 2])
    # Pixel centres: +0.5 here, whole numbers in OpenCV.
    shift = place - matrix @ anchor + matrix @ [0.5, 0.5] - 0.5
    size = (shape[1], shape[0])
    return cv2.warpAffine(source, np.column_stack([matrix, shift]), size, flags=cv2.INTER_LINEAR)


def resized(over: np.ndarray, width: int, height: int) -> np.ndarray:
    """The layer for a smaller image of the same camera, by area averaging of premultiplied light."""
    if over.shape[:2] == (height, width):
        return over
    return cv2.resize(over, (width, height), interpolation=cv2.INTER_AREA)


def composed(
    photo: np.ndarray,  # [H, W, 3] uint8, sRGB
    over: np.ndarray,  # [H, W, 4] float32
) -> np.ndarray:  # [H, W, 3] uint8, sRGB
    """The layer over the photo, blended in linear light; pixels that it does not cover keep their bytes."""
    touched = over[..., 3] > 0
    below = srgb_to_linear(photo[touched].astype(np.float32) / 255)
    mixed = over[touched, :3] + (1 - over[touched, 3:]) * below
    out = photo.copy()
    out[touched] = np.round(255 * linear_to_srgb(mixed)).astype(np.uint8)
    return out


def truth(over: np.ndarray) -> np.ndarray:
    """255 where the layer covers at least a quarter of a pixel, else 0: [H, W] uint8."""
    return np.where(over[..., 3] >= TRUTH_COVER, 255, 0).astype(np.uint8)
