"""Evidence of other views about the surfaces of one view: multiview.py with torch, all neighbours at once.

A map covers the whole frame of its camera. A position is given in shares of the frame, from -1 to 1, and is
the same in maps of any size. A view without stored evidence has depths of 0, so it matches no surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.multiview import (
    SPREAD,
    MultiViewConfig,
    half_size,
    nearest_views,
    small_colours,
)
from ambiguous_wild.methods.refinesplat.on_device import filters
from ambiguous_wild.methods.refinesplat.on_device.agreement import (
    Ranks,
    agree,
    agreement_weight,
    common_offset,
)
from ambiguous_wild.methods.refinesplat.on_device.maps import Maps, sized


@dataclass(frozen=True)
class MultiViewEvidence:
    """As `multiview.MultiViewEvidence`, on the device."""

    evidence: Tensor  # [h, w] float32; NaN where no other view sees the surface
    weight: Tensor  # [h, w] float32 in [0, 1]


@dataclass(frozen=True)
class _Query:
    """The constants of one view's queries to its n neighbours."""

    neighbours: Tensor  # [n] int64
    right: Tensor  # [n, 3, 1, 1, 1] a step along its own x axis, y axis and z axis in the others' frames
    down: Tensor
    ahead: Tensor
    origin: Tensor
    x: Tensor  # [w] of its rays at depth 1
    y: Tensor  # [h, 1]
    sparse_depth: Tensor | None  # [h, w] of the sparse points' surface, NaN where there is none
    shrink_rows: Tensor  # [h, H] of its evidence, see `filters.blur_and_shrink`
    shrink_columns: Tensor  # [W, w]


class OtherViews:
    """The last evidence of every view about the surfaces it shows, in three stacks of maps."""

    def __init__(
        self,
        cameras: Sequence[Camera],
        photos: Sequence[np.ndarray],  # [H, W, 3] float32 in [0, 1]
        config: MultiViewConfig,
        surfaces: Sequence[np.ndarray | None],
        device: torch.device | str,
    ) -> None:
        self.config = config
        sparse = list(surfaces) if config.sparse and surfaces else [None] * len(cameras)
        self.sizes = [half_size(camera)[::-1] for camera in cameras]  # (height, width)
        near = nearest_views(cameras, config.views)
        self.count = len(near[0])
        self.ranks = Ranks(self.count, config.quantile, device)
        # evidence, and colours from 0 to 255
        stored = [
            np.concatenate([np.zeros((1, *size), np.float32), np.moveaxis(colours, 2, 0).astype(np.float32)])
            for size, photo, camera in zip(self.sizes, photos, cameras, strict=True)
            for colours in [small_colours(photo, half_size(camera))]
        ]
        self.stored = Maps(stored, device, pad="edge")
        self.depth = Maps([np.zeros((1, *size), np.float32) for size in self.sizes], device)
        # 0 until the view has stored evidence, as its depth
        self.known_surfaces = [None if s is None else sized(_depths(s), device) for s in sparse]
        blank = np.zeros((1, 1), np.float32)
        self.surface = Maps([np.zeros_like(blank if s is None else s)[None] for s in sparse], device)
        self.stored_views: set[int] = set()  # views with stored evidence
        self.queries = [
            _query_of(view, cameras, near[view], self.sizes[view], sparse[view], device)
            for view in range(len(cameras))
        ]

    def remember(self, view: int, evidence: Tensor, depth: Tensor) -> None:
        """Store the evidence of a view.

        Args:
            view: which.
            evidence: [H, W] of the photo's size.
            depth: [h, w] of its half, from `halved`.
        """
        own = self.queries[view]
        self.stored.put(view, own.shrink_rows @ evidence @ own.shrink_columns, channel=0)
        self.depth.put(view, depth)
        self._mark_known(view)

    def restore(self, evidence: dict[int, Tensor], depth: dict[int, Tensor]) -> None:
        """Restore the evidence of views from a checkpoint, [h, w] at half their photos' size."""
        for view, known in evidence.items():
            self.stored.put(view, known, channel=0)
            self.depth.put(view, depth[view])
            self._mark_known(view)

    def _mark_known(self, view: int) -> None:
        surface = self.known_surfaces[view]
        if view not in self.stored_views and surface is not None:
            self.surface.put(view, surface)
        self.stored_views.add(view)

    def halved(self, view: int, depth: Tensor) -> Tensor:
        """Expected depth of any size, [h, w] at half the photo's."""
        return filters.nearest(depth, self.sizes[view])

    def ask(self, view: int, depth: Tensor) -> MultiViewEvidence | None:
        """The other views' evidence about the surface that each pixel shows; None if there is no other view.

        The sparse points' surface is looked up everywhere, and used where few views see the render's.

        Args:
            view: the querying view.
            depth: [h, w] of its surface, from `halved`.
        """
        if not self.count:
            return None
        own, config = self.queries[view], self.config
        sparse = own.sparse_depth
        depths = depth[None] if sparse is None else torch.stack([depth, sparse])
        surfaces, (h, w) = len(depths), depth.shape
        points = torch.addcmul(own.origin, self._rays(own), depths)  # [n, 3, surfaces, h, w]
        z = points[:, 2]
        # far outside is clamped to a little outside, so that every pixel index fits
        places = (points[:, :2] / z[:, None].clamp(min=1e-6)).clamp_(-2.0, 2.0)
        near = places.reshape(self.count, 2, surfaces * h, w).permute(0, 2, 3, 1)
        same = self._near(self.depth.nearest(own.neighbours, near)[:, 0].view(z.shape), z)
        if surfaces > 1:
            surface = self.surface.nearest(own.neighbours, near[:, h:])[:, 0]
            same[:, 1] |= self._near(surface, z[:, 1])
        theirs = self.stored.linear(own.neighbours, near).view(self.count, 4, surfaces, h, w)
        evidence = torch.where(same, theirs[:, 0], torch.nan)
        agreeing = same
        if config.agree > 0:
            difference = self.stored.of(view)[1:, None] - theirs[:, 1:].round_()
            offset = common_offset(difference[:, :, 0, ::2, ::2], same[:, 0, ::2, ::2], config.agree)
            agreeing = agree(difference, same, config.agree, offset)
        return self._put_together(evidence, same.sum(0), agreeing.sum(0))

    def _put_together(self, evidence: Tensor, seen: Tensor, agreed: Tensor) -> MultiViewEvidence:
        """Combine evidence [n, s, h, w] and counts [s, h, w] of the render's surface and the sparse one."""
        few = seen[0] < self.config.known_by
        if len(seen) > 1:
            again = few & (seen[1] > seen[0])
            found = torch.where(again, evidence[:, 1], evidence[:, 0])
            counts = torch.stack([seen, agreed])
            seen, agreed = torch.where(again, counts[:, 1], counts[:, 0])
            few = few & ~again
        else:
            found, seen, agreed = evidence[:, 0], seen[0], agreed[0]
        return MultiViewEvidence(
            self.ranks.quantile_of(found, seen), agreement_weight(seen, agreed, self.config.agreeing, few)
        )

    def _rays(self, own: _Query) -> Tensor:
        """Directions of the view's pixels in the frames of its neighbours, [n, 3, 1, h, w]."""
        return torch.addcmul(torch.addcmul(own.ahead, own.down, own.y), own.right, own.x)

    def _near(self, there: Tensor, z: Tensor) -> Tensor:
        """As `multiview.OtherViews._near`; `there` 0 = none."""
        return ((z - there).abs() < self.config.depth * there) & (z > 0)


