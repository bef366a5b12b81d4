"""By which evidence each distractor of a photo can be told from the place."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch

from ambiguous_wild.io.motion_points import MotionPoints
from ambiguous_wild.methods.refinesplat.structure import GREY, correlation
from ambiguous_wild.metrics import ambiguity as am
from ambiguous_wild.metrics import semantic as sem
from ambiguous_wild.vision.moving import MOVES, moving_map

KINDS = ("colour", "structure", "features", "motion")
TOLD = 0.5  # share of a distractor's pixels from which on an evidence tells it
CORRELATED = 0.5  # with the background; below, the structure at a pixel is another one


@dataclass(frozen=True)
class Distractor:
    """One distractor of a photo; None = this evidence says nothing of it."""

    label: int
    pixels: int  # of the photo as the features see it
    colour: bool | None  # most of its pixels differ from their background
    structure: bool | None  # most do in structure
    motion: bool | None  # most lie where features move
    features: bool | None = None  # no static region of another photo resembles it as static ones each other

    @property
    def told_by(self) -> tuple[str, ...]:
        """The kinds of evidence that tell it."""
        return tuple(kind for kind in KINDS if getattr(self, kind))


def distractors(
    regions: np.ndarray,
    photo: np.ndarray,
    behind: np.ndarray | None,
    known: np.ndarray | None,
    segments: np.ndarray,
    points: MotionPoints | None,
) -> list[Distractor]:
    """Every region of a photo that is not tiny, without what features say.

    Args:
        regions: [h, w] int from 1, 0 = none.
        photo: [H, W, 3] in [0, 1].
        behind: its background, [H, W, 3]; None: unknown.
        known: [H, W] bool, where the background is known; None: everywhere.
        segments: [h, w] int32, of the photo at the size of `regions`.
        points: features that move and stay; None: the scene does not say.
    """
    shape = (regions.shape[1], regions.shape[0])
    differs = unlike = sure = moves = None
    if behind is not None:
        differs = am.colour_residual(photo, behind) > am.COLOUR_THRESHOLD
        grey = (torch.from_numpy((image @ GREY).astype(np.float32)) for image in (photo, behind))
        unlike = correlation(*grey).numpy() < CORRELATED
        sure = np.ones(differs.shape, bool) if known is None else known
        differs, unlike, sure = (
            cv2.resize(x.astype(np.uint8), shape, interpolation=cv2.INTER_NEAREST) > 0
            for x in (differs, unlike, sure)
        )
    if points is not None:
        moves = moving_map(points, segments, regions.shape)
    found = []
    for label, pixels in enumerate(np.bincount(regions.ravel())):
        if label == 0 or pixels < max(sem.MIN_SHARE * regions.size, 1):
            continue
        at = regions == label
        found.append(
            Distractor(
                label,
                int(pixels),
                _most(differs, at, sure),
                _most(unlike, at, sure),
                None if moves is None or bool(np.all(moves[at] == 0.5)) else _most(moves > MOVES, at, None),
            )
        )
    return found


def _most(yes: np.ndarray | None, at: np.ndarray, sure: np.ndarray | None) -> bool | None:
    if yes is None:
        return None
    where = at if sure is None else at & sure
    return bool(yes[where].mean() >= TOLD) if where.any() else None
