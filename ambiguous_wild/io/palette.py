"""The colours of all figures: one colour has one meaning."""

from __future__ import annotations

import numpy as np

# Colours from 0 to 1 as in the paper's figures: green = certain or equal, red = uncertain or different.
_RAMP = np.array(
    [[95, 186, 168], [136, 207, 164], [178, 224, 162], [215, 239, 155], [239, 248, 166], [255, 255, 191],
     [254, 235, 158], [253, 211, 128], [253, 180, 102], [248, 141, 81], [240, 103, 68]], np.float64,
)  # fmt: skip
MASKED = (255, 30, 30)  # pixels that a method masks
KEPT = (0, 150, 110)
LOCAL = (245, 133, 24)
GLOBAL = (150, 60, 200)
ADDED = (31, 119, 180)
MERGED = (214, 39, 40)
NEUTRAL = (140, 140, 140)
# Okabe and Ito's colours for colour-blind readers, without yellow, which is too light on white.
CATEGORIES = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233),
              (0, 0, 0))  # fmt: skip


def ramp(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Map values [...] to colours [..., 3] uint8, `low` green to `high` red; NaN is dark grey."""
    values = np.asarray(values, np.float64)
    share = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)
    share = np.where(np.isfinite(share), share, 0.0)
    at = share * (len(_RAMP) - 1)
    places = np.arange(len(_RAMP))
    colours = np.stack([np.interp(at, places, _RAMP[:, c]) for c in range(3)], axis=-1)
    colours[np.isnan(values)] = 60
    return (colours + 0.5).astype(np.uint8)


def tint(photo: np.ndarray, mask: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """Tint the pixels of `mask` [H, W] bool in a photo [H, W, 3] uint8."""
    shown = photo.astype(np.float32)
    shown[mask] = 0.45 * shown[mask] + 0.55 * np.array(colour, np.float32)
    return shown.astype(np.uint8)


def faded(photo: np.ndarray) -> np.ndarray:
    """Turn a photo [H, W, 3] uint8 light grey, as background of a tint."""
    grey = photo.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)
    return np.repeat((70 + 0.65 * grey)[..., None], 3, axis=2).astype(np.uint8)


def plot_colour(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    """Return the colour in [0, 1], for matplotlib."""
    return (colour[0] / 255, colour[1] / 255, colour[2] / 255)
