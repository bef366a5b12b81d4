"""Segment Anything, version 1 and 2: all instances of a photo from a grid of points, or one per box.

We do not use the library's pipeline, because its last step needs torchvision. The photo is encoded once. The
points go through the mask decoder in batches, which takes most of the time. Masks of low quality, unstable
masks and duplicates are dropped before the rest is enlarged to the photo's size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.vision.dino import normalised
from ambiguous_wild.vision.mask_ops import box_nms, mask_boxes, paint
from ambiguous_wild.vision.pretrained import Pretrained, load, locate

PROMPTS = 8  # a prompt has at most this many points on an instance, and as many beside it
# SAM 2 checkpoints hold the video model; the image model loads a part of them.
_CLASSES = {"sam": "SamModel", "sam2": "Sam2Model", "sam2_video": "Sam2Model"}


@dataclass(frozen=True)
class SamConfig:
    """SAM 2 tiny at 1024 px on two cores: 3.3 s to encode a photo, 15 s for 64 points."""

    grid: int = 16  # points along each side; the authors use 32, which takes four times as long
    batch: int = 64  # points decoded at once
    least_iou: float = 0.8  # predicted IoU of a mask; SAM 1's authors use 0.88
    least_stability: float = 0.95  # area above logit 1 divided by area above logit -1
    nms: float = 0.7  # masks whose boxes have a larger IoU are duplicates
    least_area: float = 2e-4  # share of the photo; smaller masks are dropped


@dataclass(frozen=True)
class _Embedded:
    """An encoded photo."""

    embeddings: Any  # from the net's encoder
    height: int  # px of the photo
    width: int
    side: int  # px of the net's square input
    inner: tuple[int, int]  # rows and columns of the input that the photo fills; the rest is padding

    @property
    def scale(self) -> tuple[float, float]:
        """Input px per photo px, in x and y."""
        return self.inner[1] / self.width, self.inner[0] / self.height

    def without_padding(self, low: Tensor) -> Tensor:
        """Cut the padding off logits [n, h, w]."""
        rows = max(round(low.shape[1] * self.inner[0] / self.side), 1)
        columns = max(round(low.shape[2] * self.inner[1] / self.side), 1)
        return low[:, :rows, :columns]

    def enlarged(self, low: Tensor) -> np.ndarray:
        """Make a mask [H, W] bool at the photo's size from logits [h, w]; padding is cut off."""
        full = low[None, None].float()
        if self.inner != (self.side, self.side):
            full = F.interpolate(full, size=(self.side, self.side), mode="bilinear", align_corners=False)
            full = full[:, :, : self.inner[0], : self.inner[1]]
        size = (self.height, self.width)
        full = F.interpolate(full, size=size, mode="bilinear", align_corners=False)
        return (full[0, 0] > 0.0).cpu().numpy()


