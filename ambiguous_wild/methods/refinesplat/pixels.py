"""Evidence of a distractor at every pixel of a photo, and the regions of masks that are made of it.

Evidence is in units of what is normal in the scene. Regions are made by hysteresis, filling of gaps, growth
and a limit of the mask's size.

Connected components are OpenCV's on the CPU. On an accelerator a fixed number of rounds finds them, without
loops that depend on values. Every pixel points to a pixel of its own component, at first to the largest among
itself and its neighbours. A round takes the largest pointer among each pixel's neighbours, points the pixel's
own target to it, and follows all pointers three times (FastSV: Zhang, Azad, Buluc 2020). Pointers only grow,
so unconnected pixels are never joined; too few rounds would leave a component in two parts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import State
from ambiguous_wild.methods.masking_common import resized
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig
from ambiguous_wild.methods.refinesplat.maps import EnlargedMaps, low_quantile, median
from ambiguous_wild.methods.refinesplat.multiview import MultiViewStore, discount
from ambiguous_wild.methods.refinesplat.structure import structure_residual, unrelated_pair_residual
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.vision.sparse_surface import rarely_covered

GAPS = 1.25  # a mask with filled gaps may be this many times its limit
_JUMPS = 3  # three jumps need half as many rounds as one; more do not help
# Needed at 504 x 378 px, 4 or 8 neighbours, mirrored or not: 7 by 6 of 49 mazes and 6 by the others and by
# Hilbert curves, 5 by spirals, serpentines, combs and stairs, 5 by random pixels of any density, 4 by blobs;
# 7 by a maze of four times the pixels. A round leaves the local maxima of the parts that touch, so the number
# grows with the logarithm of the pixels at most.
_ROUNDS = 8
_ROUNDS_PIXELS = 504 * 378
_FLOAT32_EXACT = 1 << 24
STATIC_QUANTILE = 0.25  # pixels at this quantile are static even if distractors cover two thirds


def rounds_for(pixels: int) -> int:
    """Return a sufficient number of rounds for a photo of this many pixels."""
    return _ROUNDS + max(math.ceil(math.log(pixels / _ROUNDS_PIXELS, 4)), 0)


def components(masks: Tensor, connectivity: int) -> Tensor:
    """Number the components of masks [n, H, W] bool on a GPU, [n * H * W] int64 from 1 on; 0 = in no mask."""
    pixels = masks.numel()
    # pooling needs floating point
    dtype = torch.float32 if pixels < _FLOAT32_EXACT else torch.float64
    inside = masks.reshape(-1).long()
    own = torch.arange(1, pixels + 1, dtype=dtype, device=masks.device) * inside
    slots = torch.arange(1, pixels + 1, device=masks.device)
    labels = F.pad(_largest_around(own.view(masks.shape), connectivity, dtype) * inside, (1, 0))
    for _ in range(rounds_for(masks[0].numel())):
        for _ in range(_JUMPS):
            labels = labels.take(labels)
        around = _largest_around(labels[1:].view(masks.shape), connectivity, dtype) * inside
        # pixels without a larger label write to themselves: thousands would wait for the slot of one root
        target = torch.where(around > labels[1:], labels[1:], slots)
        labels = labels.scatter_reduce(0, target, around, "amax")
    for _ in range(_JUMPS):
        labels = labels.take(labels)
    return labels[1:]


def hysteresis(values: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the connected regions above `low` that somewhere exceed `high` (Canny's rule).

    Args:
        values: [n, H, W].
        low: 0-d, at most `high`.
        high: 0-d.

    Returns:
        [n, H, W] bool.
    """
    if backend_of(values.device).kernels:
        return torch.stack([_reached(weak, strong) for weak, strong in zip(values > low, values > high)])
    labels = components(values > low, 8)
    # a strong pixel is also weak, so it lies in a component; all others write to slot 0
    reached = torch.zeros(labels.numel() + 1, dtype=torch.bool, device=values.device)
    reached.scatter_(0, labels * (values > high).view(-1), True)
    reached[:1] = False
    return reached[labels].view(values.shape)


