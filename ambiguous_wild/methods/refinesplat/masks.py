"""Local, global and final masks of one photo (RefineSplat, Eqs. 3-7), and the masks of all photos.

Masks are bool, True = transient; keep = 1 - M_final. Statistics are in float64. What `renew` calls reads no
value on the host, so its shapes and the number of its launches depend on sizes alone; set-up, checkpoints and
pictures do read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.methods.refinesplat.config import MaskConfig, RefineSplatConfig
from ambiguous_wild.methods.refinesplat.evidence import Maps, global_of, scaled_by
from ambiguous_wild.methods.refinesplat.first_look import FirstLook
from ambiguous_wild.methods.refinesplat.maps import sized
from ambiguous_wild.methods.refinesplat.pixels import PixelEvidence, grown, hysteresis
from ambiguous_wild.methods.refinesplat.ranks import spread_of
from ambiguous_wild.methods.refinesplat.threshold import Cut, Pool, learnt, pool_of, t_ent
from ambiguous_wild.splat.backend import backend_of

if TYPE_CHECKING:
    from ambiguous_wild.splat.step import Step

PRICE = 3.0  # of a masked pixel, robust deviations above the median distance, if `disagree` is off


@dataclass(frozen=True)
class Masks:
    """Masks of one photo, and what they were made from."""

    local: Tensor  # [H, W] bool
    global_: Tensor  # [H, W] bool
    keep: Tensor  # [H, W] float32, 1 - M_final, bounded
    means: Tensor  # [K] float64, mean statistic of every instance, NaN where there is none
    distances: Tensor  # [K] float64, mean distance in units
    cut: Cut
    pool: Pool  # what the threshold cut

    def shares(self) -> Tensor:
        """Masked in all, locally and globally, and T_ent: [4] float64."""
        masked = torch.stack([self.keep < 0.5, self.local, self.global_]).double().mean((1, 2))
        return torch.cat([masked, self.cut.threshold[None]])


@dataclass(frozen=True)
class Judged:
    """Statistics of the instances of one photo when its mask was last made, for pictures."""

    values: np.ndarray  # [K] float64, mean statistic (Hbar)
    distances: np.ndarray  # [K] float64, mean distance in units
    areas: np.ndarray  # [K] float64, px


def enlarge(grid: Tensor, height: int, width: int) -> Tensor:
    """A map [h, w] on the image's pixels [H, W], each taking its cell's value."""
    if grid.shape == (height, width):
        return grid
    rows = (torch.arange(height, device=grid.device) * grid.shape[0]) // height
    columns = (torch.arange(width, device=grid.device) * grid.shape[1]) // width
    return grid[rows[:, None], columns[None, :]]


def instance_means(grid: Tensor, labels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Hbar of labels 1..count (Eq. 3), each cell weighted by the instance's area in it.

    Args:
        grid: [h, w], e.g. the entropy map.
        labels: [H, W] int32, instances from 1; 0 and negative labels are none.
        count: of the labels.

    Returns:
        means [count] float64 (NaN for a label without pixels), areas [count] px, float64.
    """
    flat, backend = labels.clamp(min=0).flatten(), backend_of(labels.device)
    areas = backend.label_sums(flat, count + 1)[1 : count + 1]
    values = enlarge(grid.double(), *labels.shape).flatten()
    sums = backend.label_sums(flat, count + 1, values)[1 : count + 1]
    return sums / areas.masked_fill(areas == 0, torch.nan), areas