def discount(
    evidence: Tensor, others: MultiViewEvidence | None, unit: Tensor, config: MultiViewConfig
) -> Tensor:
    """As `multiview.discount`, [H, W] of evidence [H, W]; unit 0-d, above 0."""
    if others is None:
        return evidence
    excess = (others.evidence / unit - config.free).clamp_(min=0.0) * others.weight
    at_pixels = filters.resized(excess.nan_to_num_(nan=0.0), (evidence.shape[0], evidence.shape[1]))
    return evidence / (1.0 + config.strength * at_pixels).sqrt_()


def _query_of(
    view: int,
    cameras: Sequence[Camera],
    near: Sequence[int],
    size: tuple[int, int],
    inverse: np.ndarray | None,
    device: torch.device | str,
) -> _Query:
    camera, (h, w) = cameras[view], size
    world_from_own = np.linalg.inv(camera.cam_from_world)
    frames = np.zeros((len(near), 3, 4))
    for row, other in enumerate(near):
        o = cameras[other]
        pose = o.cam_from_world @ world_from_own
        frames[row, 0] = 2.0 * o.fx / o.width * pose[0] + (2.0 * o.cx / o.width - 1.0) * pose[2]
        frames[row, 1] = 2.0 * o.fy / o.height * pose[1] + (2.0 * o.cy / o.height - 1.0) * pose[2]
        frames[row, 2] = pose[2]
    right, down, ahead, origin = (
        sized(np.ascontiguousarray(frames[:, :, k, None, None, None]), device) for k in range(4)
    )
    x = ((np.arange(w) + 0.5) * (camera.width / w) - camera.cx) / camera.fx
    y = ((np.arange(h) + 0.5) * (camera.height / h) - camera.cy) / camera.fy
    sparse = None
    if inverse is not None:
        with np.errstate(divide="ignore"):
            sparse = 1.0 / cv2.resize(inverse, (w, h), interpolation=cv2.INTER_NEAREST)
    return _Query(
        neighbours=torch.from_numpy(np.array(near, np.int64)).to(device),
        right=right,
        down=down,
        ahead=ahead,
        origin=origin,
        x=sized(x, device),
        y=sized(y[:, None], device),
        sparse_depth=None if sparse is None else sized(sparse, device),
        shrink_rows=sized(filters.blur_and_shrink(camera.height, h, SPREAD), device),
        shrink_columns=sized(filters.blur_and_shrink(camera.width, w, SPREAD).T.copy(), device),
    )


def _depths(inverse: np.ndarray) -> np.ndarray:
    """Depths of a map of inverse ones, float32; 0 where nothing is known."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(inverse > 0, 1.0 / inverse, 0.0).astype(np.float32)
