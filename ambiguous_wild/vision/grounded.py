"""Instances by prompt: Grounding DINO finds boxes for each phrase, SAM 2 the instance in each box."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.vision.mask_ops import box_nms, paint
from ambiguous_wild.vision.pretrained import load, locate, model_class
from ambiguous_wild.vision.sam import SamConfig, SamInstances, fit_to

# A constant table 0, 1, 2 ... in older checkpoints of BERT.
HARMLESS = ("model.text_backbone.embeddings.position_ids",)


@dataclass(frozen=True)
class GroundedConfig:
    """Grounding DINO tiny at 800x1066 takes 16 s a photo on two cores; SAM's encoder 3 s more."""

    least_score: float = 0.35  # boxes of a lower score are dropped
    least_text: float = 0.25  # tokens of a higher probability form the box's label
    nms: float = 0.7  # boxes with a larger IoU are duplicates
    shorter: int = 800  # px the photo's shorter side is resized to
    longer: int = 1333  # px, limit of the longer side
    sam: SamConfig = field(default_factory=SamConfig)


@dataclass(frozen=True)
class Detection:
    """One box and the phrase it matches."""

    box: tuple[float, float, float, float]  # xyxy, px of the photo
    score: float
    label: str  # the prompt's words above `least_text`; may be empty


class GroundedInstances:
    """Instances of what a prompt names; implements the `Instances` protocol."""

    def __init__(
        self,
        prompt: str,
        config: GroundedConfig | None = None,
        name: str = "grounding-dino-tiny",
        sam: str = "sam2.1-hiera-tiny",
        folder: str | Path | None = None,
        sam_folder: str | Path | None = None,
    ) -> None:
        """Find and check the weights of both models; they are loaded at first use.

        Args:
            prompt: phrases, each ended by a full stop or a comma: ``"person. car."``.
            config: thresholds and sizes.
            name: name of the detector's weights.
            sam: name of the segmenter's weights.
            folder: holds the detector's weights; without it they are searched.
            sam_folder: holds the segmenter's weights; without it they are searched.

        Raises:
            AwError: an empty prompt; no weights, see `pretrained.locate`.
        """
        self.prompt = normal_prompt(prompt)
        self.config = config or GroundedConfig()
        if not 0 < self.config.shorter <= self.config.longer:
            raise AwError(
                f"{name}: need 0 < shorter <= longer, got {self.config.shorter}, {self.config.longer}"
            )
        self.source = locate(name, ("grounding-dino",), folder)
        # without them the library silently builds a tokenizer without vocabulary
        if not any((self.source.folder / file).is_file() for file in ("tokenizer.json", "vocab.txt")):
            raise AwError(
                f"{self.source.folder} has no tokenizer.json: {name} cannot read a prompt; download that "
                "file and tokenizer_config.json"
            )
        self.sam = SamInstances(sam, self.config.sam, sam_folder)
        digests = f"{self.source.digest}-{self.sam.source.digest}"
        settings = config_hash({"prompt": self.prompt, "config": self.config})[:8]
        self.name = f"grounded-1-{name}-{sam}-{digests}-{settings}"

    def labels(self, photo: Tensor) -> np.ndarray:
        """Labels [H, W] int32 of a photo [H, W, 3] in [0, 1], 1..K; 0 = nothing the prompt names."""
        return self.labelled(photo)[0]

    def labelled(self, photo: Tensor) -> tuple[np.ndarray, list[Detection]]:
        """Return labels [H, W] int32 and the detections, the one of label k at k - 1."""
        detections = self.detect(photo)
        height, width = int(photo.shape[0]), int(photo.shape[1])
        if not detections:
            return np.zeros((height, width), dtype=np.int32), []
        masks = self.sam.in_boxes(photo, np.array([d.box for d in detections]))
        labels, which = paint(masks, height, width)
        return labels, [detections[k] for k in which]

    @torch.no_grad()
    def detect(self, photo: Tensor) -> list[Detection]:
        """Detect the prompt's phrases: boxes by decreasing score, without duplicates."""
        model, tokenizer = self._nets
        model.to(photo.device)
        height, width = int(photo.shape[0]), int(photo.shape[1])
        scale = min(self.config.shorter / min(height, width), self.config.longer / max(height, width))
        pixels = fit_to(photo, max(round(height * scale), 32), max(round(width * scale), 32))
        text = tokenizer(self.prompt, return_tensors="pt").to(photo.device)
        out = model(pixel_values=pixels, **text)
        probability = out.logits[0].sigmoid()  # [queries, tokens]
        scores = probability.max(1).values
        chosen = torch.nonzero(scores > self.config.least_score)[:, 0]
        centre, half = out.pred_boxes[0, chosen, :2], out.pred_boxes[0, chosen, 2:] / 2.0
        corners = torch.cat([centre - half, centre + half], dim=1).clamp(0.0, 1.0)
        boxes = corners.double().cpu().numpy() * [width, height, width, height]
        values = scores[chosen].double().cpu().numpy()
        ids = text["input_ids"][0]
        in_label = probability[chosen][:, : len(ids)] > self.config.least_text
        detections = []
        for k in box_nms(boxes, values, self.config.nms):
            x0, y0, x1, y1 = (float(v) for v in boxes[k])
            words = in_label[k].clone()
            words[0] = words[-1] = False  # the start and end tokens
            label = str(tokenizer.decode(ids[words], skip_special_tokens=True)).strip(" .")
            detections.append(Detection((x0, y0, x1, y1), float(values[k]), label))
        return detections

    @cached_property
    def _nets(self) -> tuple[Any, Any]:
        folder = self.source.folder
        try:
            tokenizer = model_class("BertTokenizer").from_pretrained(str(folder), local_files_only=True)
        except (OSError, ValueError, TypeError) as error:
            raise AwError(
                f"{folder} has no usable tokenizer: {str(error).splitlines()[0]}; download "
                "tokenizer.json and tokenizer_config.json"
            ) from error
        return load(self.source, "GroundingDinoForObjectDetection", harmless=HARMLESS), tokenizer


def normal_prompt(prompt: str) -> str:
    """Write the prompt in the format of the training data: lower case, a full stop after each phrase.

    Raises:
        AwError: there is no phrase.
    """
    phrases = [" ".join(part.split()) for part in prompt.lower().replace(",", ".").split(".")]
    phrases = [phrase for phrase in phrases if phrase]
    if not phrases:
        raise AwError(f"no phrase in the prompt {prompt!r}; write what to look for, as in 'person. car.'")
    return " ".join(f"{phrase}." for phrase in phrases)