class SamInstances:
    """Instances of a photo by SAM or SAM 2; implements the `Instances` protocol."""

    def __init__(
        self,
        name: str = "sam2.1-hiera-tiny",
        config: SamConfig | None = None,
        folder: str | Path | None = None,
    ) -> None:
        """Find and check the weights; they are loaded at first use.

        Raises:
            AwError: no weights, see `pretrained.locate`; an invalid setting.
        """
        self.config = config or SamConfig()
        if self.config.grid < 1 or self.config.batch < 1:
            raise AwError(
                f"{name}: grid and batch must be at least 1, got {self.config.grid}, {self.config.batch}"
            )
        self.source: Pretrained = locate(name, tuple(_CLASSES), folder)
        self.name = f"sam-1-{name}-{self.source.digest}-{config_hash(self.config)[:8]}"

    @cached_property
    def model(self) -> Any:
        """The net, loaded at first use."""
        return load(self.source, _CLASSES[self.source.model_type])

    @property
    def side(self) -> int:
        """Px of the net's square input."""
        return int(self.model.config.prompt_encoder_config.image_size)

    @torch.no_grad()
    def labels(self, photo: Tensor) -> np.ndarray:
        """Labels [H, W] int32 of a photo [H, W, 3] in [0, 1], 1..K by decreasing area; 0 = none."""
        embedded = self._embed(photo)
        config, steps = self.config, (torch.arange(self.config.grid) + 0.5) / self.config.grid
        y, x = torch.meshgrid(steps * embedded.height, steps * embedded.width, indexing="ij")
        points = torch.stack([x.reshape(-1), y.reshape(-1)], dim=1).to(photo.device)
        logits, scores = [], []
        for low, quality in self._decode_points(embedded, points):
            seen = embedded.without_padding(low)
            stable = (seen > 1.0).sum((1, 2)) / (seen > -1.0).sum((1, 2)).clamp(min=1)
            area = (seen > 0.0).float().mean((1, 2))
            good = (quality > config.least_iou) & (stable >= config.least_stability)
            good &= area >= config.least_area
            logits.append(low[good])
            scores.append(quality[good])
        kept, score = torch.cat(logits), torch.cat(scores).double().cpu().numpy()
        keep = box_nms(mask_boxes((embedded.without_padding(kept) > 0.0).cpu().numpy()), score, config.nms)
        masks = [embedded.enlarged(kept[k]) for k in keep]
        return paint(masks, embedded.height, embedded.width)[0]

    @torch.no_grad()
    def in_boxes(self, photo: Tensor, boxes: np.ndarray) -> np.ndarray:
        """Mask [n, H, W] bool of the instance in each box [n, 4], xyxy in px of the photo [H, W, 3]."""
        embedded = self._embed(photo)
        result = np.zeros((len(boxes), embedded.height, embedded.width), dtype=bool)
        if not len(boxes):
            return result
        scaled = torch.as_tensor(
            np.asarray(boxes) * (embedded.scale * 2), dtype=torch.float32, device=photo.device
        )
        for start in range(0, len(boxes), self.config.batch):
            part = scaled[None, start : start + self.config.batch]
            out = self.model(
                image_embeddings=embedded.embeddings, input_boxes=part, multimask_output=False
            ).pred_masks[0, :, 0]
            for offset, low in enumerate(out):
                result[start + offset] = embedded.enlarged(low)
        return result

    @torch.no_grad()
    def at_points(self, photo: Tensor, groups: Sequence[np.ndarray], outside: np.ndarray) -> np.ndarray:
        """Mask [n, H, W] bool of the instance on which each group of points lies.

        Args:
            photo: [H, W, 3] in [0, 1].
            groups: points [k, 2] px of each instance; up to `PROMPTS` of them, spread evenly, are the prompt.
            outside: points [m, 2] px on no instance; the nearest are the prompt's negatives.
        """
        embedded = self._embed(photo)
        masks = np.zeros((len(groups), embedded.height, embedded.width), dtype=bool)
        for mask, group in zip(masks, groups):
            inside = group[np.linspace(0, len(group) - 1, min(len(group), PROMPTS)).astype(int)]
            far = ((outside[:, None] - inside[None]) ** 2).sum(2).min(1, initial=np.inf)
            points = np.concatenate([inside, outside[np.argsort(far, kind="stable")[:PROMPTS]]])
            scaled = torch.as_tensor(points * embedded.scale, dtype=torch.float32, device=photo.device)
            signs = torch.zeros(len(points), dtype=torch.int64, device=photo.device)
            signs[: len(inside)] = 1
            out = self.model(
                image_embeddings=embedded.embeddings,
                input_points=scaled[None, None],
                input_labels=signs[None, None],
                multimask_output=False,
            )
            mask[:] = embedded.enlarged(out.pred_masks[0, 0, 0])
        return masks

    def _decode_points(self, embedded: _Embedded, points: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield logits [3 n, h, w] on the net's grid and predicted IoU [3 n] of each batch of n points."""
        scaled = points * points.new_tensor(embedded.scale)
        for start in range(0, len(scaled), self.config.batch):
            part = scaled[start : start + self.config.batch][None, :, None]
            ones = torch.ones(part.shape[:3], dtype=torch.int64, device=part.device)
            out = self.model(image_embeddings=embedded.embeddings, input_points=part, input_labels=ones)
            yield out.pred_masks[0].flatten(0, 1), out.iou_scores[0].flatten()

    def _embed(self, photo: Tensor) -> _Embedded:
        """Encode a photo: SAM 1 keeps its aspect and pads right and below, SAM 2 stretches it to a square."""
        height, width = int(photo.shape[0]), int(photo.shape[1])
        self.model.to(photo.device)
        side = self.side
        if self.source.model_type == "sam":
            scale = side / max(height, width)
            inner = max(round(height * scale), 1), max(round(width * scale), 1)
            pixels = fit_to(photo, *inner)
            pixels = F.pad(pixels, (0, side - inner[1], 0, side - inner[0]))
        else:
            inner = side, side
            pixels = fit_to(photo, side, side)
        return _Embedded(self.model.get_image_embeddings(pixels), height, width, side, inner)


def fit_to(photo: Tensor, height: int, width: int) -> Tensor:
    """A photo [H, W, 3] in [0, 1] as the net's input [1, 3, height, width], resized and normalised."""
    pixels = photo.detach().permute(2, 0, 1)[None].float()
    pixels = F.interpolate(pixels, size=(height, width), mode="bilinear", align_corners=False, antialias=True)
    return normalised(pixels)