class Labels:
    """The instances of every photo; K is the largest number of them."""

    def __init__(
        self,
        labels: Sequence[np.ndarray],  # [H, W] int32, 0 = none
        static: Sequence[np.ndarray],  # [K of the photo] bool, not to be masked
        unseen: Sequence[np.ndarray | None],  # [H, W] bool, not to be judged
        device: torch.device | str,
    ) -> None:
        self.shapes = [label.shape for label in labels]
        counts = [len(s) for s in static]
        self.most = max([*counts, 1])
        clean = [
            np.where((label > 0) & (True if u is None else ~u), label, 0)
            for label, u in zip(labels, unseen, strict=True)
        ]
        self.of_pixel = [torch.from_numpy(label.astype(np.int32).ravel()).to(device) for label in clean]
        areas = np.full((len(clean), self.most), np.nan)
        flags = np.zeros((len(clean), self.most), bool)
        for view, (label, count) in enumerate(zip(clean, counts)):
            areas[view, :count] = np.bincount(label.ravel(), minlength=count + 1)[1 : count + 1]
            flags[view, :count] = static[view]
        areas[areas == 0] = np.nan
        self.known = np.isfinite(areas)  # [views, K]
        self.areas = torch.from_numpy(areas).to(device)  # [views, K] float64 px, NaN where there is none
        self.static_flags = torch.from_numpy(flags).to(device)  # [views, K]
        # view: [H, W] bool, its static instances by structure from motion; only views that have some
        self.static = {
            view: torch.from_numpy(np.r_[False, flags[view]][label]).to(device)
            for view, label in enumerate(clean)
            if flags[view].any()
        }

    def means(self, view: int, pixels: Tensor) -> Tensor:
        """Mean of a map [H, W] over every instance, [K] float64; NaN where there is none."""
        backend = backend_of(pixels.device)
        sums = backend.label_sums(self.of_pixel[view], self.most + 1, pixels.double().flatten())
        return sums[1:] / self.areas[view]

    def on_pixels(self, view: int, values: Tensor, shape: tuple[int, ...]) -> Tensor:
        """A value of each instance [K] at its pixels [H, W]; 0 where there is none."""
        return F.pad(values, (1, 0)).index_select(0, self.of_pixel[view]).view(shape)


def make_masks(
    view: int,
    maps: Maps,
    labels: Labels,
    others: tuple[Tensor, Tensor],
    w2: Tensor | float,
    config: MaskConfig,
    ceiling: Tensor | None = None,
    seen: Tensor | None = None,
) -> Masks:
    """M_local, M_global and the keep map of one photo (Eqs. 3-7).

    Args:
        view: of the photo.
        maps: of the photo, on its pixels or on the feature grid.
        labels: instances of all photos.
        others: [views, K] float64 each: means and distances of all photos' instances when they were last
            judged (`scope` = scene), NaN = none; the row of this view is not read.
        w2: weight of T_ent's lower subset.
        config: thresholds.
        ceiling: 0-d, upper limit of the threshold; None: no limit.
        seen: [H, W] bool, pixels that may be masked; None: all.
    """
    height, width = shape = labels.shapes[view]
    pixels = enlarge(maps.statistic, height, width)
    means = distances = labels.means(view, pixels)
    if maps.distance is not maps.statistic:
        distances = labels.means(view, enlarge(maps.distance, height, width))
    values = [means, distances]
    if config.scope == "scene":
        values = [_with_row(rows, view, row).view(-1) for rows, row in zip(others, values)]
    pool = pool_of(values[0])
    cut = t_ent(pool, w2, config.threshold, config.gate, config.floor, config.hard).below(ceiling)
    flagged = means > cut.threshold
    if config.statistic != "structure" and config.disagree > 0:
        # an instance whose identity psi is unsure of is no distractor if the render agrees with the photo
        middle, spread = spread_of(values[1])
        flagged &= distances > (middle + config.disagree * spread).clamp(min=config.disagree_units)
    static = labels.static.get(view)
    if static is not None:
        flagged = flagged & ~labels.static_flags[view]
    nothing = torch.zeros(shape, dtype=torch.bool, device=pixels.device)
    local = labels.on_pixels(view, flagged, shape) if config.use_local else nothing
    weak, strong = config.hold * cut.threshold, cut.threshold
    judging, fused = pixels, config.combine == "fused" and config.use_local and config.use_global
    regions = [pixels] if config.use_global and config.statistic == "structure" else []
    if fused:
        of_instance = labels.on_pixels(view, means.nan_to_num(nan=0.0), shape)
        # a pixel without an instance is judged alone
        inside = labels.of_pixel[view].view(shape) > 0
        judging = torch.where(inside, (pixels * of_instance).sqrt_(), pixels)
        regions.append(judging)
    # the default asks for two sets of regions at once
    found = list(hysteresis(torch.stack([r.double() for r in regions]), weak, strong)) if regions else []
    global_ = nothing
    if config.use_global:
        global_ = found[0] if config.statistic == "structure" else enlarge(global_of(maps, config), *shape)
    final = found[-1] if fused else local | global_
    if static is not None:
        # the union contains none of them
        final, global_ = final & ~static, global_ & ~static
    if seen is not None:
        final = final & seen
    final = grown(final, config, judging)
    if seen is not None:
        final = final & seen
    return Masks(local, global_, (~final).float(), means, distances, cut, pool)


