"""Dense features trained on the scene: a small convolutional net that separates places of the scene.

Unlike `labhog`, it can separate a grey coat in front of a grey wall. It is trained on SfM tracks and degraded
photos and needs no pretrained weights.

Training is contrastive, with InfoNCE (van den Oord et al. 2018): a 3D point in two photos is a positive pair,
the other points of these photos are its negatives. One of the photos is degraded like a render. Measured on
renders of two simulated captures without masks at 600 and 3000 iterations: temperature 0.07 is better than
0.2; training on photos and their own degraded copies, without tracks, is worse than no training (3000:
per-pixel AUC 0.965; tracks 0.974, no training 0.970).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import scipy.sparse
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import State
from ambiguous_wild.vision.labhog import STRIDE, lab_image
from ambiguous_wild.vision.precompute import cache_key, cached
from ambiguous_wild.vision.protocols import (
    Features,
    blurred_noisy_copy,
    check_image,
    evenly_spaced_indices,
    gaussian_blur,
)

Tracks = tuple[np.ndarray, np.ndarray, np.ndarray]  # point [L], photo [L], xy px [L, 2]
Net = TypeVar("Net", bound=nn.Module)


@dataclass(frozen=True)
class SceneConvConfig:
    """The net and its training."""

    widths: tuple[int, int, int] = (16, 32, 48)  # channels at half size, at quarter size, of the wide layers
    channels: int = 32  # channels of the features
    steps: int = 600  # Adam steps, two photos each
    rate: float = 3e-3  # Adam's highest rate; one cycle, rising over a tenth of the steps
    temperature: float = 0.07  # temperature of the softmax over cosines
    anchors: int = 256  # most points a step
    fewest: int = 32  # two photos are a pair if they share at least this many points
    far_px: float = 10.0  # points closer than this are not negatives
    window: int = 240  # px, longest side used; larger photos are cropped around a shared point
    seed: int = 0

    def __post_init__(self) -> None:
        if min(*self.widths, self.channels, self.steps, self.anchors) < 1 or self.fewest < 2:
            raise AwError("sceneconv: widths, channels, steps and anchors must be at least 1, fewest 2")
        if not (self.temperature > 0 and self.rate > 0) or self.window < 32:
            raise AwError("sceneconv: temperature and rate must be positive, window at least 32 px")


def train(make: Callable[[], Net], photos: Sequence[Tensor], tracks: Tracks, config: SceneConvConfig) -> Net:
    """Train a net on the CPU and freeze it; the same input gives the same bits, whatever the thread count.

    Args:
        make: builds the net, [B, 3, H, W] to unit features [B, C, h, w] on a grid of 4 px.
        photos: [H, W, 3] float32 in [0, 1], on the CPU.
        tracks: SfM observations; see `SceneConv.fit_scene`.
        config: settings of the training.

    Raises:
        AwError: no photos, tracks of other photos, or too few tracks.
    """
    pairs = CovisiblePairs(tracks, [(p.shape[1], p.shape[0]) for p in photos], config.fewest)
    images = [photo.permute(2, 0, 1).contiguous() for photo in photos]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the rounding of sums depends on the number of threads
    try:
        with torch.random.fork_rng(devices=[]), torch.enable_grad():
            torch.manual_seed(config.seed)
            return _train(make(), images, pairs, config)
    finally:
        torch.set_num_threads(threads)


def _train(net: Net, images: list[Tensor], pairs: CovisiblePairs, config: SceneConvConfig) -> Net:
    rng = np.random.default_rng(config.seed)
    optimiser = torch.optim.Adam(net.parameters(), lr=config.rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _cycle(step, config.steps))
    for _ in range(config.steps):
        i, j, xy_i, xy_j = pairs.draw(rng)
        one, xy_i, inside_i = _window(images[i], xy_i, config.window)
        two, xy_j, inside_j = _window(images[j], xy_j, config.window)
        rows = np.flatnonzero(inside_i & inside_j)
        rows = rng.permutation(rows)[: config.anchors]
        first = sample(net(one[None]), xy_i[rows])
        second = sample(net(degraded_render(two, rng)[None]), xy_j[rows])
        loss = info_nce(first, second, xy_i[rows], xy_j[rows], config.temperature, config.far_px)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        schedule.step()
    return net.requires_grad_(False).eval()


class CovisiblePairs:
    """Pairs of photos and the points they share."""

    def __init__(self, tracks: Tracks, sizes: Sequence[tuple[int, int]], fewest: int) -> None:
        if not sizes:
            raise AwError("cannot fit features to a scene without training photos")
        point, photo, xy = (np.asarray(part) for part in tracks)
        if not (len(point) == len(photo) == len(xy)) or xy.shape[1:] != (2,):
            raise AwError(f"tracks must be [L], [L] and [L, 2], got {point.shape}, {photo.shape}, {xy.shape}")
        if len(photo) and (photo.min() < 0 or photo.max() >= len(sizes)):
            raise AwError(f"tracks name photo {photo.max()} of {len(sizes)}: they belong to another split")
        inside = (xy >= 0).all(1) & (xy < np.array(sizes)[photo]).all(1)  # NaN is outside
        point, photo, xy = point[inside], photo[inside], xy[inside]
        _, point = np.unique(point, return_inverse=True)
        self.points, self.xy = [], []
        for index in range(len(sizes)):
            # a point found twice in a photo is used once
            ids, first = np.unique(point[photo == index], return_index=True)
            self.points.append(ids)
            self.xy.append(xy[photo == index][first].astype(np.float64))
        columns = np.concatenate(self.points)
        rows = np.repeat(np.arange(len(sizes)), [len(p) for p in self.points])
        width = int(columns.max(initial=0)) + 1
        seen = scipy.sparse.csr_array((np.ones(len(rows)), (rows, columns)), (len(sizes), width))
        shared = (seen @ seen.T).toarray()
        np.fill_diagonal(shared, 0)
        self.partners = [np.flatnonzero(row >= fewest) for row in shared]
        self.usable = np.array([i for i, p in enumerate(self.partners) if len(p)], dtype=np.int64)
        if not len(self.usable):
            raise AwError(
                f"no two of {len(sizes)} train photos share {fewest} SfM points (the most is "
                f"{int(shared.max(initial=0))}): too few to train features; use labhog"
            )

    def draw(self, rng: np.random.Generator) -> tuple[int, int, np.ndarray, np.ndarray]:
        """Draw two photos: their indices, and the positions [n, 2] px of their shared points in each."""
        i = int(rng.choice(self.usable))
        j = int(rng.choice(self.partners[i]))
        _, a, b = np.intersect1d(self.points[i], self.points[j], assume_unique=True, return_indices=True)
        order = rng.permutation(len(a))
        return i, j, self.xy[i][a[order]], self.xy[j][b[order]]


def info_nce(
    first: Tensor,  # [n, C] unit
    second: Tensor,  # [n, C] unit, row k is the same point as in `first`
    xy_first: np.ndarray,  # [n, 2] px
    xy_second: np.ndarray,  # [n, 2] px
    temperature: float,
    far_px: float,
) -> Tensor:
    """Mean cross-entropy of finding each point among the others, both ways; neighbours are ignored."""
    logits = first @ second.T / temperature
    same = np.eye(len(xy_first), dtype=bool)
    target = torch.arange(len(xy_first))
    total = logits.new_zeros(())
    # row k searches the other photo; points close to its match there are no errors
    for scores, xy in ((logits, xy_second), (logits.T, xy_first)):
        close = np.abs(xy[:, None] - xy[None]).max(2) <= far_px
        ignored = torch.from_numpy(close & ~same)
        total = total + 0.5 * F.cross_entropy(scores.masked_fill(ignored, -math.inf), target)
    return total


def sample(features: Tensor, xy: np.ndarray) -> Tensor:
    """Unit features [n, C] at positions [n, 2] px of a map [1, C, h, w] with cells of 4 px, bilinear."""
    size = 4.0 * np.array([features.shape[3], features.shape[2]])
    grid = torch.from_numpy((xy / size * 2.0 - 1.0).astype(np.float32))[None, None]
    sampled = F.grid_sample(features, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return F.normalize(sampled[0, :, 0].T, dim=1, eps=1e-6)


def degraded_render(image: Tensor, rng: np.random.Generator) -> Tensor:
    """A photo [3, H, W] degraded like an unfinished splat render: uneven blur and shift, noise, gain.

    Blur of 0.6 to 3.5 px that varies over the image, shift up to 1.5 px, smooth noise up to 0.03; in half of
    the cases a gain of 0.85 to 1.12 that varies by 4 % between channels.
    """
    height, width = image.shape[1:]
    sharp, soft = np.sort(rng.uniform(0.6, 3.5, 2))
    share = (_field(height, width, int(rng.integers(3, 9)), rng) * 3.0 - 1.0).clamp(0.0, 1.0)
    result = gaussian_blur(image, float(sharp)) * (1.0 - share) + gaussian_blur(image, float(soft)) * share
    shift = [(_field(height, width, 4, rng) - 0.5) * 3.0 for _ in range(2)]
    x = (torch.arange(width) + 0.5 + shift[0]) / width * 2.0 - 1.0
    y = (torch.arange(height)[:, None] + 0.5 + shift[1]) / height * 2.0 - 1.0
    grid = torch.stack([x, y], dim=2)[None]
    result = F.grid_sample(result[None], grid, mode="bilinear", padding_mode="border", align_corners=False)[0]
    noise = torch.from_numpy(rng.standard_normal(result.shape).astype(np.float32))
    grain = float(rng.uniform(0.0, 1.5))
    if grain > 0.4:
        noise = gaussian_blur(noise, grain)
        noise = noise / noise.std()
    result = result + noise * float(rng.uniform(0.005, 0.03))
    if rng.random() < 0.5:
        gain = rng.uniform(0.85, 1.12) * rng.uniform(0.96, 1.04, (3, 1, 1))
        result = result * torch.from_numpy(gain.astype(np.float32))
    return result.clamp(0.0, 1.0)


def _field(height: int, width: int, knots: int, rng: np.random.Generator) -> Tensor:
    """Smooth field [H, W] in [0, 1]."""
    coarse = torch.from_numpy(rng.random((1, 1, knots, knots)).astype(np.float32))
    fine = F.interpolate(coarse, size=(height, width), mode="bicubic", align_corners=False)
    return fine[0, 0].clamp(0.0, 1.0)


def _window(image: Tensor, xy: np.ndarray, most: int) -> tuple[Tensor, np.ndarray, np.ndarray]:
    """Crop [3, H, W] around the first position; also return the positions in it, and which lie inside."""
    extent = np.array([image.shape[2], image.shape[1]])
    size = np.minimum(extent, most)
    start = np.clip(np.floor(xy[0] - size / 2), 0, extent - size).astype(np.int64)
    part = image[:, start[1] : start[1] + size[1], start[0] : start[0] + size[0]]
    moved = xy - start
    return part, moved, ((moved >= 0) & (moved < size)).all(1)


def _cycle(step: int, steps: int) -> float:
    """Return the share of the highest rate: a cosine rise over a tenth of the steps, then a decay to 0."""
    rise = max(0.1 * steps, 1.0)
    if step < rise:
        return 0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * step / rise))
    return 0.5 * (1.0 + math.cos(math.pi * (step - rise) / max(steps - rise, 1.0)))


class ConvNet(nn.Module):
    """[B, 3, H, W] sRGB in [0, 1] to unit features [B, C, ceil(H / 4), ceil(W / 4)].

    The receptive field of a cell is 34 px; even kernels with stride 2 keep it centred on the cell.
    """

    def __init__(self, widths: tuple[int, int, int], channels: int) -> None:
        super().__init__()
        first, second, third = widths
        self.by_two = nn.Conv2d(3, first, 4, stride=2, padding=1)
        self.by_four = nn.Conv2d(first, second, 4, stride=2, padding=1)
        self.near = nn.Conv2d(second, third, 3, padding=1)
        self.far = nn.Conv2d(third, third, 3, padding=2, dilation=2)
        self.out = nn.Conv2d(third + second, channels, 1)

    def forward(self, images: Tensor) -> Tensor:
        lab = torch.stack([lab_image(image.permute(1, 2, 0)) for image in images])
        # scale lightness and colour to about unit spread
        middle, gain = _lab_scale(lab.dtype, lab.device)
        lab = (lab - middle) * gain
        height, width = lab.shape[2:]
        lab = F.pad(lab, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate")
        cells = F.relu(self.by_four(F.relu(self.by_two(lab))))
        wide = F.relu(self.near(cells))
        wide = wide + F.relu(self.far(wide))
        raw = self.out(torch.cat([wide, cells], dim=1))
        return raw * torch.rsqrt((raw * raw).sum(1, keepdim=True) + 1e-6)


@functools.cache
def _lab_scale(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Middle and gain of Lab [2, 3, 1, 1] on the device; cached, because each copy makes the host wait."""
    return torch.tensor([[0.5, 0.0, 0.0], [3.0, 6.0, 6.0]], dtype=dtype, device=device)[:, :, None, None]


