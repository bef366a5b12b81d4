"""Features of convolutional networks trained on ImageNet: EfficientNet-Lite0 and VGG-16; frozen.

Both are differentiable in the image. `aw weights get` downloads them without a hub.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.core.weight_files import expanded, read_tensors
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.vision import weight_registry
from ambiguous_wild.vision.dino import normalised
from ambiguous_wild.vision.protocols import Features, cell_grid, check_image, check_sizes, whole_cells
from ambiguous_wild.vision.weight_conversion import check_published, used_tensors

_EPS = 1e-3  # of the batch norms
_BATCH_NORM = ("weight", "bias", "running_mean", "running_var")


@dataclass(frozen=True)
class _Network:
    layers: Mapping[str, tuple[int, int, int]]  # name -> (depth, stride in px, channels)
    layer: str  # default
    size: int  # default


# kernel, stride, expansion, channels in and out of each block
BLOCKS = (
    (3, 1, 1, 32, 16),
    (3, 2, 6, 16, 24), (3, 1, 6, 24, 24),
    (5, 2, 6, 24, 40), (5, 1, 6, 40, 40),
    (3, 2, 6, 40, 80), (3, 1, 6, 80, 80), (3, 1, 6, 80, 80),
    (5, 1, 6, 80, 112), (5, 1, 6, 112, 112), (5, 1, 6, 112, 112),
    (5, 2, 6, 112, 192), (5, 1, 6, 192, 192), (5, 1, 6, 192, 192), (5, 1, 6, 192, 192),
    (3, 1, 6, 192, 320),
)  # fmt: skip
# Last block of a resolution: name of the layer -> (block, stride in px, channels)
LAYERS = {"stride4": (2, 4, 24), "stride8": (4, 8, 40), "stride16": (10, 16, 112), "stride32": (14, 32, 192)}
_VGG = (64, 64, "M", 128, 128, "M", 256, 256, 256, "M", 512, 512, 512, "M", 512, 512, 512)
# name of the layer -> (entries of _VGG, stride in px, channels)
_VGG_LAYERS = {
    "relu1_2": (2, 1, 64), "relu2_2": (5, 2, 128), "relu3_3": (9, 4, 256), "relu4_3": (13, 8, 512),
    "relu5_3": (17, 16, 512),
}  # fmt: skip


NETWORKS = {
    "efficientnet-lite0": _Network(LAYERS, "stride8", 0),
    "vgg16": _Network(_VGG_LAYERS, "relu3_3", 252),
}


class Block(nn.Module):
    """Expansion, depthwise convolution and projection, with a shortcut if input and output have one shape."""

    def __init__(self, layers: Sequence[nn.Module], shortcut: bool) -> None:
        super().__init__()
        self.layers, self.shortcut = nn.Sequential(*layers), shortcut

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x) if self.shortcut else self.layers(x)


class EfficientNetLite0(nn.Module):
    """Pixels [B, 3, H, W] in [-1, 1] to the output of a layer of `LAYERS`; H and W are whole cells."""

    def __init__(self, tensors: Mapping[str, Tensor], layer: str) -> None:
        """
        Args:
            tensors: those of the published file.
            layer: a key of `LAYERS`; later blocks are left out.

        Raises:
            KeyError, ValueError: a tensor is missing, or has another shape.
        """
        super().__init__()
        self.stem = _folded(tensors, "_conv_stem", "_bn0", (32, 3, 3, 3), 2)
        self.blocks = nn.Sequential(*(_block(tensors, i) for i in range(LAYERS[layer][0] + 1)))

    def forward(self, pixels: Tensor) -> Tensor:
        return self.blocks(F.relu6(self.stem(pixels)))


def _block(tensors: Mapping[str, Tensor], index: int) -> Block:
    kernel, stride, expansion, into, out = BLOCKS[index]
    place, wide = f"_blocks.{index}.", into * expansion
    layers: list[nn.Module] = []
    if expansion > 1:
        layers += [_folded(tensors, place + "_expand_conv", place + "_bn0", (wide, into, 1, 1)), nn.ReLU6()]
    layers += [
        _folded(tensors, place + "_depthwise_conv", place + "_bn1", (wide, 1, kernel, kernel), stride),
        nn.ReLU6(),
        _folded(tensors, place + "_project_conv", place + "_bn2", (out, wide, 1, 1)),
    ]
    return Block(layers, stride == 1 and into == out)


def _folded(
    tensors: Mapping[str, Tensor], conv: str, norm: str, shape: tuple[int, ...], stride: int = 1
) -> nn.Module:
    """Fold a batch norm into the convolution before it; SAME padding, for even sides if the stride is 2."""
    weight = tensors[f"{conv}.weight"]
    gain, shift, mean, variance = (tensors[f"{norm}.{part}"] for part in _BATCH_NORM)
    if tuple(weight.shape) != shape or any(
        tuple(t.shape) != shape[:1] for t in (gain, shift, mean, variance)
    ):
        raise ValueError(f"{conv} is {list(weight.shape)}, expected {list(shape)}")
    scale = gain.double() / (variance.double() + _EPS).sqrt()
    folded = weight.double() * scale[:, None, None, None]
    bias = shift.double() - mean.double() * scale
    kernel, groups = shape[2], shape[0] if shape[1] == 1 else 1
    padding = kernel // 2 if stride == 1 else 0
    net = nn.Conv2d(shape[1] * groups, shape[0], kernel, stride, padding, groups=groups)
    net.load_state_dict({"weight": folded.float(), "bias": bias.float()})
    if stride == 1:
        return net
    total = kernel - stride  # the odd pixel goes right and below
    low, high = total // 2, total - total // 2
    return nn.Sequential(nn.ZeroPad2d((low, high, low, high)), net)


@dataclass(frozen=True)
class ConvConfig:
    """Sizes and layers; "" and -1 are the network's defaults in `NETWORKS`."""

    size: int = -1  # px, longer side of the net's input, rounded to whole cells; 0 = the image's size
    layer: str = ""  # the layer whose output is used
    fit_photos: int = 8  # photos that `fit` uses


