"""Identities across an ordered sequence: SAM 2 tracks the instances of one photo through the next ones.

Every few photos all instances are detected again; those that no tracked instance covers get new ids. At
these photos the sequence is divided into chunks, each with its own memory. A chunk is a cache entry, so that
a stopped stage resumes. An object that is out of view for a whole chunk returns with a new id.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import config_hash
from ambiguous_wild.io.files import natural_key
from ambiguous_wild.io.progress_bar import Progress
from ambiguous_wild.vision.mask_ops import add_untracked
from ambiguous_wild.vision.precompute import cache_key, cached, photo_labels
from ambiguous_wild.vision.pretrained import load, locate
from ambiguous_wild.vision.protocols import Instances
from ambiguous_wild.vision.sam import SamConfig, SamInstances, fit_to


@dataclass(frozen=True)
class SamVideoConfig:
    """Cost grows with the number of objects: each has its own memory."""

    every: int = 8  # photos between two detections of new instances
    most: int = 32  # limit of instances tracked at a time; the largest are kept
    known: float = 0.5  # an instance is not new if tracked ones cover at least this share of it
    sam: SamConfig = field(default_factory=SamConfig)


class SamVideoInstances:
    """Instances with one id per object over a whole photo sequence."""

    def __init__(
        self,
        name: str = "sam2.1-hiera-tiny",
        config: SamVideoConfig | None = None,
        folder: str | Path | None = None,
        single: Instances | None = None,
    ) -> None:
        """Find and check the weights; they are loaded at first use.

        Args:
            name: name of the weights, see `vision.weight_registry`; any label if `folder` is given.
            config: see `SamVideoConfig`.
            folder: holds the weights; without it they are searched.
            single: detects the instances to track; by default SAM 2, all instances.

        Raises:
            AwError: no weights, see `pretrained.locate`; an invalid setting.
        """
        self.config = config or SamVideoConfig()
        if self.config.every < 1 or self.config.most < 1:
            raise AwError(
                f"{name}: every and most must be at least 1, got {self.config.every}, {self.config.most}"
            )
        self.source = locate(name, ("sam2_video",), folder)
        self.single: Instances = single or SamInstances(name, self.config.sam, folder)
        settings = config_hash({"config": self.config, "single": self.single.name})[:8]
        self.name = f"sam-video-1-{name}-{self.source.digest}-{settings}"

    @cached_property
    def model(self) -> Any:
        """The net, loaded at first use."""
        return load(self.source, "Sam2VideoModel")

    def labels(self, photo: Tensor) -> np.ndarray:
        """Labels [H, W] int32 of one photo [H, W, 3], without identities."""
        return self.single.labels(photo)

    def identities(
        self,
        photos: Sequence[Tensor],
        names: Sequence[str],
        folder: Path | None = None,
        progress: Progress = iter,
    ) -> list[np.ndarray]:
        """Labels [H, W] int32 of every photo, one id per object over the whole sequence; 0 = none.

        Args:
            photos: [H, W, 3] in [0, 1].
            names: names of the photos; their natural order (a2 before a10) is the order of the sequence.
            folder: the cache; each photo's instances and each chunk are one entry.
            progress: wraps the chunks, for a progress bar.
        """
        order = sorted(range(len(photos)), key=lambda i: (natural_key(names[i]), i))
        result: list[np.ndarray] = [np.zeros(tuple(p.shape[:2]), dtype=np.int32) for p in photos]
        carried: np.ndarray | None = None  # ids in the next chunk's first photo
        next_id = 1
        for start in progress(list(range(0, len(order), self.config.every))):
            chunk = order[start : start + self.config.every + 1]
            frames = [photos[i] for i in chunk]
            detected = photo_labels(self.single, frames[0], folder)
            empty = np.zeros_like(detected)
            first, next_id = add_untracked(
                empty if carried is None else carried, detected, next_id, self.config.most, self.config.known
            )
            maps = self._tracked(frames, first, folder)
            for i, ids in zip(chunk[: self.config.every], maps):
                result[i] = ids
            carried = maps[-1]
        return result

    def _tracked(self, frames: list[Tensor], first: np.ndarray, folder: Path | None) -> list[np.ndarray]:
        names = [f"frame{k:04d}" for k in range(len(frames))]

        def compute() -> dict[str, np.ndarray]:
            return dict(zip(names, self.follow(frames, first)))

        if folder is None:
            maps = compute()
        else:
            pixels = [frame.detach().cpu().numpy() for frame in frames]
            key = cache_key("followed", self.name, None, first, *pixels)
            maps = cached(folder, key, dict.fromkeys(names, np.int32), compute)
        return [maps[name] for name in names]

    @torch.no_grad()
    def follow(self, frames: Sequence[Tensor], first: np.ndarray) -> list[np.ndarray]:
        """Track the ids of `first` [H, W] int32 through all frames [H, W, 3]; the first map is `first`."""
        ids = [int(k) for k in np.unique(first) if k > 0]
        if not ids or len(frames) == 1:
            return [first, *(np.zeros(tuple(f.shape[:2]), dtype=np.int32) for f in frames[1:])]
        from transformers import Sam2VideoInferenceSession

        device = frames[0].device
        model = self.model.to(device)
        side = int(model.config.prompt_encoder_config.image_size)
        session = Sam2VideoInferenceSession(
            video=torch.cat([fit_to(frame, side, side) for frame in frames]),
            video_height=side,
            video_width=side,
            inference_device=device,
            inference_state_device=device,
            video_storage_device=device,
            dtype=torch.float32,
        )
        for number in ids:
            mask = torch.from_numpy((first == number).astype(np.float32))[None, None].to(device)
            prompt = (F.interpolate(mask, size=(side, side), mode="area") >= 0.5).float()
            session.add_mask_inputs(session.obj_id_to_idx(number), 0, prompt)
        session.obj_with_new_inputs = list(ids)
        model(inference_session=session, frame_idx=0)
        outs = model.propagate_in_video_iterator(session)
        tracked = [_painted(out, tuple(frames[out.frame_idx].shape[:2])) for out in outs if out.frame_idx]
        return [first, *tracked]


def _painted(out: Any, size: tuple[int, int]) -> np.ndarray:
    """Return ids [H, W] of one frame: each pixel has the object of the highest logit above 0."""
    best = torch.zeros(size, device=out.pred_masks.device)
    ids = torch.zeros(size, dtype=torch.int32, device=best.device)
    present = out.object_score_logits
    for index, number in enumerate(out.object_ids):
        if present is not None and float(present.reshape(-1)[index]) <= 0.0:
            continue
        low = out.pred_masks[index].reshape(1, 1, *out.pred_masks.shape[-2:]).float()
        full = F.interpolate(low, size=size, mode="bilinear", align_corners=False)[0, 0]
        wins = full > best
        best = torch.where(wins, full, best)
        ids[wins] = int(number)
    return ids.cpu().numpy()
