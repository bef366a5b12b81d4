"""What is fixed to the camera: a car's bonnet, or a burnt-in time stamp, as a layer over every photo."""

from __future__ import annotations

import cv2
import numpy as np

from ambiguous_wild.simulate.spec import FixedThing

_BONNET = 0.22  # height of the bonnet's middle, over the photo's
_BULGE = 0.06  # by which its corners are lower, over the photo's height
_PAINT = ((0.10, 0.10, 0.11), (0.30, 0.31, 0.33))  # linear light at the upper edge and at the bottom
_REFLECTED = 0.2  # share of the scene that the paint mirrors
_BLUR = 0.006  # of the mirrored scene, over the photo's width
_SPECKS = 150  # spots of dirt
_SEAMS = (0.3, 0.5, 0.7)  # where lines of the bonnet meet the bottom, over the photo's width
_STAMP = 0.035  # height of the digits, over the photo's
_STAMP_LIGHT = (0.9, 0.45, 0.05)  # linear light
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_FINE = 4  # subpixels a side with which edges are drawn


def overlay_layer(
    thing: FixedThing,
    photo: np.ndarray,  # [H, W, 3] float32, linear light
    number: int,  # of the photo, from 0: a stamp's time
    seed: int,
) -> np.ndarray:  # [H, W, 4] float32: linear RGB times alpha, alpha
    """Draw the thing over a photo; where it is depends on the size of the photo alone."""
    height, width = photo.shape[:2]
    if thing == "stamp":
        return _stamp(height, width, number)
    alpha = _cover(height, width)
    paint = _paint(height, width, np.random.default_rng(seed))
    mirrored = cv2.GaussianBlur(photo[::-1].astype(np.float64), (0, 0), max(_BLUR * width, 0.5))
    light = (1 - _REFLECTED) * paint + _REFLECTED * mirrored
    return np.concatenate([light * alpha[..., None], alpha[..., None]], axis=2).astype(np.float32)


def _cover(height: int, width: int) -> np.ndarray:
    """Return the share of every pixel that the bonnet covers, [H, W]."""
    across = ((np.arange(width) + 0.5) / width * 2 - 1) ** 2
    top = height * (1 - _BONNET + _BULGE * across)
    return np.clip(np.arange(height)[:, None] + 1 - top, 0, 1)


def _paint(height: int, width: int, rng: np.random.Generator) -> np.ndarray:
    """Draw the bonnet's paint, [H, W, 3] linear light: shading, seams and dirt, the same in all photos."""
    down = np.clip((np.arange(height) / height - 1 + _BONNET) / _BONNET, 0, 1)[:, None, None]
    upper, lower = (np.array(c) for c in _PAINT)
    paint = np.repeat(upper + (lower - upper) * down, width, axis=1).astype(np.float32)
    thick = max(1, width // 300)
    for x in _SEAMS:
        upper_end = (round(width * (0.5 + 0.6 * (x - 0.5))), round(height * (1 - _BONNET)))
        cv2.line(paint, (round(width * x), height), upper_end, (0.02, 0.02, 0.02), thick, cv2.LINE_AA)
    for _ in range(_SPECKS):
        x, y = rng.uniform(0, width), height * (1 - rng.uniform(0, _BONNET))
        shade = float(rng.choice([0.03, 0.55]))
        radius = max(1, round(width * rng.uniform(0.001, 0.005)))
        cv2.circle(paint, (round(x), round(y)), radius, (shade, shade, shade), -1, cv2.LINE_AA)
    return paint


def _stamp(height: int, width: int, number: int) -> np.ndarray:
    """Draw date and time at the lower right."""
    seconds = 4 * number
    text = f"2026-06-14 {12 + seconds // 3600 % 12}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    tall, fine = _STAMP * height * _FINE, np.zeros((height * _FINE, width * _FINE), np.uint8)
    (long, high), _ = cv2.getTextSize(text, _FONT, 1.0, 1)
    scale = min(tall / high, 0.9 * width * _FINE / long)
    thick = max(1, round(0.16 * scale * high))
    (long, _), _ = cv2.getTextSize(text, _FONT, scale, thick)
    corner = (round(0.97 * width * _FINE) - long, round(0.96 * height * _FINE))
    cv2.putText(fine, text, corner, _FONT, scale, 255, thick)
    alpha = (
        cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)[..., None] / 255
    )
    return np.concatenate([alpha * np.array(_STAMP_LIGHT, np.float32), alpha], axis=2)


def alpha_over(
    upper: np.ndarray,  # [H, W, 4] float32: linear RGB times alpha, alpha
    lower: np.ndarray,  # the same, or [H, W, 3] of a photo
) -> np.ndarray:
    """Lay one layer over another, or over a photo in linear light."""
    return upper[..., : lower.shape[2]] + (1 - upper[..., 3:]) * lower
