"""DINO features: DINOv2 with and without registers, DINOv1; frozen, differentiable in the image.

The image is resized to whole patches, because the library silently drops rows and columns beyond the last
whole patch; so the grid covers the whole image.

On an NVIDIA GPU the net multiplies in bfloat16, for photos and renders alike (`precision`).
"""

from __future__ import annotations

import functools
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.vision.pretrained import Pretrained, load, locate
from ambiguous_wild.vision.protocols import Features, cell_grid, check_image, check_sizes, whole_cells


@dataclass(frozen=True)
class _Family:
    """The library's class for one architecture, and defaults for values that config.json may omit."""

    class_name: str
    patch: int
    registers: int = 0
    options: dict[str, bool] = field(default_factory=dict)  # arguments of the class's constructor
    call: dict[str, bool] = field(default_factory=dict)  # arguments of each forward call


_FAMILIES = {  # by model_type
    "dinov2": _Family("Dinov2Model", 14),
    "dinov2_with_registers": _Family("Dinov2WithRegistersModel", 16, 4),
    "vit": _Family("ViTModel", 16, 0, {"add_pooling_layer": False}, {"interpolate_pos_encoding": True}),
}
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
MIXED = torch.bfloat16  # has the range of float32, so gradients need no scaling


@dataclass(frozen=True)
class DinoConfig:
    """Input and depth of the net; what it costs: docs/foundation-models.md."""

    size: int = 252  # px, longer side of the net's input, rounded to whole patches; 0 = the image's size
    blocks: int = 0  # number of blocks to run, from the first; 0 = all
    normalise: Literal["imagenet", "raw"] = "imagenet"  # raw: as RobustSplat feeds it
    fit_photos: int = 8  # photos that `fit` uses


class DinoFeatures(Features):
    """Patch tokens after the final norm, [h, w, C]; the class token and registers are dropped."""

    def __init__(
        self, name: str = "dinov2-small", config: DinoConfig | None = None, folder: str | Path | None = None
    ) -> None:
        """Find and check the weights; they are loaded at the first call.

        Args:
            name: of the weights, see `vision.weight_registry`; any label if `folder` is given.
            config: see `DinoConfig`.
            folder: holds the weights; without it they are searched.

        Raises:
            AwError: no weights, see `pretrained.locate`; an invalid setting.
        """
        self.config = config or DinoConfig()
        self.source: Pretrained = locate(name, tuple(_FAMILIES), folder)
        facts, family = self.source.config, _FAMILIES[self.source.model_type]
        layers = int(facts.get("num_hidden_layers", 12))
        self.patch = int(facts.get("patch_size", family.patch))
        self.channels = int(facts.get("hidden_size", 768))
        self.extra_tokens = 1 + int(facts.get("num_register_tokens", family.registers))  # + class token
        if not 0 <= self.config.blocks <= layers:
            raise AwError(f"{name} has {layers} blocks, got blocks={self.config.blocks}; 0 means all")
        self.fit_photos = self.config.fit_photos
        check_sizes(name, self.config.size, self.patch, self.fit_photos)
        self.name = f"dino-1-{name}-{self.source.digest}-{config_hash(self.config)[:8]}"
        self._model: nn.Module | None = None
        self._device: torch.device | None = None  # where the net is
        self._halved = False  # whether the weights are bfloat16

    @property
    def model(self) -> nn.Module:
        """The net, loaded at first use."""
        if self._model is None:
            family = _FAMILIES[self.source.model_type]
            # some checkpoints hold a pooler, which features do not use
            model = load(self.source, family.class_name, harmless=("pooler.",), **family.options)
            if self.config.blocks:
                holder, attribute = (
                    (model.encoder, "layer") if hasattr(model, "encoder") else (model, "layers")
                )
                kept = list(getattr(holder, attribute))[: self.config.blocks]
                setattr(holder, attribute, nn.ModuleList(kept))
            self._model = model
        return self._model

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of patches for an image of this size in px."""
        return cell_grid(height, width, self.config.size, self.patch)

    def precision(self, device: torch.device) -> str:
        return str(MIXED).removeprefix("torch.") if mixed(device) else ""

    def __call__(self, image: Tensor) -> Tensor:
        """Features [h, w, C] of an image [H, W, 3] in [0, 1]; the cells divide the image evenly.

        Raises:
            AwError: the image is not [H, W, 3] or smaller than 8 px.
        """
        check_image(image)
        model = self._model_on(image.device)
        rows, columns = self.grid(image.shape[0], image.shape[1])
        graph = torch.is_grad_enabled() and image.requires_grad
        with torch.set_grad_enabled(graph):  # the net is frozen: only the image has a gradient
            pixels = whole_cells(image.to(next(model.parameters()).dtype), rows, columns, self.patch)
            if self.config.normalise == "imagenet":
                pixels = normalised(pixels)
            call = _FAMILIES[self.source.model_type].call
            half = mixed(image.device)
            with torch.autocast(image.device.type, MIXED) if half else nullcontext():
                tokens = model(pixels, **call).last_hidden_state[0, self.extra_tokens :]
            tokens = tokens.float() if half else tokens
            return tokens.reshape(rows, columns, self.channels)

    def _model_on(self, device: torch.device) -> nn.Module:
        """Return the net on the device; skips `Module.to`, which visits every layer, if nothing moves."""
        if self._device != device:
            if self._halved and not mixed(device):
                self._model = None  # load again: the bfloat16 weights have lost digits
            self.model.to(device)
            self._device, self._halved = device, mixed(device)
            if self._halved:
                _halve(self.model)
        return self.model


def normalised(pixels: Tensor) -> Tensor:
    """Subtract ImageNet's mean from pixels [B, 3, H, W] in [0, 1], and divide by its standard deviation."""
    mean, std = _imagenet(pixels.dtype, pixels.device)
    return (pixels - mean) / std


@functools.cache
def _imagenet(dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Mean and deviation [1, 3, 1, 1] on the device; cached, because each copy makes the host wait."""
    mean, std = (torch.tensor(v, dtype=dtype, device=device) for v in (IMAGENET_MEAN, IMAGENET_STD))
    return mean.reshape(1, 3, 1, 1), std.reshape(1, 3, 1, 1)


def _halve(model: nn.Module) -> None:
    """Convert the weights of products to bfloat16 once; autocast would convert them in every call."""
    for module in model.modules():
        if isinstance(module, (nn.Linear, nn.Conv2d)):
            module.to(MIXED)


def mixed(device: torch.device) -> bool:
    """Whether the net runs in mixed precision on the device: only on a GPU; a CPU is not faster with it."""
    return device.type == "cuda"