def _reached(weak: Tensor, strong: Tensor) -> Tensor:
    count, labels = cv2.connectedComponents(weak.byte().numpy(), connectivity=8)
    reached = np.zeros(count, bool)
    reached[labels[strong.numpy()]] = True
    return torch.from_numpy(reached[labels])


def fill_holes(mask: Tensor, share: float) -> Tensor:
    """Fill the enclosed gaps of a mask [H, W] bool that are smaller than `share` of the photo."""
    if share <= 0:
        return mask
    if backend_of(mask.device).kernels:
        _, gaps, statistics, _ = cv2.connectedComponentsWithStats((~mask).byte().numpy(), connectivity=4)
        small = statistics[:, cv2.CC_STAT_AREA] < share * mask.numel()
        return mask | torch.from_numpy(small[gaps])
    labels = components(~mask[None], 4)
    areas = labels.new_zeros(labels.numel() + 1).scatter_add_(0, labels, torch.ones_like(labels))
    return mask | (areas[labels] < share * mask.numel()).view(mask.shape)


def dilate(mask: Tensor, size: int) -> Tensor:
    """Grow a mask [H, W] bool by a size x size square, `size` odd; 1 changes nothing."""
    if size <= 1:
        return mask
    return F.max_pool2d(mask[None].float(), size, 1, size // 2)[0] > 0.5


def final_mask(masked: Tensor, config: MaskConfig, evidence: Tensor) -> Tensor:
    """Make M_final [H, W] bool: limit the mask's size, fill its gaps, dilate it.

    If the mask is too large, its surest pixels stay. Their gaps are filled too, because a mask with specks
    lets a distractor through; then the mask may be a quarter larger (`GAPS`).

    Args:
        masked: pixels above the threshold, [H, W] bool.
        config: `most`, the largest share of the photo that is masked; `fill`, `dilation`.
        evidence: [H, W], larger = surer.
    """
    size = masked.numel()
    surest = torch.where(masked, evidence, -torch.inf).flatten()
    cut = surest.kthvalue(size + 1 - max(int(config.most * size), 1)).values
    too_many = masked.sum() > config.most * size
    chosen = masked & ((evidence > cut) | ~too_many)
    larger = dilate(fill_holes(chosen, config.fill), config.dilation)
    return torch.where(too_many & (larger.sum() > GAPS * config.most * size), chosen, larger)


def _largest_around(labels: Tensor, connectivity: int, dtype: torch.dtype) -> Tensor:
    """Return the largest of labels [n, H, W] among each pixel and its 4 or 8 neighbours, flat int64."""
    x = labels.to(dtype)
    if connectivity == 8:
        return F.max_pool2d(x, 3, 1, 1).long().view(-1)
    upright, level = F.max_pool2d(x, (3, 1), 1, (1, 0)), F.max_pool2d(x, (1, 3), 1, (0, 1))
    return torch.maximum(upright, level).long().view(-1)


class PixelEvidence:
    """The structure residual of each view, discounted by other views' evidence about the same surface."""

    def __init__(
        self,
        photos: Sequence[Tensor],  # [H, W, 3] float32 in [0, 1] on `device`
        cameras: Sequence[Camera],
        surfaces: Sequence[np.ndarray | None],  # inverse depths of the sparse points, or none at all
        config: MaskConfig,
        device: torch.device | str,
    ) -> None:
        self.config = config
        self.photos = photos
        on_host = (photo.cpu().numpy() for photo in photos)  # one at a time: all may not fit
        self.other_views = MultiViewStore(cameras, on_host, config.multiview, surfaces, device)
        unseen = rarely_covered(cameras, surfaces, config.multiview.seen_by) or [None] * len(cameras)
        # [H, W] bool of each view: pixels that enough other photos see; None: all
        self.seen = EnlargedMaps(
            lambda view: _seen(unseen[view], (cameras[view].height, cameras[view].width)),
            len(cameras),
            device,
        )
        self.unrelated = unrelated_pair_residual(photos, config.base)
        # normal residual of each view's static pixels; NaN before the first `compute`
        self.normal = torch.full((len(photos),), torch.nan, dtype=torch.float64, device=device)
        # view -> its residual, averaged over its visits, [H, W] float16
        self.before: dict[int, Tensor] = {}

    def compute(
        self, view: int, image: Tensor, alpha: Tensor, depth: Tensor, *, store: bool
    ) -> tuple[Tensor, Tensor]:
        """Return the evidence of a view in units, and the unit.

        Args:
            view: index of the photo.
            image: render of its camera, [h, w, 3], any size.
            alpha: opacity of the render, [h, w]; below `least_alpha` there is no evidence.
            depth: sum of weight times z, [h, w].
            store: whether to store the evidence for other views.

        Returns:
            Evidence [H, W] float32 at the photo's size, and the unit, 0-d float64.
        """
        photo, config = self.photos[view], self.config
        size = photo.shape[:2]
        judged, seen = resized(alpha, *size) >= config.least_alpha, self.seen[view]
        left_out = ~(judged if seen is None else judged & seen)
        image = resized(image, *size)
        evidence = structure_residual(photo, image, config.base)
        evidence = evidence.masked_fill_(left_out, 0.0)
        if config.memory > 0 and view in self.before:
            evidence = torch.lerp(evidence, self.before[view].float(), config.memory)
        normal, count = low_quantile(evidence, left_out, STATIC_QUANTILE)
        others = None
        if config.multiview.strength > 0:
            mean_depth = depth / alpha.clamp(min=1e-3) * (alpha > 1e-3)
            halved = self.other_views.halved(view, mean_depth)
            others = self.other_views.query(view, halved, image)
            if store:
                self.other_views.store(view, evidence, halved)
        if store:
            self.normal[view].copy_(torch.where(count > 0, normal, self.normal[view]))
            if config.memory > 0:
                self.before[view] = evidence.half()
        unit = self._unit(normal)
        return discount(evidence, others, unit, config.multiview) / unit, unit

    def ceiling(self, unit: Tensor) -> Tensor | None:
        """Return the upper limit of thresholds in the unit of `compute`, 0-d; None: no limit.

        It is the share `ceiling` of the residual of unrelated pictures, but at least `ceiling_least`, because
        while little is learnt every pixel has such a residual.
        """
        share = self.config.ceiling
        if share <= 0 or self.unrelated <= 0:
            return None
        return (share * self.unrelated / unit).clamp_(min=self.config.ceiling_least)

    def _unit(self, normal: Tensor) -> Tensor:
        """Return the normal residual of the scene, the median over views; that of this view before any."""
        scene = median(self.normal)
        # a perfect render of a synthetic scene has no noise at all
        return torch.where(scene > 0, scene, normal).clamp_(min=1e-4)

    def state_dict(self) -> State:
        others, normal = self.other_views, self.normal.tolist()
        views = sorted(others.stored_views)
        return {
            "normal": {str(v): x for v, x in enumerate(normal) if not math.isnan(x)},
            "before": {str(v): x.cpu() for v, x in self.before.items()},
            "evidence": {str(v): others.evidence.of(v)[0].cpu().contiguous() for v in views},
            "depth": {str(v): others.depth.of(v)[0].cpu().contiguous() for v in views},
        }

    def load_state_dict(self, state: State) -> None:
        device = self.normal.device
        normal = np.full(len(self.photos), np.nan)
        for view, x in state["normal"].items():
            normal[int(view)] = x
        self.normal = torch.from_numpy(normal).to(device)
        self.before = {int(v): x.to(device) for v, x in state["before"].items()}
        self.other_views.restore(
            {int(v): x.to(device) for v, x in state["evidence"].items()},
            {int(v): x.to(device) for v, x in state["depth"].items()},
        )


def _seen(unseen: np.ndarray | None, size: tuple[int, int]) -> np.ndarray | None:
    """Return where a photo of this size (height, width) is seen, from a coarse bool map; None: everywhere."""
    if unseen is None or not unseen.any():
        return None
    return cv2.resize(unseen.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) == 0