def _with_row(rows: Tensor, view: int, row: Tensor) -> Tensor:
    rows = rows.clone()
    rows[view].copy_(row)
    return rows


class MaskStore:
    """Masks of all views, with what they are computed from beside the render, and the learnt w2."""

    def __init__(
        self,
        config: RefineSplatConfig,
        photos: Sequence[np.ndarray],  # [H, W, 3] float32 in [0, 1]
        cameras: Sequence[Camera],
        surfaces: Sequence[np.ndarray | None],  # inverse depths of the sparse points
        looks: Mapping[int, FirstLook],
        labels: Sequence[np.ndarray],  # [H, W] int32 instances, 0 = none
        static: Sequence[np.ndarray],  # [K of the photo] bool, not to be masked
        device: torch.device | str,
        compare: Callable[[Step], Maps],  # on the feature grid; called only if the statistic needs it
        tensors: Sequence[Tensor] | None = None,  # the photos, if they are on the device already
    ) -> None:
        self.config, self.compare = config, compare
        self.pixels = PixelEvidence(photos, cameras, surfaces, config.mask, device, tensors)
        structure = config.mask.statistic == "structure"
        # features are judged on their whole grid
        unseen = self.pixels.unseen_on_host if structure else [None] * len(photos)
        self.labels = Labels(labels, static, unseen, device)
        # view: [H, W], factor of its evidence; absent if that is 1
        self.factors = {
            view: sized(look.factor(photos[view].shape[:2]), device)
            for view, look in looks.items()
            if look.weight != 1
        }
        self.limited = {view: config.mask.limited(look.most) for view, look in looks.items()}
        self.keeps: dict[int, Tensor] = {}  # view: [H, W] float32; of the views that have a mask
        wide, views = torch.float64, len(photos)
        # [views, K] mean of every instance when its mask was last made, NaN where there is none
        self.means = torch.full((views, self.labels.most), torch.nan, dtype=wide, device=device)
        self.distances = self.means if structure else self.means.clone()
        self._shares = torch.zeros((views, 4), dtype=wide, device=device)
        self.theta = torch.zeros((), dtype=wide, device=device)  # w2 = sigmoid(theta)

    @torch.no_grad()
    def renew(self, step: Step) -> None:
        """Compute the mask of the step's view, store its evidence for other views, and learn w2."""
        view, config = step.view, self.config.mask
        _, made = self.examine(step, remember=True)
        self.means[view].copy_(made.means)
        self.distances[view].copy_(made.distances)
        if config.w2 is None:
            self._learn(view, made)
        self.keeps[view] = made.keep
        self._shares[view].copy_(made.shares())

    def _learn(self, view: int, made: Masks) -> None:
        """w2 from all instances; the price of a masked pixel is a robustly high distance."""
        config = self.config.mask
        rows = slice(None) if config.scope == "scene" else slice(view, view + 1)
        # instances of photos without a mask yet have no value: they teach nothing
        judged = ~self.means[rows].isnan()
        areas = self.labels.areas[rows].masked_fill(~judged, torch.nan).reshape(-1)
        distances = self.distances[rows].reshape(-1)
        middle, spread = (
            (made.pool.middle, made.pool.spread) if self.distances is self.means else spread_of(distances)
        )
        price = middle + (max(config.disagree, 1.0) if config.disagree > 0 else PRICE) * spread
        costs = distances / price.clamp(min=1e-12)
        self.theta = learnt(self.theta, made.pool, costs, areas, made.cut.floor, config.threshold)

    @torch.no_grad()
    def examine(self, step: Step, *, remember: bool = False) -> tuple[Maps, Masks]:
        """The maps of the step's view and its masks at the photo's own size.

        Args:
            step: of any train view.
            remember: whether the evidence is stored for other views; else nothing is kept.
        """
        view, rendered = step.view, step.rendered
        mask = self.limited.get(view, self.config.mask)
        ceiling = seen = None
        if mask.statistic == "structure":
            image, alpha, depth = (t.detach() for t in (rendered.image, rendered.alpha, rendered.depth))
            evidence, unit = self.pixels.look(view, image, alpha, depth, remember=remember)
            if view in self.factors:
                evidence = evidence * self.factors[view]
            if mask.entropy_weight > 0:
                evidence = scaled_by(evidence, self.compare(step).statistic, mask.entropy_weight)
            maps = Maps(evidence, evidence)
            seen, ceiling = self.pixels.seen[view], self.pixels.ceiling(unit)
        else:
            maps = self.compare(step)
        w2 = torch.sigmoid(self.theta) if mask.w2 is None else mask.w2
        others = self.means, self.distances
        return maps, make_masks(view, maps, self.labels, others, w2, mask, ceiling, seen)

    @property
    def w2(self) -> float:
        """Weight of T_ent's lower subset, learnt or fixed."""
        return float(torch.sigmoid(self.theta)) if self.config.mask.w2 is None else self.config.mask.w2

    @property
    def judged(self) -> dict[int, Judged]:
        """View: its instances when its mask was last made."""
        means, distances, areas = (t.cpu().numpy() for t in (self.means, self.distances, self.labels.areas))
        known = self.labels.known
        return {v: Judged(*(rows[v, known[v]] for rows in (means, distances, areas))) for v in self.keeps}

    @property
    def shares(self) -> dict[int, tuple[float, float, float, float]]:
        """View: masked in all, locally, globally, and T_ent."""
        rows = self._shares.tolist()
        return {view: tuple(rows[view]) for view in self.keeps}

    def state_dict(self) -> dict[str, Any]:
        return {
            "keeps": {str(view): (keep > 0.5).to(torch.uint8) for view, keep in self.keeps.items()},
            # stored as text: T_ent is inf if no instance is an outlier, and JSON has no inf
            "shares": {str(view): [repr(x) for x in row] for view, row in self.shares.items()},
            "judged": {
                str(view): torch.from_numpy(np.stack([j.values, j.distances, j.areas]))
                for view, j in self.judged.items()
            },
            "theta": float(self.theta),
            "pixels": self.pixels.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        device = self.theta.device
        shares = np.zeros(self._shares.shape)
        for view, row in state["shares"].items():
            shares[int(view)] = [float(x) for x in row]
        rows = np.full((2, *self.means.shape), np.nan)
        for view, found in state["judged"].items():
            rows[:, int(view), self.labels.known[int(view)]] = found[:2].cpu().numpy()
        self.keeps = {int(v): keep.float().to(device) for v, keep in state["keeps"].items()}
        self._shares = torch.from_numpy(shares).to(device)
        same = self.distances is self.means
        self.means = torch.from_numpy(rows[0]).to(device)
        self.distances = self.means if same else torch.from_numpy(rows[1]).to(device)
        self.theta = torch.full_like(self.theta, float(state["theta"]))
        self.pixels.load_state_dict(state["pixels"])
