"""Dense features without pretrained weights: Lab colour means at three scales and HOG at two.

A substitute for DINO where no weights are available. Per-pixel AUC of detecting pasted objects in a blurred,
noisy render (cosine distance, 16 photos): 0.948; Lab alone 0.939, HOG alone 0.895, boxed L1 residual 0.905.
On objects in the background's colours: 0.884, 0.864, 0.870 and 0.830. HOG is standardised. Lab is *not*,
since its cosine is nearly invariant to gain.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.config import State
from ambiguous_wild.vision.protocols import Features, blurred_noisy_copy, check_image, evenly_spaced_indices

STRIDE = 4  # px of the image per cell of the grid
BINS = 9  # orientations over 180 degrees
LAB_CHANNELS, HOG_CHANNELS = 9, 2 * BINS
_FLAT = 0.05  # HOG cells with less contrast are damped, so that noise is not amplified

# linear sRGB (D65) to XYZ divided by the white point: the arguments of f, one row each
_XYZ = (
    (0.4124564 / 0.95047, 0.3575761 / 0.95047, 0.1804375 / 0.95047),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339 / 1.08883, 0.1191920 / 1.08883, 0.9503041 / 1.08883),
)


class LabHog(Features):
    """Lab means (4, 12, 20 px) and HOG (9 bins, full and half size) on a grid of 4 px.

    Each block has length sqrt(weight), with weight = 1 / mean cosine distance between the scene's photos and
    their blurred, noisy copies. So blur and noise alone give a distance of about one per block.
    """

    name = "labhog-1"
    channels = LAB_CHANNELS + HOG_CHANNELS
    fit_photos = 24

    def __init__(self) -> None:
        self.hog_mean = torch.zeros(HOG_CHANNELS)
        self.hog_std = torch.ones(HOG_CHANNELS)
        self.weights = torch.tensor([1000.0, 4.0])  # Lab, HOG: typical values; `fit` sets them
        self.unit = float(2.0 / self.weights.sum())

    @torch.no_grad()
    def fit(self, photos: Sequence[Tensor]) -> None:
        """Measure channel statistics and block weights of the scene.

        Args:
            photos: training photos, [H, W, 3] in [0, 1]; `fit_photos` of them are used, evenly spaced.

        Raises:
            AwError: there is no photo.
        """
        chosen = [photos[k] for k in evenly_spaced_indices(len(photos), self.fit_photos)]
        pairs = [_blocks(photo) for photo in chosen]
        hogs = torch.cat([hog.reshape(-1, HOG_CHANNELS) for _, hog in pairs]).double()
        device = photos[0].device
        self.hog_mean = hogs.mean(0).float().to(device)
        self.hog_std = hogs.std(0, correction=0).clamp(min=1e-3).float().to(device)
        sums = torch.zeros(2, dtype=torch.float64)
        cells = 0
        for index, (photo, pair) in enumerate(zip(chosen, pairs)):
            other = _blocks(blurred_noisy_copy(photo, index))
            for block in range(2):
                one, two = self._unit_block(pair[block], block), self._unit_block(other[block], block)
                sums[block] += (1.0 - (one * two).sum(2)).double().sum().cpu()
            cells += pair[0].shape[0] * pair[0].shape[1]
        # a scene of one colour has distance 0: the floor keeps the weights finite
        self.weights = (1.0 / (sums / cells).clamp(min=1e-6)).float().to(device)
        self.unit = float(2.0 / self.weights.double().sum())

    def __call__(self, image: Tensor) -> Tensor:
        """Features [ceil(H / 4), ceil(W / 4), 27] of an image [H, W, 3]; differentiable.

        Raises:
            AwError: the image is not [H, W, 3] or smaller than 8 px.
        """
        check_image(image)
        lab, hog = _blocks(image)
        weights = self.weights.to(image.dtype).sqrt()
        return torch.cat(
            [self._unit_block(lab, 0) * weights[0], self._unit_block(hog, 1) * weights[1]], dim=2
        )

    def _unit_block(self, block: Tensor, which: int) -> Tensor:
        if which == 1:
            block = (block - self.hog_mean.to(block.dtype)) / self.hog_std.to(block.dtype)
        # the floor gives black cells a finite value and gradient
        return block * torch.rsqrt((block * block).sum(2, keepdim=True) + 1e-6)

    def state_dict(self) -> State:
        return {
            "hog_mean": self.hog_mean,
            "hog_std": self.hog_std,
            "weights": self.weights,
            "unit": self.unit,
        }

    def load_state_dict(self, state: State) -> None:
        self.hog_mean, self.hog_std = state["hog_mean"], state["hog_std"]
        self.weights, self.unit = state["weights"], float(state["unit"])


def lab_image(image: Tensor) -> Tensor:
    """CIE Lab (D65) divided by 100, [3, H, W], of sRGB [H, W, 3]; clamped to [0, 1] first."""
    # channels first: every later step is per channel
    rgb = image.permute(2, 0, 1).clamp(0.0, 1.0)
    # clamp the argument of each branch of `where`, so that no NaN enters the gradient
    high = ((rgb.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    linear = torch.where(rgb > 0.04045, high, rgb / 12.92)
    xyz = (_matrix(linear.dtype, linear.device) @ linear.reshape(3, -1)).reshape(linear.shape)
    edge = (6 / 29) ** 3
    f = torch.where(xyz > edge, xyz.clamp(min=edge) ** (1 / 3), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return torch.stack([1.16 * f[1] - 0.16, 5.0 * (f[0] - f[1]), 2.0 * (f[1] - f[2])])


@functools.cache
def _matrix(dtype: torch.dtype, device: torch.device) -> Tensor:
    """`_XYZ` on the device; cached, because each copy makes the host wait."""
    return torch.tensor(_XYZ, dtype=dtype, device=device)


def _blocks(image: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the Lab block [h, w, 9] and the HOG block [h, w, 18], neither of them normalised."""
    lab = lab_image(image)
    cells = _pool(lab, STRIDE)
    blocks = torch.cat([cells, _box(cells, 3), _box(cells, 5)])
    grey = lab[:1]
    half = _pool(grey, 2)
    hog = torch.cat([_hog(grey, STRIDE), _hog(half, STRIDE // 2)])
    return blocks.permute(1, 2, 0), hog.permute(1, 2, 0)


def _hog(grey: Tensor, cell: int) -> Tensor:
    """Orientation histograms [9, h, w] of a grey image [1, H, W], over 3x3 cells, contrast-normalised.

    A pixel votes for bin k with |g| max(cos 2(theta - theta_k) - cos 40 deg, 0). This needs no atan2, since
    |g| cos 2(theta - theta_k) is linear in (gx^2 - gy^2, 2 gx gy) / |g|.
    """
    padded = F.pad(grey[None], (1, 1, 1, 1), mode="replicate")[0, 0]
    gx = padded[1:-1, 2:] - padded[1:-1, :-2]
    gy = padded[2:, 1:-1] - padded[:-2, 1:-1]
    norm = torch.sqrt(gx * gx + gy * gy + 1e-6)
    parts = torch.stack([(gx * gx - gy * gy) / norm, 2.0 * gx * gy / norm, norm])
    angles = 2.0 * math.pi * torch.arange(BINS, dtype=grey.dtype, device=grey.device) / BINS
    cut = torch.full_like(angles, -math.cos(math.radians(40.0)))
    votes = torch.stack([torch.cos(angles), torch.sin(angles), cut], dim=1)
    maps = torch.relu(votes @ parts.reshape(3, -1)).reshape(BINS, *norm.shape)
    histogram = _box(_pool(maps, cell), 3)
    total = (histogram * histogram).sum(0, keepdim=True)
    return histogram * torch.rsqrt(total + (_FLAT * _FLAT / BINS))


def _pool(maps: Tensor, size: int) -> Tensor:
    """Means over size x size blocks; at the border, over the pixels of the image alone."""
    return F.avg_pool2d(maps[None], size, stride=size, ceil_mode=True)[0]


def _box(maps: Tensor, size: int) -> Tensor:
    """Running mean over size x size cells; at the border, over the cells of the image alone."""
    return F.avg_pool2d(maps[None], size, stride=1, padding=size // 2, count_include_pad=False)[0]