def _vgg(tensors: Mapping[str, Tensor], layer: str) -> nn.Module:
    """VGG-16 up to a layer of `_VGG_LAYERS`, with torchvision's indices."""
    layers: list[nn.Module] = []
    channels = 3
    for entry in _VGG[: _VGG_LAYERS[layer][0]]:
        if isinstance(entry, str):
            layers.append(nn.MaxPool2d(2, 2))
            continue
        layers += [nn.Conv2d(channels, entry, 3, 1, 1), nn.ReLU()]
        channels = entry
    net = nn.Sequential(*layers)
    net.load_state_dict({key: tensors[f"features.{key}"] for key in net.state_dict()})
    return net


def _prepared(name: str, pixels: Tensor, stride: int) -> Tensor:
    """Scale pixels in [0, 1] as in training; EfficientNet's, (x - 127) / 128, also move by half a cell.

    SAME padding puts the centre of cell k at pixel k * stride + stride - 1, not in the middle of the cell.
    """
    if name == "vgg16":
        return normalised(pixels)
    moved = stride // 2
    height, width = pixels.shape[2:]
    shifted = F.pad(pixels, (moved, 0, moved, 0), mode="replicate")[:, :, :height, :width]
    return (shifted * 255.0 - 127.0) / 128.0


class ConvFeatures(Features):
    """Features that are the output of one layer, [h, w, C]; the cells divide the image evenly."""

    def __init__(self, name: str, config: ConvConfig | None = None, folder: str | Path | None = None) -> None:
        """Find the weights; they are loaded at the first call.

        Args:
            name: a key of `NETWORKS`.
            config: see `ConvConfig`.
            folder: holds the weights; without it they are searched.

        Raises:
            AwError: no weights; an invalid setting.
        """
        self.config = config or ConvConfig()
        network = NETWORKS[name]
        layer = self.config.layer or network.layer
        if layer not in network.layers:
            raise unknown(f"layer of {name}", layer, network.layers)
        self._layer = layer
        _, self.stride, self.channels = network.layers[layer]
        self.size = network.size if self.config.size == -1 else self.config.size
        self.fit_photos = self.config.fit_photos
        check_sizes(name, self.size, self.stride, self.fit_photos)
        self.path = _file(name, folder)
        self._registered = folder is None
        self._sha256 = sha256_file(self.path)
        settings = config_hash([self.size, layer, self.config.fit_photos])[:8]
        self.name = f"conv-1-{name}-{self._sha256[:12]}-{settings}"
        self._what = name
        self._model: nn.Module | None = None
        self._device: torch.device | None = None

    @property
    def model(self) -> nn.Module:
        """The net, loaded at first use.

        Raises:
            AwError: the file is damaged or holds another network; or, where the user named no folder, other
                values than those published.
        """
        if self._model is None:
            command = weight_registry.get_command(self._what)
            advice = f"run: {command}" if self._registered else f"replace it by the file of: {command}"
            tensors = read_tensors(self.path, advice)
            try:
                # building a net draws random numbers; keep the caller's generator unchanged
                with torch.random.fork_rng(devices=[]):
                    build = _vgg if self._what == "vgg16" else EfficientNetLite0
                    net = build(tensors, self._layer)
            except (KeyError, ValueError, RuntimeError) as error:
                line = " ".join(str(error).split())
                raise AwError(f"{self.path} is not {self._what} ({line}); {advice}") from None
            if self._registered:
                weight = weight_registry.get_weight(self._what)
                arrays = used_tensors(weight, {key: value.numpy() for key, value in tensors.items()})
                check_published(weight, self.path, arrays, advice, self._sha256)
            self._model = net.eval().requires_grad_(False)
        return self._model

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Rows and columns of cells for an image of this size in px."""
        return cell_grid(height, width, self.size, self.stride)

    def precision(self, device: torch.device) -> str:
        """See `Features.precision`: torch's default for convolutions on a GPU is TF32."""
        return "tf32" if device.type == "cuda" and torch.backends.cudnn.allow_tf32 else ""

    def __call__(self, image: Tensor) -> Tensor:
        """Features [h, w, C] of an image [H, W, 3] in [0, 1].

        Raises:
            AwError: the image is not [H, W, 3] or smaller than 8 px.
        """
        check_image(image)
        if self._device != image.device:
            self.model.to(image.device)
            self._device = image.device
        rows, columns = self.grid(image.shape[0], image.shape[1])
        graph = torch.is_grad_enabled() and image.requires_grad
        with torch.set_grad_enabled(graph):  # the net is frozen: only the image has a gradient
            pixels = whole_cells(image.float(), rows, columns, self.stride)
            maps = self.model(_prepared(self._what, pixels, self.stride))
        return maps[0].permute(1, 2, 0).contiguous()


def _file(name: str, folder: str | Path | None) -> Path:
    """Find the file of the weights, in the folder if the user names one."""
    weight = weight_registry.get_weight(name)
    if folder is None:
        path = weight_registry.weight_path(weight)
        if path is None:
            raise AwError(weight_registry.missing_error(weight))
        return path
    place = expanded(folder, "the folder of weights")
    files = [place / file for file in weight.files if (place / file).is_file()]
    if not files:
        raise AwError(f"{place} has no {' or '.join(weight.files)}")
    return files[0]
