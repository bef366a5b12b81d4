"""PSNR and SSIM of one picture pair; each variant has its own name (full image, float64, range 1).

Code bases differ by more than methods do: padding at the border alone moves SSIM by up to 0.009. So the
variant is part of the name, and everything is computed from the same saved 8-bit pictures.
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
    """Both pictures as [H, W, 3] float64 in [0, 1].

    Args:
        a: [H, W, 3], uint8 or floating point in [0, 1].
        b: the same size; the kind of number may differ.

    Raises:
        AwError: not three channels, another number type, empty, different sizes, values outside
            [0, 1] or not finite.
    """
    left, right = _as_float(a, "first"), _as_float(b, "second")
    if left.shape != right.shape:
        raise AwError(
            f"pictures of different size: {left.shape[1]}x{left.shape[0]} and "
            f"{right.shape[1]}x{right.shape[0]}; a metric compares pixel by pixel"
        )
    return left, right


def psnr(
    a: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
    b: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
) -> float:
    """Peak signal-to-noise ratio in dB over all pixels and channels, -10 log10(MSE).

    Identical pictures give ``inf``. It stays ``inf`` in means, tables and files (never capped, never
    dropped), so that a copied test picture shows.

    Raises:
        AwError: see `checked_pair`.
    """
    left, right = checked_pair(a, b)
    return psnr_from_mse(float(np.mean((left - right) ** 2)))


def psnr_from_mse(mse: float) -> float:
    """-10 log10(mse) in dB for a data range of 1; ``inf`` at 0."""
    return math.inf if mse == 0.0 else -10.0 * math.log10(mse)


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Mean SSIM over the pixels whose whole window lies in the picture (as scikit-image, NerfBaselines).

    Gaussian window 11x11, sigma 1.5, biased variances, data range 1, per channel. (torchmetrics 1.9 pads by
    reflection and averages over the border too: another number on small pictures.)

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
    """Raise AwError for a picture that `ssim` cannot measure."""
    if min(height, width) < WINDOW:
        raise AwError(
            f"picture of {width}x{height} px is smaller than SSIM's {WINDOW}x{WINDOW} window; "
            "measure at a larger size"
        )


def ssim_inria(a: np.ndarray, b: np.ndarray) -> float:
    """Mean SSIM over all pixels, the picture padded with zeros (as the original 3DGS and RobustSplat).

    The same window as `ssim`. Windows at the border see zeros in both pictures, which adds 0.002 to
    0.009. The network form of the code it follows pads any size, so any size is accepted.

    Args:
        a: [H, W, 3] uint8 or float in [0, 1].
        b: the same size.

    Raises:
        AwError: see `checked_pair`.
    """
    return float(_ssim_map(*checked_pair(a, b)).mean())


# What a harness measures on every test picture; more means better for all of them.
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
    # Biased moments, E[xy] - E[x]E[y], as every code base of the field has them.
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
        raise AwError(f"the {which} picture must be [H, W, 3] and not empty, got {list(image.shape)}")
    if image.dtype == np.uint8:
        return image.astype(np.float64) / 255.0
    if not np.issubdtype(image.dtype, np.floating):
        raise AwError(f"the {which} picture must be uint8 or floating point in [0, 1], got {image.dtype}")
    values = image.astype(np.float64)
    # One comparison catches NaN as well: it is not inside any range.
    if not bool(((values >= 0.0) & (values <= 1.0)).all()):
        raise AwError(
            f"the {which} picture has values outside [0, 1] or not finite; clip the render before measuring"
        )
    return values
