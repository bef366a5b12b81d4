"""PSNR, SSIM and FLIP of a render and its photo; each variant has its own name (full image, float64).

Implementations differ more than methods: padding at the border alone changes SSIM by up to 0.009. So the
variant is part of the name, and all metrics are computed from the same saved 8-bit images.
"""

from __future__ import annotations

import math

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.srgb import srgb_to_linear

WINDOW = 11  # px, Wang et al. 2004
SIGMA = 1.5  # px
C1, C2 = 0.01**2, 0.03**2  # for a data range of 1
RANK = 1e-12  # share of the largest eigenvalue below which a channel copies others, as in grey pictures
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
# YCxCz, the opponent space of the contrast sensitivity functions: rows act on XYZ / white.
_YCC_FROM_XYZ = np.array([[0.0, 116.0, 0.0], [500.0, -500.0, 0.0], [0.0, 200.0, -200.0]])
_YCC_OFFSET = np.array([-16.0, 0.0, 0.0])


def _xyz_from_rgb() -> np.ndarray:
    """Matrix [3, 3] from linear RGB to XYZ, from the primaries and the white point."""
    columns = np.array([(x / y, 1.0, (1.0 - x - y) / y) for x, y in _PRIMARIES]).T
    x, y = _WHITE
    return columns * np.linalg.solve(columns, [x / y, 1.0, (1.0 - x - y) / y])


_XYZ_FROM_RGB = _xyz_from_rgb()
_XYZ_WHITE = _XYZ_FROM_RGB.sum(axis=1)
_YCC_FROM_RGB = _YCC_FROM_XYZ @ (_XYZ_FROM_RGB / _XYZ_WHITE[:, None])


def checked_pair(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return both images as [H, W, 3] float64 in [0, 1].

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

    Identical images give ``inf``, which is not capped in files, but left out of means: a few equal pixels
    would decide each.

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
    from scipy.ndimage import correlate1d

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


def psnr_affine(
    render: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
    photo: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1]
) -> float:
    """PSNR in dB after the affine colour map (3x3 and an offset, least squares) from render to photo.

    The map is fitted to the whole picture and its result clipped to [0, 1]. Never below `psnr`, because the
    identity is such a map. (Nerfstudio and gsplat fit a quadratic map for `cc_psnr`: other values.)

    Raises:
        AwError: see `checked_pair`.
    """
    left, right = checked_pair(render, photo)
    x, y = left.reshape(-1, 3), right.reshape(-1, 3)
    plain = float(np.mean((x - y) ** 2))
    # Normal equations of centred colours: exact enough for 8 bits, and no 4-column copy of a large picture.
    x_mean, y_mean = x.mean(axis=0), y.mean(axis=0)
    x = x - x_mean
    matrix = np.linalg.lstsq(x.T @ x, x.T @ (y - y_mean), rcond=RANK)[0]
    fitted = np.clip(x @ matrix + y_mean, 0.0, 1.0)
    return psnr_from_mse(min(plain, float(np.mean((fitted - y) ** 2))))


def flip(
    a: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1], sRGB
    b: np.ndarray,  # [H, W, 3] the same size
) -> float:
    """Mean LDR-FLIP error in [0, 1] at 67 pixels per degree; 0 for identical images.

    Raises:
        AwError: see `checked_pair`.
    """
    return float(flip_map(a, b).mean())


def flip_map(
    a: np.ndarray,  # [H, W, 3] uint8 or float in [0, 1], sRGB
    b: np.ndarray,  # [H, W, 3] the same size
) -> np.ndarray:
    """The LDR-FLIP error of every pixel, [H, W] float64 in [0, 1]; symmetric in the images.

    Raises:
        AwError: see `checked_pair`.
    """
    first, second = (_opponent(srgb_to_linear(picture)) for picture in checked_pair(a, b))
    colour = _colour_error(_perceived(first), _perceived(second))
    feature = _feature_error(_luminance(first), _luminance(second))
    return colour ** (1.0 - feature)  # equation 7


def _opponent(linear: np.ndarray) -> np.ndarray:
    return linear @ _YCC_FROM_RGB.T + _YCC_OFFSET


def _luminance(opponent: np.ndarray) -> np.ndarray:
    """Y of YCxCz scaled to [0, 1], [H, W]."""
    return (opponent[..., 0] + 16.0) / 116.0


def _perceived(opponent: np.ndarray) -> np.ndarray:
    """Filter by contrast sensitivity; returns L*a*b* with Hunt's adjustment, [H, W, 3]."""
    widest = max(width for gaussians in _CSF.values() for _, width in gaussians)
    radius = math.ceil(3.0 * math.sqrt(widest / (2.0 * math.pi**2)) * PIXELS_PER_DEGREE)
    degrees = np.arange(-radius, radius + 1) / PIXELS_PER_DEGREE
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


def _feature_error(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Difference in edges and points between two luminances [H, W], equation 6."""
    deviation = 0.5 * _FEATURE_DEGREES * PIXELS_PER_DEGREE
    radius = math.ceil(3.0 * deviation)
    x = np.arange(-radius, radius + 1)
    smooth = np.exp(-(x**2) / (2.0 * deviation**2))
    smooth /= smooth.sum()
    edge = _balanced(-x * smooth)
    point = _balanced((x**2 / deviation**2 - 1.0) * smooth)
    errors = [np.abs(_strength(a, kernel, smooth) - _strength(b, kernel, smooth)) for kernel in (edge, point)]
    return np.clip(np.maximum(*errors) / math.sqrt(2.0), 0.0, None) ** _FEATURE_EXPONENT


def _balanced(kernel: np.ndarray) -> np.ndarray:
    """Scale the positive part to sum 1 and the negative to -1: the response lies in [-1, 1]."""
    positive, negative = kernel[kernel > 0].sum(), -kernel[kernel < 0].sum()
    return np.where(kernel > 0, kernel / positive, kernel / negative)


def _strength(luminance: np.ndarray, kernel: np.ndarray, smooth: np.ndarray) -> np.ndarray:
    return np.hypot(_separable(luminance, smooth, kernel), _separable(luminance, kernel, smooth))


def _separable(image: np.ndarray, down: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Filter along both axes; border pixels are repeated."""
    from scipy.ndimage import correlate1d

    rows = correlate1d(image, down, axis=0, mode="nearest")
    return correlate1d(rows, across, axis=1, mode="nearest")
