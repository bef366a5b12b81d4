"""EfficientNet-Lite0 in torch, from the published tensors; batch norms are folded into the convolutions.

Lite: no squeeze-and-excitation, ReLU6 for swish. Convolutions are padded as TensorFlow pads them (SAME).

Source: Tan and Le, ICML 2019; names of the tensors: lukemelas/EfficientNet-PyTorch.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch.nn.functional as F
from torch import Tensor, nn

_EPS = 1e-3  # of the batch norms
_BATCH_NORM = ("weight", "bias", "running_mean", "running_var")
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


class SameConv(nn.Module):
    """A convolution with SAME padding, for inputs of even sides where the stride is 2."""

    weight: Tensor
    bias: Tensor

    def __init__(self, weight: Tensor, bias: Tensor, stride: int, groups: int) -> None:
        super().__init__()
        self.register_buffer("weight", weight)
        self.register_buffer("bias", bias)
        self.stride, self.groups = stride, groups

    def forward(self, x: Tensor) -> Tensor:
        kernel = self.weight.shape[2]
        if self.stride == 1:
            return F.conv2d(x, self.weight, self.bias, padding=kernel // 2, groups=self.groups)
        total = kernel - self.stride  # the odd pixel goes right and below
        low, high = total // 2, total - total // 2
        return F.conv2d(
            F.pad(x, (low, high, low, high)), self.weight, self.bias, self.stride, 0, 1, self.groups
        )


class Block(nn.Module):
    """Expansion, depthwise convolution, projection; with a shortcut where the shape stays."""

    def __init__(
        self, expand: SameConv | None, depthwise: SameConv, project: SameConv, shortcut: bool
    ) -> None:
        super().__init__()
        self.expand, self.depthwise, self.project, self.shortcut = expand, depthwise, project, shortcut

    def forward(self, x: Tensor) -> Tensor:
        y = x if self.expand is None else F.relu6(self.expand(x))
        y = self.project(F.relu6(self.depthwise(y)))
        return x + y if self.shortcut else y


class EfficientNetLite0(nn.Module):
    """Pixels [B, 3, H, W] in [-1, 1] to the output of a layer of `LAYERS`; H and W are whole cells."""

    def __init__(self, tensors: Mapping[str, Tensor], layer: str) -> None:
        """
        Args:
            tensors: of the published file.
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
    expand = None
    if expansion > 1:
        expand = _folded(tensors, place + "_expand_conv", place + "_bn0", (wide, into, 1, 1))
    depthwise = _folded(tensors, place + "_depthwise_conv", place + "_bn1", (wide, 1, kernel, kernel), stride)
    project = _folded(tensors, place + "_project_conv", place + "_bn2", (out, wide, 1, 1))
    return Block(expand, depthwise, project, stride == 1 and into == out)


def _folded(
    tensors: Mapping[str, Tensor], conv: str, norm: str, shape: tuple[int, ...], stride: int = 1
) -> SameConv:
    """The convolution with the batch norm that follows it."""
    weight = tensors[f"{conv}.weight"]
    gain, shift, mean, variance = (tensors[f"{norm}.{part}"] for part in _BATCH_NORM)
    if tuple(weight.shape) != shape or any(
        tuple(t.shape) != shape[:1] for t in (gain, shift, mean, variance)
    ):
        raise ValueError(f"{conv} is {list(weight.shape)}, expected {list(shape)}")
    scale = gain.double() / (variance.double() + _EPS).sqrt()
    folded = weight.double() * scale[:, None, None, None]
    bias = shift.double() - mean.double() * scale
    groups = shape[0] if shape[1] == 1 else 1
    return SameConv(folded.float(), bias.float(), stride, groups)
