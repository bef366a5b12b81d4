"""LDR-FLIP: visible difference between two images that alternate on a screen (0 = none, lower is better).

Source: Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", HPG 2020; equation numbers
are the paper's. NVIDIA's package `flip-evaluator` (BSD-3) is not available on every platform, computes in
float32 and ends the process on bad input. This is the same metric in float64; tests compare it with the
package.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import correlate1d

from ambiguous_wild.core import AwError
from ambiguous_wild.metrics.image import checked_pair

# The paper's default: a screen of 0.7 m and 3840 px, seen from 0.7 m: 67.02.
PIXELS_PER_DEGREE = 0.7 * (3840 / 0.7) * math.pi / 180

# Contrast sensitivity per channel: Gaussians (amplitude, width in degrees^2), table 1.
_CSF = {
    "achromatic": ((1.0, 0.0047),),
    "red-green": ((1.0, 0.0053),),
    "blue-yellow": ((34.1, 0.04), (13.5, 0.025)),
}
_COLOUR_EXPONENT = 0.7  # q_c
_KNEE, _KNEE_ERROR = 0.4, 0.95  # p_c, p_t: share of the largest colour error, and the value it maps to
_FEATURE_DEGREES = 0.082  # w, edge width of highest visibility
_FEATURE_EXPONENT = 0.5  # q_f

# CIE xy of sRGB's primaries and of its white point D65.
_PRIMARIES = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
_WHITE = (0.3127, 0.3290)


def flip(
    a: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1], sRGB
    b: np.ndarray,  # [H, W, 3] the same size
) -> float:
    """Mean LDR-FLIP error in [0, 1] at 67 pixels per degree; 0 for identical images.

    Raises:
        AwError: see `image.checked_pair`.
    """
    return float(flip_map(a, b).mean())


def flip_map(
    a: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1], sRGB
    b: np.ndarray,  # [H, W, 3] the same size
    pixels_per_degree: float = PIXELS_PER_DEGREE,
) -> np.ndarray:
    """The LDR-FLIP error of every pixel, [H, W] float64 in [0, 1]; symmetric in the images.

    Raises:
        AwError: pixels per degree not positive, or see `image.checked_pair`.
    """
    if not (math.isfinite(pixels_per_degree) and pixels_per_degree > 0):
        raise AwError(f"pixels per degree must be positive, got {pixels_per_degree}")
    first, second = (_opponent(_linear(picture)) for picture in checked_pair(a, b))
    colour = _colour_error(_perceived(first, pixels_per_degree), _perceived(second, pixels_per_degree))
    feature = _feature_error(_luminance(first), _luminance(second), pixels_per_degree)
    return colour ** (1.0 - feature)  # equation 7


def _linear(image: np.ndarray) -> np.ndarray:
    """sRGB to linear RGB."""
    return np.where(image > 0.04045, ((image + 0.055) / 1.055) ** 2.4, image / 12.92)


def _xyz_from_rgb() -> np.ndarray:
    """Matrix [3, 3] from linear RGB to XYZ, from the primaries and the white point."""
    columns = np.array([(x / y, 1.0, (1.0 - x - y) / y) for x, y in _PRIMARIES]).T
    x, y = _WHITE
    return columns * np.linalg.solve(columns, [x / y, 1.0, (1.0 - x - y) / y])


_XYZ_FROM_RGB = _xyz_from_rgb()
_XYZ_WHITE = _XYZ_FROM_RGB.sum(axis=1)
# YCxCz, the opponent space of the contrast sensitivity functions: rows act on XYZ / white.
_YCC_FROM_XYZ = np.array([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]])
_YCC_OFFSET = np.array([-16.0, 0.0, 0.0])
_YCC_FROM_RGB = _YCC_FROM_XYZ @ (_XYZ_FROM_RGB / _XYZ_WHITE[:, None])


def _opponent(linear: np.ndarray) -> np.ndarray:
    return linear @ _YCC_FROM_RGB.T + _YCC_OFFSET


def _luminance(opponent: np.ndarray) -> np.ndarray:
    """Y of YCxCz scaled to [0, 1], [H, W]."""
    return (opponent[..., 0] + 16.0) / 116.0


def _perceived(opponent: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    """Filtered by contrast sensitivity, in L*a*b* with Hunt's adjustment, [H, W, 3]."""
    widest = max(width for gaussians in _CSF.values() for _, width in gaussians)
    radius = math.ceil(3.0 * math.sqrt(widest / (2.0 * math.pi**2)) * pixels_per_degree)
    degrees = np.arange(-radius, radius + 1) / pixels_per_degree
    filtered = [_blur_csf(opponent[..., i], gaussians, degrees) for i, gaussians in enumerate(_CSF.values())]
    rgb = (np.stack(filtered, axis=-1) - _YCC_OFFSET) @ np.linalg.inv(_YCC_FROM_RGB).T
    return _hunt(_lab(np.clip(rgb, 0.0, 1.0)))


