"""Evidence of a distractor at every pixel: photo and render differ in colour and in structure.

A render that is not sharp yet differs from its photo in fine texture, but its structure still correlates
with the photo's; at a distractor it does not. On 30 simulated photos against renders of an
unmasked model (600, 3000 iterations), the best IoU of one threshold was 0.74 and 0.82 for the residual
alone, 0.65 and 0.75 for the correlation alone, 0.78 and 0.83 for the product, 0.68 and 0.75 for the distance
of Lab + HOG.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.methods.masking_common import resized
from ambiguous_wild.splat.backend import backend_of

RESIDUAL_BOX = 5  # px
STRUCTURE_BOX = 7  # px
GREY = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # BT.601 luma
NOISE = 5e-4  # variance below which a patch counts as plain: (2.2 %)^2 of JPEG, sensor and render


def structure_residual(photo: Tensor, render: Tensor, base: float = 0.3) -> Tensor:
    """Return mean |photo - render| times (1 - NCC + base), both over boxes; [H, W] in [0, 2 + base].

    Args:
        photo: [H, W, 3] float32 in [0, 1].
        render: render of the same camera and size.
        base: factor of the residual where the structure agrees perfectly.
    """
    residual = box_filter(_channels((photo - render).abs_(), (1 / 3, 1 / 3, 1 / 3))[None], RESIDUAL_BOX)[0]
    a, b = (_channels(image, GREY.tolist()) for image in (photo, render))
    return residual * (1.0 + base - correlation(a, b))


def _channels(image: Tensor, weights: Sequence[float]) -> Tensor:
    """Sum three channels by weights, [H, W]; several times as fast as a sum over the last axis."""
    first, second, third = image.unbind(2)
    return torch.add(torch.add(first * weights[0], second, alpha=weights[1]), third, alpha=weights[2])


def unrelated_pair_residual(photos: Sequence[Tensor], base: float = 0.3) -> float:
    """Return the `structure_residual` of two unrelated pictures.

    It is the median over pixels, then over photos, of each photo against the mirror image of another: the
    same place and light, but other content. It depends on no render, so it also holds where little is learnt:
    behind a crowd even "normal" residuals are large.

    Args:
        photos: photos [H, W, 3] float32 in [0, 1], of any sizes.
        base: argument of `structure_residual`.
    """
    values = []
    for index in range(len(photos)):
        photo, other = (photos[k % len(photos)].cpu() for k in (index, index + len(photos) // 2))
        other = resized(other.flip(1), *photo.shape[:2])
        values.append(float(np.median(structure_residual(photo, other, base).numpy())))
    return float(np.median(values)) if values else 0.0


def correlation(a: Tensor, b: Tensor) -> Tensor:
    """Return the normalised cross-correlation of grey images [H, W] float32 over boxes, in [-1, 1].

    It is 1 where both are plain, and near 0 where only one is: a plain coat in front of a textured wall
    shares no structure with it.
    """
    # variances are small differences of these means
    mean_a, mean_b, aa, bb, ab = box_filter(torch.stack([a, b, a * a, b * b, a * b]), STRUCTURE_BOX)
    var_a, var_b = (aa - mean_a * mean_a).clamp_(min=0.0), (bb - mean_b * mean_b).clamp_(min=0.0)
    common = (ab - mean_a * mean_b).add_(NOISE)
    return common.div_((var_a.add_(NOISE) * var_b.add_(NOISE)).sqrt_()).clamp_(-1.0, 1.0)


def box_filter(maps: Tensor, size: int) -> Tensor:
    """Filter maps [n, H, W] by a box of odd `size`, summed in float64; the border is replicated."""
    if backend_of(maps.device).kernels:
        # a tenth of the time of torch's pooling
        blurred = [cv2.blur(m, (size, size), borderType=cv2.BORDER_REPLICATE) for m in maps.numpy()]
        return torch.from_numpy(np.stack(blurred))
    padded = F.pad(maps[None].double(), (size // 2,) * 4, mode="replicate")
    # one axis after the other needs 2 * size additions a pixel instead of size^2
    return F.avg_pool2d(F.avg_pool2d(padded, (size, 1), 1), (1, size), 1)[0].to(maps)


def nearest(x: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize [h, w] to (height, width): the pixel at each upper left corner (cv2.INTER_NEAREST)."""
    return F.interpolate(x[None, None], size=size, mode="nearest")[0, 0]


def blur_and_shrink(length: int, parts: int, size: int) -> np.ndarray:
    """Return a matrix [parts, length] float32 that applies a box filter, then cv2.INTER_AREA, along an axis.

    The border is replicated. `rows @ x @ columns.T` filters and shrinks a map in two products.
    """
    edges = np.arange(parts + 1) * (length / parts)
    cells = np.arange(length)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    area = np.maximum(overlap, 0.0) * (parts / length)
    both = np.zeros_like(area)
    for away in range(-(size // 2), size // 2 + 1):
        np.add.at(both.T, np.clip(cells + away, 0, length - 1), area.T / size)
    return both.astype(np.float32)