class SceneConv(Features):
    """Features [ceil(H / 4), ceil(W / 4), 32] of unit length, trained by `fit_scene`, then frozen."""

    name = "sceneconv-1"
    fit_photos = 24

    def __init__(self, config: SceneConvConfig | None = None) -> None:
        self.config = config or SceneConvConfig()
        self.channels = self.config.channels
        self.unit = 1.0
        self.net: ConvNet | None = None

    def fit_scene(self, photos: Sequence[Tensor], tracks: Tracks, folder: Path | None = None) -> None:
        """Train on the scene, or load the trained net from the cache.

        Args:
            photos: training photos, [H, W, 3] in [0, 1].
            tracks: SfM observations in them: point [L] int, photo index [L] int, xy px [L, 2], where the
                centre of the first pixel is (0.5, 0.5).
            folder: the cache (`vision.precompute`); None = always train.

        Raises:
            AwError: no photos, tracks of other photos, or too few tracks.
        """
        arrays = [photo.detach().cpu().numpy() for photo in photos]

        def compute() -> dict[str, np.ndarray]:
            images = [torch.from_numpy(array) for array in arrays]
            net = train(self._new_net, images, tracks, self.config)
            return {name: tensor.numpy() for name, tensor in net.state_dict().items()}

        if folder is None:
            trained = compute()
        else:
            key = cache_key("sceneconv", self.name, self.config, *arrays, *tracks)
            trained = cached(folder, key, dict.fromkeys(self._new_net().state_dict(), np.float32), compute)
        device = photos[0].device
        self._take({name: torch.from_numpy(array).to(device) for name, array in trained.items()})
        self.fit(photos)

    @torch.no_grad()
    def fit(self, photos: Sequence[Tensor]) -> None:
        """Measure `unit` as `LabHog` does; the net itself is trained by `fit_scene`.

        Raises:
            AwError: there is no photo, or no trained net.
        """
        distances = []
        for index, k in enumerate(evenly_spaced_indices(len(photos), self.fit_photos)):
            one, two = self(photos[k]), self(blurred_noisy_copy(photos[k], index))
            distances.append(float((1.0 - (one * two).sum(2)).double().mean()))
        # a scene of one colour has distance 0
        self.unit = max(float(np.mean(distances)), 1e-6)

    def __call__(self, image: Tensor) -> Tensor:
        """Features [ceil(H / 4), ceil(W / 4), C] of an image [H, W, 3]; differentiable.

        Raises:
            AwError: not trained; the image is not [H, W, 3] or smaller than 8 px.
        """
        if self.net is None:
            raise AwError(
                "sceneconv is not trained: it needs the scene's SfM tracks; call fit_scene, "
                "or use features without training, such as labhog"
            )
        check_image(image)
        return self.net(image.permute(2, 0, 1)[None])[0].permute(1, 2, 0)

    def precision(self, device: torch.device) -> str:
        """See `Features.precision`: torch's default for convolutions on a GPU is TF32."""
        return "tf32" if device.type == "cuda" and torch.backends.cudnn.allow_tf32 else ""

    def _new_net(self) -> ConvNet:
        with torch.random.fork_rng(devices=[]):  # keep the caller's random numbers unchanged
            return ConvNet(self.config.widths, self.config.channels)

    def _take(self, state: dict[str, Tensor]) -> None:
        net = self._new_net()
        net.load_state_dict(state)
        self.net = net.to(next(iter(state.values())).device).requires_grad_(False).eval()

    def state_dict(self) -> State:
        weights = {} if self.net is None else dict(self.net.state_dict())
        return {**weights, "unit": self.unit}

    def load_state_dict(self, state: State) -> None:
        weights = {name: value for name, value in state.items() if name != "unit"}
        if weights:
            self._take(weights)
        self.unit = float(state["unit"])