def _blur_csf(
    channel: np.ndarray, gaussians: tuple[tuple[float, float], ...], degrees: np.ndarray
) -> np.ndarray:
    """Filter a channel by its contrast sensitivity, equation 3: separable Gaussians with sum 1."""
    kernels = [np.exp(-(math.pi**2) * degrees**2 / width) for _, width in gaussians]
    weights = [a * math.sqrt(math.pi / width) for a, width in gaussians]
    total = sum(w * k.sum() ** 2 for w, k in zip(weights, kernels))
    parts = (w * _separable(channel, k, k) for w, k in zip(weights, kernels))
    return sum(parts, np.zeros_like(channel)) / total


def _lab(linear: np.ndarray) -> np.ndarray:
    """Linear RGB to CIE L*a*b*."""
    t = linear @ (_XYZ_FROM_RGB / _XYZ_WHITE[:, None]).T
    delta = 6.0 / 29.0
    f = np.where(t > delta**3, np.cbrt(t), t / (3.0 * delta**2) + 4.0 / 29.0)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def _hunt(lab: np.ndarray) -> np.ndarray:
    """Hunt effect: colour differences grow with luminance, equation 4."""
    return np.concatenate([lab[..., :1], 0.01 * lab[..., :1] * lab[..., 1:]], axis=-1)


def _hyab(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """HyAB distance, for large colour differences, equation 5."""
    difference = a - b
    return np.abs(difference[..., 0]) + np.hypot(difference[..., 1], difference[..., 2])


def _colour_error(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Colour difference in [0, 1]; small differences take most of the range, section 4.1.3."""
    green, blue = _hunt(_lab(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])))
    largest = _hyab(green, blue) ** _COLOUR_EXPONENT
    error, knee = _hyab(a, b) ** _COLOUR_EXPONENT, _KNEE * largest
    above = _KNEE_ERROR + (error - knee) / (largest - knee) * (1.0 - _KNEE_ERROR)
    return np.where(error < knee, error * (_KNEE_ERROR / knee), above)


def _feature_error(a: np.ndarray, b: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    """Difference in edges and points between two luminances [H, W], equation 6."""
    deviation = 0.5 * _FEATURE_DEGREES * pixels_per_degree
    radius = math.ceil(3.0 * deviation)
    x = np.arange(-radius, radius + 1)
    smooth = np.exp(-(x**2) / (2.0 * deviation**2))
    smooth /= smooth.sum()
    edge = _balanced(-x * smooth)
    point = _balanced((x**2 / deviation**2 - 1.0) * smooth)
    found = [np.abs(_strength(a, kernel, smooth) - _strength(b, kernel, smooth)) for kernel in (edge, point)]
    return np.clip(np.maximum(*found) / math.sqrt(2.0), 0.0, None) ** _FEATURE_EXPONENT


def _balanced(kernel: np.ndarray) -> np.ndarray:
    """Scale the positive part to sum 1 and the negative to -1: the response lies in [-1, 1]."""
    positive, negative = kernel[kernel > 0].sum(), -kernel[kernel < 0].sum()
    return np.where(kernel > 0, kernel / positive, kernel / negative)


def _strength(luminance: np.ndarray, kernel: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    return np.hypot(_separable(luminance, smooth, kernel), _separable(luminance, kernel, smooth))


def _separable(image: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Filter along both axes; border pixels are repeated."""
    rows = correlate1d(image, down, axis=0, mode="nearest")
    return correlate1d(rows, across, axis=1, mode="nearest")
