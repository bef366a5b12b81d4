"""Reference rows for captures with exact truth: upper bounds, not methods.

`3dgs+truth` trains 3DGS with the exact distractor masks, `3dgs-clean` on photos of the same poses without
distractors. Both read SCENE/truth, which `aw simulate` writes and no method may read.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError, Scene, View
from ambiguous_wild.core.config import Facts
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.io.images import read_gray
from ambiguous_wild.methods.entry import NoOptions
from ambiguous_wild.methods.mask_policies import FixedMasks
from ambiguous_wild.splat.data import read_photos
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.step import TrainData


@dataclass(frozen=True)
class TruthConfig:
    """Options of exact masks: of `3dgs+truth`, and of `--mask truth`."""

    dilation: int = 0  # px by which every mask grows on each side

    def __post_init__(self) -> None:
        if self.dilation < 0:
            raise AwError(f"dilation of exact masks is a number of px from 0, got {self.dilation}")


def build_masked(options: TruthConfig) -> MethodHooks:
    """Return 3DGS with the exact masks."""
    return MethodHooks(mask=TruthMask(options))


def build_clean(options: NoOptions) -> MethodHooks:
    """Return 3DGS on the clean photos, with test side, poses and points of the capture."""
    return MethodHooks(train_data=clean_data)


class TruthMask(FixedMasks):
    """Keeps everything outside of the exact masks, from the first step on."""

    def __init__(self, config: TruthConfig) -> None:
        super().__init__([])
        self.config = config

    def setup(self, data: TrainData) -> None:
        masks = [read_gray(path) >= 128 for path in truth_files(data.scene, "distractor")]
        if (data.scene.root / "truth" / "shadow").is_dir():
            shadows = truth_files(data.scene, "shadow")
            masks = [mask | (read_gray(path) >= 128) for mask, path in zip(masks, shadows, strict=True)]
        _check_sizes(data.scene, masks)
        self.keeps = [keep_outside(mask, self.config.dilation) for mask in masks]
        super().setup(data)

    def facts(self) -> Facts:
        return {"masked_share": float(np.mean([1.0 - float(keep.mean()) for keep in self.keeps]))}


def keep_outside(mask: np.ndarray, dilation: int) -> Tensor:
    """Return a keep map [H, W] float32 from a distractor mask [H, W] bool grown by `dilation` px."""
    transient = torch.from_numpy(mask.astype(np.float32))
    if dilation:
        side = 2 * dilation + 1
        transient = F.max_pool2d(transient[None, None], side, stride=1, padding=dilation)[0, 0]
    return 1.0 - transient


def clean_data(data: TrainData) -> TrainData:
    """Return the training side with clean photos, without masks.

    Raises:
        AwError: the scene lacks clean photos of some views, or they have another size.
    """
    photos = read_photos(truth_files(data.scene, "clean"), data.cameras, data.device)
    return dataclasses.replace(data, photos=photos, user_keep=[None] * len(photos))


def truth_files(scene: Scene, kind: str) -> list[Path]:
    """Return SCENE/truth/<kind>/<stem>.png of every train view.

    Raises:
        AwError: there is no such folder, or a view has no file in it.
    """
    folder = scene.root / "truth" / kind
    if not folder.is_dir():
        raise AwError(
            f"scene {scene.name} has no exact truth ({folder} is absent): only captures of "
            "'aw simulate' and 'aw composite' have it; train another method on it"
        )
    paths = [scene.truth_file(kind, view) for view in scene.train]
    absent = [view.name for view, path in zip(scene.train, paths) if not path.is_file()]
    if absent:
        raise AwError(
            f"{len(absent)} of {len(paths)} train photos have no file in {folder}: {shortlist(absent)}; "
            "make the capture and its scene again"
        )
    return paths


def _check_sizes(scene: Scene, masks: list[np.ndarray]) -> None:
    def fits(view: View, mask: np.ndarray) -> bool:
        return mask.shape == (view.camera.height, view.camera.width)

    wrong = [view.name for view, mask in zip(scene.train, masks) if not fits(view, mask)]
    if wrong:
        raise AwError(
            f"the truth in {scene.root / 'truth' / 'distractor'} is not of the photos' size: "
            f"{shortlist(wrong)}; load the scene at the factor it was built for"
        )
