"""PSNR and SSIM of one image pair; each variant has its own name (full image, float64, range 1).

Implementations differ more than methods: padding at the border alone changes SSIM by up to 0.009. So the
variant is part of the name, and all metrics are computed from the same saved 8-bit images.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.ndimage import correlate1d

from ambiguous_wild.core import AwError

WINDOW = 11  # px, Wang et al. 2004
SIGMA = 1.5  # px
C1, C2 = 0.01**2, 0.03**2  # for a data range of 1


def checked_pair(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both images as [H, W, 3] float64 in [0, 1].

    Args:
        a: [H, W, 3], uint8 or floating point in [0, 1].
        b: the same size; the number type may differ.

    Raises:
        AwError: not three channels, another number type, empty, different sizes, values outside
            [0, 1] or not finite.
    """
    left, right = _as_float(a, "first"), _as_float(b, "second")
    if left.shape != right.shape:
        raise AwError(
            f"images of different size: {left.shape[1]}x{left.shape[0]} and "
            f"{right.shape[1]}x{right.shape[0]}; render at the photo's size"
        )
    return left, right


def psnr(
    a: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
    b: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
) -> float:
    """Peak signal-to-noise ratio in dB over all pixels and channels, -10 log10(MSE).

    Identical images give ``inf``, which is neither capped nor dropped in means, tables and files, so that a
    copied test photo is noticed.

    Raises:
        AwError: see `checked_pair`.
    """
    left, right = checked_pair(a, b)
    return psnr_from_mse(float(np.mean((left - right) ** 2)))


def psnr_from_mse(mse: float) -> float:
    """-10 log10(mse) in dB for a data range of 1; ``inf`` at 0."""
    return math.inf if mse == 0.0 else -10.0 * math.log10(mse)


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Mean SSIM over the pixels whose window lies inside the image (as scikit-image, NerfBaselines).

    Gaussian window 11x11, sigma 1.5, biased variances, data range 1, per channel. (torchmetrics 1.9 pads by
    reflection and includes the border: a different value on small images.)

    Args:
        a: [H, W, 3] uint8 or float in [0, 1].
        b: the same size.

    Raises:
        AwError: a side shorter than the window, or see `checked_pair`.
    """
    left, right = checked_pair(a, b)
    check_size(*left.shape[:2])
    edge = WINDOW // 2
    return float(_ssim_map(left, right)[edge:-edge, edge:-edge].mean())


def check_size(height: int, width: int) -> None:
    """Raise AwError for an image smaller than the window of `ssim`."""
    if min(height, width) < WINDOW:
        raise AwError(
            f"image of {width}x{height} px is smaller than SSIM's {WINDOW}x{WINDOW} window; use larger images"
        )


def ssim_inria(a: np.ndarray, b: np.ndarray) -> float:
    """Mean SSIM over all pixels, with zero padding (as the original 3DGS and RobustSplat).

    The same window as `ssim`. The zeros at the border are equal in both images, which adds 0.002 to 0.009.
    Any image size is accepted.

    Args:
        a: [H, W, 3] uint8 or float in [0, 1].
        b: the same size.

    Raises:
        AwError: see `checked_pair`.
    """
    return float(_ssim_map(*checked_pair(a, b)).mean())


# Measured on every test photo; higher is better for all.
METRICS: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {
    "psnr": psnr,
    "ssim": ssim,
    "ssim_inria": ssim_inria,
}


def window() -> np.ndarray:
    """The one-dimensional Gaussian window, [11] float64, sum 1."""
    x = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-(x**2) / (2.0 * SIGMA**2))
    return weights / weights.sum()


def _ssim_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """SSIM of every pixel and channel, [H, W, 3] float64, zero padding."""
    mean_a, mean_b = _blur(a), _blur(b)
    # Biased moments, E[xy] - E[x]E[y], as in all implementations of the field.
    var_a = _blur(a * a) - mean_a * mean_a
    var_b = _blur(b * b) - mean_b * mean_b
    cov = _blur(a * b) - mean_a * mean_b
    top = (2.0 * mean_a * mean_b + C1) * (2.0 * cov + C2)
    bottom = (mean_a * mean_a + mean_b * mean_b + C1) * (var_a + var_b + C2)
    return top / bottom


def _blur(x: np.ndarray) -> np.ndarray:
    weights = window()
    rows = correlate1d(x, weights, axis=0, mode="constant", cval=0.0)
    return correlate1d(rows, weights, axis=1, mode="constant", cval=0.0)


def _as_float(image: np.ndarray, which: str) -> np.ndarray:
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise AwError(f"the {which} image must be [H, W, 3] and not empty, got {list(image.shape)}")
    if image.dtype == np.uint8:
        return image.astype(np.float64) / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise AwError(f"the {which} image must be uint8 or floating point in [0, 1], got {image.dtype}")
    values = image.astype(np.float64)
    # This also catches NaN, which is inside no range.
    if not bool(((values >= 0.0) & (values <= 1.0)).all()):
        raise AwError(
            f"the {which} image has values outside [0, 1] or not finite; clip the render before measuring"
        )
    return values
