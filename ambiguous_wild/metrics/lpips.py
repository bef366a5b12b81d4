"""LPIPS v0.1 from weights on disk, without the lpips package, torchvision or downloads.

Each variant needs two files: torchvision's backbone and the linear heads of the LPIPS repository, as
published (.pth) or as `aw weights get lpips` stores them (.safetensors). If one is absent, the metric is
*missing*, with the reason; it is never 0 or another variant's value. torch is imported only when a network
is loaded.

Source: Zhang et al., CVPR 2018; layout of the layers and of the files: richzhang/PerceptualSimilarity.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.core.weight_files import find_file, folder_fault, read_tensors
from ambiguous_wild.metrics.image import checked_pair

if TYPE_CHECKING:
    from torch import Tensor, nn

Metric = Callable[[np.ndarray, np.ndarray], float]

SHIFT = (-0.030, -0.088, -0.188)  # z = (x - SHIFT) / SCALE for x in [-1, 1]
SCALE = (0.458, 0.448, 0.450)
TOO_SMALL = "too small for LPIPS"
EPS = 1e-10  # added to the norm over channels, as in the lpips package


@dataclass(frozen=True)
class _Backbone:
    """A convolutional network and the files of its weights."""

    name: str  # folder below AW_WEIGHTS, and name in 'aw doctor'
    files: tuple[str, str]  # two names of one file; the second is torchvision's
    head_name: str
    head_files: tuple[str, str]  # two names of one file
    layers: tuple[Any, ...]  # (channels, kernel, stride, padding), or "M" for a max pool
    pool: tuple[int, int]  # kernel, stride
    taps: tuple[int, ...]  # indices of the ReLU layers whose outputs are used
    channels: tuple[int, ...]  # of each tap's output
    smallest: int  # px, shortest side that leaves each tap at least one pixel


ALEX = _Backbone(
    name="alexnet",
    files=("alexnet.safetensors", "alexnet-owt-7be5be79.pth"),
    head_name="lpips-alex",
    head_files=("lpips_alex.safetensors", "lpips_alex.pth"),
    layers=((64, 11, 4, 2), "M", (192, 5, 1, 2), "M", (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)),
    pool=(3, 2),
    taps=(1, 4, 7, 9, 11),
    channels=(64, 192, 384, 256, 256),
    smallest=31,
)
VGG = _Backbone(
    name="vgg16",
    files=("vgg16.safetensors", "vgg16-397923af.pth"),
    head_name="lpips-vgg",
    head_files=("lpips_vgg.safetensors", "lpips_vgg.pth"),
    layers=tuple(
        "M" if c == "M" else (c, 3, 1, 1)
        for c in (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512)
    ),
    pool=(2, 2),
    taps=(3, 8, 15, 22, 29),
    channels=(64, 128, 256, 512, 512),
    smallest=16,
)
# metric -> (backbone, whether [0, 1] is scaled to [-1, 1] first). Lower is better for all.
VARIANTS: dict[str, tuple[_Backbone, bool]] = {
    "lpips_alex": (ALEX, True),
    "lpips_vgg": (VGG, True),
    "lpips_vgg_01": (VGG, False),
}


def available() -> dict[str, str | None]:
    """Return None for every variant whose files exist, else which are missing. Reads no file."""
    return {name: why_unavailable(backbone) for name, (backbone, _) in VARIANTS.items()}


def too_small(name: str, height: int, width: int) -> str | None:
    """Return why an image of this size in px is too small for a variant of `VARIANTS`; None if it is not."""
    backbone = VARIANTS[name][0]
    if min(height, width) >= backbone.smallest:
        return None
    return (
        f"image of {width}x{height} px is {TOO_SMALL} with {backbone.name}: "
        f"the shorter side must be at least {backbone.smallest} px"
    )


def missing_weights(name: str) -> list[str]:
    """Return the names of weights (see `vision.weight_registry`) that a variant of `VARIANTS` lacks."""
    return [weight for weight, files in _files(VARIANTS[name][0]) if find_file(weight, files) is None]


def load(name: str) -> Metric:
    """Return the metric of this name; weights are loaded once per process and file.

    Args:
        name: a key of `VARIANTS`.

    Returns:
        A function of two images [H, W, 3] (uint8 or float in [0, 1]) that returns their distance.

    Raises:
        AwError: unknown variant, missing files, or a file with other contents.
    """
    if name not in VARIANTS:
        raise unknown("LPIPS variant", name, VARIANTS)
    backbone, centred = VARIANTS[name]
    reason = why_unavailable(backbone)
    if reason is not None:
        raise AwError(reason)
    paths = [find_file(*pair) for pair in _files(backbone)]
    stamps = tuple((str(p), p.stat().st_mtime_ns) for p in paths if p is not None)
    stack, heads = network_of(backbone, stamps)

    def measure(a: np.ndarray, b: np.ndarray) -> float:
        left, right = checked_pair(a, b)
        small = too_small(name, *left.shape[:2])
        if small is not None:
            raise AwError(small)
        return distance(backbone, stack, heads, left, right, centred)

    return measure


def _lpips(name: str, render: np.ndarray, photo: np.ndarray) -> float:
    return load(name)(render, photo)


lpips_alex, lpips_vgg, lpips_vgg_01 = (partial(_lpips, name) for name in VARIANTS)


def distance(
    backbone: _Backbone,
    stack: nn.Sequential,
    heads: list[Tensor],
    left: np.ndarray,
    right: np.ndarray,
    centred: bool,
) -> float:
    import torch

    with torch.inference_mode():
        total = 0.0
        # One image at a time: half the memory of a batch of two, same result.
        features = [_features(backbone, stack, image, centred) for image in (left, right)]
        for head, f, g in zip(heads, *features):
            # Mean of the weighted sum over channels, equation (1) of the paper; accumulated in float64.
            total += float(((f - g) ** 2 * head).sum(dim=1).mean(dtype=torch.float64))
    return total


def _features(backbone: _Backbone, stack: nn.Sequential, image: np.ndarray, centred: bool) -> list[Tensor]:
    """Channel-normalised features [1, C, h, w] of each tap."""
    import torch

    x = torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None]
    if centred:
        x = 2.0 * x - 1.0
    x = (x - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
    normalised = []
    for index, layer in enumerate(stack):
        x = layer(x)
        if index in backbone.taps:
            norm = x.square().sum(dim=1, keepdim=True).sqrt()
            normalised.append(x / (norm + EPS))
    return normalised


@lru_cache(maxsize=4)
def network_of(
    backbone: _Backbone, stamps: tuple[tuple[str, int], ...]
) -> tuple[nn.Sequential, list[Tensor]]:
    """Return the layers and the heads [C, 1, 1]. `stamps` are the files and their times: a replaced file is
    read again."""
    trunk, head = (Path(path) for path, _ in stamps)
    stack = _stack(backbone)
    tensors = read_tensors(trunk, f"run: aw weights get {backbone.name}")
    weights = {k.removeprefix("features."): v for k, v in tensors.items() if k.startswith("features.")}
    try:
        stack.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        line = " ".join(str(error).split())
        raise AwError(
            f"{trunk} is not {backbone.name}: {line}; run: aw weights get {backbone.name}"
        ) from None
    stack.eval().requires_grad_(False)
    expected = {f"lin{i}.model.1.weight": (1, c, 1, 1) for i, c in enumerate(backbone.channels)}
    linear = read_tensors(head, f"run: aw weights get {backbone.head_name}")
    shapes = {key: tuple(value.shape) for key, value in linear.items()}
    if shapes != expected:
        raise AwError(
            f"{head} does not hold the LPIPS heads of {backbone.name} (five of [1, C, 1, 1]); "
            f"run: aw weights get {backbone.head_name}"
        )
    return stack, [linear[key][0].float() for key in expected]


def _stack(backbone: _Backbone) -> nn.Sequential:
    """Return the layers at the indices that the published files use."""
    from torch import nn

    layers: list[nn.Module] = []
    channels = 3
    for entry in backbone.layers:
        if entry == "M":
            layers.append(nn.MaxPool2d(*backbone.pool))
            continue
        out, kernel, stride, padding = entry
        layers += [nn.Conv2d(channels, out, kernel, stride, padding), nn.ReLU()]
        channels = out
    return nn.Sequential(*layers)


def _files(backbone: _Backbone) -> tuple[tuple[str, tuple[str, str]], tuple[str, tuple[str, str]]]:
    return (backbone.name, backbone.files), (backbone.head_name, backbone.head_files)


def why_unavailable(backbone: _Backbone) -> str | None:
    """None if both files exist, else the command that downloads them."""
    need = [name for name, files in _files(backbone) if find_file(name, files) is None]
    if not need:
        return None
    how = folder_fault() or f"run: aw weights get {' '.join(need)}"
    return f"weights missing: {', '.join(need)}; {how}"
