"""Dense features trained on the scene: a small convolutional net that separates places of the scene.

Unlike `labhog`, it can separate a grey coat in front of a grey wall. It is trained on SfM tracks and degraded
photos (see `sceneconv_train`) and needs no pretrained weights.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core import AwError
from ambiguous_wild.vision.cache import cache_key, cached
from ambiguous_wild.vision.labhog import STRIDE, blurred_noisy_copy, lab_image
from ambiguous_wild.vision.sceneconv_train import SceneConvConfig, Tracks, train


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


class SceneConv:
    """Features [ceil(H / 4), ceil(W / 4), 32] of unit length, trained by `fit_scene`, then frozen."""

    def __init__(self, config: SceneConvConfig | None = None) -> None:
        self.config = config or SceneConvConfig()
        self.name = "sceneconv-1"
        self.channels = self.config.channels
        self.unit = 1.0
        self.net: ConvNet | None = None

    def fit_scene(self, photos: Sequence[Tensor], tracks: Tracks, folder: Path | None = None) -> None:
        """Train on the scene, or load the trained net from the cache.

        Args:
            photos: training photos, [H, W, 3] in [0, 1].
            tracks: SfM observations in them: point [L] int, photo index [L] int, xy px [L, 2], where the
                centre of the first pixel is (0.5, 0.5).
            folder: of the cache (`vision.cache`); None = always train.

        Raises:
            AwError: no photos, tracks of other photos, or too few tracks.
        """
        arrays = [photo.detach().cpu().numpy() for photo in photos]

        def compute() -> dict[str, np.ndarray]:
            images = [torch.from_numpy(array) for array in arrays]
            net = train(self._new_net, images, tracks, self.config)
            return {name: tensor.numpy() for name, tensor in net.state_dict().items()}

        if folder is None:
            found = compute()
        else:
            key = cache_key("sceneconv", self.name, self.config, *arrays, *tracks)
            found = cached(folder, key, dict.fromkeys(self._new_net().state_dict(), np.float32), compute)
        device = photos[0].device
        self._take({name: torch.from_numpy(array).to(device) for name, array in found.items()})
        self.fit(photos)

    @torch.no_grad()
    def fit(self, photos: Sequence[Tensor], most: int = 24) -> None:
        """Measure `unit` as `LabHog` does; the net itself is trained by `fit_scene`.

        Raises:
            AwError: there is no photo, or no trained net.
        """
        if not photos:
            raise AwError("cannot fit features to a scene without training photos")
        chosen = sorted({round(k * (len(photos) - 1) / max(most - 1, 1)) for k in range(most)})
        distances = []
        for index, k in enumerate(chosen):
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
        if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 8:
            raise AwError(f"features need an image of [H, W, 3], at least 8x8 px, got {list(image.shape)}")
        return self.net(image.permute(2, 0, 1)[None])[0].permute(1, 2, 0)

    def precision(self, device: torch.device) -> str:
        """See `precompute.PreciseFeatures`: torch's default for convolutions on a GPU is TF32."""
        return "tf32" if device.type == "cuda" and torch.backends.cudnn.allow_tf32 else ""

    def _new_net(self) -> ConvNet:
        with torch.random.fork_rng(devices=[]):  # keep the caller's random numbers unchanged
            return ConvNet(self.config.widths, self.config.channels)

    def _take(self, state: dict[str, Tensor]) -> None:
        net = self._new_net()
        net.load_state_dict(state)
        self.net = net.to(next(iter(state.values())).device).requires_grad_(False).eval()

    def state_dict(self) -> dict[str, Any]:
        weights = {} if self.net is None else dict(self.net.state_dict())
        return {**weights, "unit": self.unit}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        weights = {name: value for name, value in state.items() if name != "unit"}
        if weights:
            self._take(weights)
        self.unit = float(state["unit"])
