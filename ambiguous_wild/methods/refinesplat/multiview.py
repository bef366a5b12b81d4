"""Multi-view evidence: what is static is seen from elsewhere too.

A surface that the model has not learnt yet differs from its photo in every view that shows it; something that
stood there once differs in one. So the evidence of a view is discounted by what the other views say of the
same surface, found through the render's depth. Without it masks feed on themselves: what is masked early is
never learnt and stays masked. Simulated courtyard, seeds 21 (distractors) and 37 (none), 3000 iterations:
30.2 dB and 33.3 dB without, 32.4 and 36.5 with it; plain 3DGS 27.2 and 36.4, exact masks 32.6 and 36.4.

Their word counts only where their photos show the same colour as this one: before a crowd every view has
evidence everywhere, and without that condition views would excuse each other's distractors.

What is not learnt yet has no depth either, and whoever is asked there sees another surface. So where fewer
than `known_by` views see what the render shows, the sparse points say where the surface is. And where fewer
than `seen_by` others look at all, at the rim of a capture, nothing is masked: nobody else could teach what is
there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import check_limits

_SPREAD = 9  # px, box over a view's evidence before others read it: depth is off by a few pixels
_BLUR = 5  # px, box over photos before their colours are compared, for the same reason
_FAR_MORE = 1.5  # times as many pixels
_SHRINK = 2  # maps are kept at half the photo's size
_ROW = 64  # px, pixels that are asked about one by one are put in rows of so many


@dataclass(frozen=True)
class MultiViewConfig:
    """Whom to ask, and how much their word counts."""

    strength: float = 1.5  # of the discount; 0 = nobody is asked
    views: int = 8  # nearest train views asked
    quantile: float = 0.5  # of what they say: low = a few that can explain the surface are enough
    depth: float = 0.15  # relative difference of depth up to which two views see the same surface
    free: float = 2.0  # units of evidence elsewhere that are normal and discount nothing
    agree: float = (
        0.06  # difference of colour in [0, 1] up to which two photos show the same; 0 = never asked
    )
    agreeing: float = 0.35  # share of the views asked that must show the same for their word to count whole
    known_by: int = 3  # seen by fewer others, a surface is discounted whatever their photos show
    sparse: bool = True  # where fewer see the render's surface, that of the sparse points is asked about
    seen_by: int = 2  # others whose frame holds a place; where fewer do, nothing is masked; 0 = asked nowhere

    def __post_init__(self) -> None:
        check_limits(
            self, "refinesplat.mask.multiview",
            views=(1, math.inf), quantile=(0, 1), agreeing=(1e-6, 1), known_by=(1, math.inf),
            **dict.fromkeys(("strength", "depth", "free", "agree", "seen_by"), (0, math.inf)),
        )  # fmt: skip


@dataclass(frozen=True)
class Hearsay:
    """What other views say of the surfaces of one view, maps [h, w] float32."""

    evidence: np.ndarray  # theirs, at the quantile of the config; NaN where no other view sees the surface
    weight: np.ndarray  # in [0, 1]: how far their photos show what this one shows


class Elsewhere:
    """What every view last said of the surfaces it shows: evidence and depth at half the photo's size."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        photos: Sequence[np.ndarray],
        config: MultiViewConfig,
        surfaces: Sequence[np.ndarray | None] = (),  # inverse depths of the sparse points, or none at all
    ) -> None:
        self.cameras, self.config = list(cameras), config
        self.neighbours = nearest_views(cameras, config.views)
        self.colours = [_small(photo, _half(c)) for photo, c in zip(photos, cameras, strict=True)]
        # view: [h, w] float32 depth of the sparse points' surface, NaN where they say nothing
        self.static = {
            view: 1.0 / cv2.resize(inverse, _half(camera), interpolation=cv2.INTER_NEAREST)
            for view, (camera, inverse) in enumerate(zip(cameras, surfaces))
            if config.sparse and inverse is not None
        }
        self.evidence: dict[int, np.ndarray] = {}  # view: [h, w] float32
        self.depth: dict[int, np.ndarray] = {}  # view: [h, w] float32, along the camera's axis

    def remember(self, view: int, evidence: np.ndarray, depth: np.ndarray) -> None:
        """Take what a view says.

        Args:
            view: which.
            evidence: [H, W] of the photo's size.
            depth: [H', W'] expected depth of the render, of any size.
        """
        size = _half(self.cameras[view])
        wide = cv2.blur(
            np.ascontiguousarray(evidence, dtype=np.float32),
            (_SPREAD, _SPREAD),
            borderType=cv2.BORDER_REPLICATE,
        )
        self.evidence[view] = cv2.resize(wide, size, interpolation=cv2.INTER_AREA)
        self.depth[view] = cv2.resize(depth.astype(np.float32), size, interpolation=cv2.INTER_NEAREST)

    def ask(self, view: int) -> Hearsay | None:
        """What the other views say of the surface that each pixel shows; None before any other was asked."""
        asked = [j for j in self.neighbours[view] if j in self.depth]
        if not asked or view not in self.depth:
            return None
        xyz = _surface(self.cameras[view], self.depth[view])
        evidence, agree = self._all(asked, xyz, self.colours[view])
        self._ask_again(view, asked, evidence, agree)
        return Hearsay(
            quantile_of(evidence, self.config.quantile),
            _weight(np.isfinite(evidence), agree, self.config),
        )

    def _ask_again(self, view: int, asked: list[int], evidence: np.ndarray, agree: np.ndarray) -> None:
        """Where too few see the render's surface, fill in what is said of the sparse points' one."""
        if view not in self.static:
            return
        few = np.isfinite(evidence).sum(axis=0) < self.config.known_by
        at = np.flatnonzero((few & np.isfinite(self.static[view])).ravel())
        if not len(at):
            return
        # as pictures, for OpenCV; the last row's rest repeats the first pixel
        rows = np.pad(at, (0, -len(at) % _ROW), constant_values=at[0]).reshape(-1, _ROW)
        xyz = _surface(self.cameras[view], self.static[view]).reshape(-1, 3)[rows]
        said, same = self._all(asked, xyz, self.colours[view].reshape(-1, 3)[rows], sparse=True)
        evidence.reshape(len(asked), -1)[:, at] = said.reshape(len(asked), -1)[:, : len(at)]
        agree.reshape(len(asked), -1)[:, at] = same.reshape(len(asked), -1)[:, : len(at)]

    def _all(
        self, asked: list[int], xyz: np.ndarray, colour: np.ndarray, *, sparse: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """`_at` of each of the n views asked, [n, h, w] each."""
        heard = [self._at(j, xyz, colour, sparse=sparse) for j in asked]
        return np.stack([e for e, _ in heard]), np.stack([a for _, a in heard])

    def _at(
        self, view: int, xyz: np.ndarray, colour: np.ndarray, *, sparse: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """A view's word on world points [h, w, 3] that have the colours [h, w, 3] uint8 elsewhere.

        Args:
            view: who is asked.
            xyz: the points.
            colour: theirs in the photo that asks.
            sparse: they lie on the sparse points' surface, so seeing that is enough.

        Returns:
            evidence [h, w], NaN where it sees another surface or none; and bool [h, w], where it sees the
            surface in the same colour.
        """
        camera, depth = self.cameras[view], self.depth[view]
        pose = camera.cam_from_world.astype(np.float32)
        local = xyz @ pose[:3, :3].T + pose[:3, 3]
        z = local[..., 2]
        ahead = np.maximum(z, 1e-6)
        sx, sy = depth.shape[1] / camera.width, depth.shape[0] / camera.height
        # pixel centres lie at .5 in our cameras and at whole numbers for OpenCV
        x = (local[..., 0] / ahead * camera.fx + camera.cx) * sx - 0.5
        y = (local[..., 1] / ahead * camera.fy + camera.cy) * sy - 0.5
        x, y = np.clip(x, -9, depth.shape[1] + 9), np.clip(y, -9, depth.shape[0] + 9)
        x, y = x.astype(np.float32), y.astype(np.float32)
        same = self._near(depth, x, y, z)
        if sparse and view in self.static:
            same |= self._near(self.static[view], x, y, z)
        evidence = cv2.remap(self.evidence[view], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        heard = np.where(same, evidence, np.float32(np.nan))
        if self.config.agree <= 0:
            return heard, same
        theirs = cv2.remap(self.colours[view], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return heard, _agree(colour, theirs, same, self.config.agree)

    def _near(self, depth: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Which points of depth z lie on the surface of a depth map, bool; x and y are their places in it."""
        there = cv2.remap(depth, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=-1.0)
        return (z > 0) & (there > 0) & (np.abs(z - there) < self.config.depth * there)


def _agree(ours: np.ndarray, theirs: np.ndarray, same: np.ndarray, most: float) -> np.ndarray:
    """Where two pictures [h, w, 3] uint8 show the same colour, bool [h, w]: at most `most` (of 1) apart.

    What all of `same` have in common (the median difference of each channel) is exposure or weather and no
    other content, but only if far more agree without it: before a crowd it is chance.
    """
    difference = np.subtract(ours, theirs, dtype=np.float32) / np.float32(255.0)
    difference -= common_offset(difference, same, most)
    return same & (np.abs(difference).mean(axis=2) < most)


def common_offset(difference: np.ndarray, same: np.ndarray, most: float = 0.06) -> np.ndarray:
    """What two pictures of the same surfaces differ by everywhere, [3] float32; zeros where that is chance.

    Args:
        difference: [h, w, 3] of their colours in [0, 1].
        same: [h, w] bool, where they show the same surface.
        most: difference up to which two colours are the same.
    """
    some = difference[::2, ::2][same[::2, ::2]]
    if len(some):
        common = np.median(some, axis=0)
        as_they_are = np.count_nonzero(np.abs(some).mean(axis=1) < most)
        if np.count_nonzero(np.abs(some - common).mean(axis=1) < most) > _FAR_MORE * as_they_are:
            return common.astype(np.float32)
    return np.zeros(3, np.float32)


def _weight(seen: np.ndarray, agree: np.ndarray, config: MultiViewConfig) -> np.ndarray:
    """How much the word of the others counts, [h, w] float32 in [0, 1], from bool maps [n, h, w]."""
    count = seen.sum(axis=0)
    share = agree.sum(axis=0) / np.maximum(count, 1)
    weight = np.minimum(share / max(config.agreeing, 1e-6), 1.0)
    return np.where(count < config.known_by, 1.0, weight).astype(np.float32)


def discount(
    evidence: np.ndarray, elsewhere: Hearsay | None, unit: float, config: MultiViewConfig
) -> np.ndarray:
    """Evidence [H, W] over sqrt(1 + strength * excess), excess = weight times what others say above `free`.

    Args:
        evidence: [H, W] >= 0.
        elsewhere: from `Elsewhere.ask`, any size; where its evidence is NaN it says nothing.
        unit: evidence that is normal in the scene.
        config: strength and what is free of it.
    """
    if elsewhere is None or config.strength <= 0 or unit <= 0:
        return evidence
    excess = np.nan_to_num(np.maximum(elsewhere.evidence / unit - config.free, 0.0), nan=0.0)
    excess = (excess * elsewhere.weight).astype(np.float32)
    at_pixels = cv2.resize(excess, evidence.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return evidence / np.sqrt(1.0 + config.strength * at_pixels)


def _half(camera: Camera) -> tuple[int, int]:
    """(width, height) px of the maps that are kept."""
    return max(camera.width // _SHRINK, 1), max(camera.height // _SHRINK, 1)


def _small(photo: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A photo [H, W, 3] in [0, 1] at (width, height), uint8, without what a pixel of depth error moves."""
    blurred = cv2.blur(np.ascontiguousarray(photo), (_BLUR, _BLUR), borderType=cv2.BORDER_REPLICATE)
    small = cv2.resize(blurred, size, interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(small * 255.0), 0, 255).astype(np.uint8)


def quantile_of(stack: np.ndarray, quantile: float) -> np.ndarray:
    """Quantile over the first axis of [n, h, w] of what is not NaN, linear between ranks; NaN where all is.

    One sort: numpy's nanquantile takes fifty times as long on such a stack.
    """
    ordered = np.sort(stack, axis=0)  # NaN goes last
    last = np.maximum((~np.isnan(stack)).sum(axis=0) - 1, 0)
    rank = quantile * last
    low = np.floor(rank).astype(np.int64)
    high = np.minimum(low + 1, last)
    share = (rank - low).astype(np.float32)
    below = np.take_along_axis(ordered, low[None], axis=0)[0]
    above = np.take_along_axis(ordered, high[None], axis=0)[0]
    return below + share * (above - below)


def nearest_views(cameras: Sequence[Camera], count: int) -> list[list[int]]:
    """For each camera the `count` others that look most alike: near, and in the same direction."""
    centres = np.stack([np.linalg.inv(c.cam_from_world)[:3, 3] for c in cameras])
    axes = np.stack([c.cam_from_world[2, :3] for c in cameras])
    result = []
    for view in range(len(cameras)):
        away = np.linalg.norm(centres - centres[view], axis=1)
        score: np.ndarray = away / max(float(np.median(away)), 1e-12) + 2.0 * (1.0 - axes @ axes[view])
        score[view] = np.inf
        order = np.argsort(score, kind="stable")[: min(count, len(cameras) - 1)]
        result.append([int(j) for j in order])
    return result


def _surface(camera: Camera, depth: np.ndarray) -> np.ndarray:
    """World points [h, w, 3] float32 that a depth map [h, w] of the camera shows."""
    h, w = depth.shape
    x = ((np.arange(w, dtype=np.float32) + 0.5) * (camera.width / w) - camera.cx) / camera.fx
    y = ((np.arange(h, dtype=np.float32) + 0.5) * (camera.height / h) - camera.cy) / camera.fy
    local = np.stack([x[None, :] * depth, y[:, None] * depth, depth], axis=2)
    world = np.linalg.inv(camera.cam_from_world).astype(np.float32)
    return local.astype(np.float32) @ world[:3, :3].T + world[:3, 3]
