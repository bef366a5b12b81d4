"""Local, global and final masks of one photo (RefineSplat, Eqs. 3-7), and the masks of all photos.

M_local, M_global and M_final are bool, True on distractors, as in the paper; outside of this package masks
are keep maps, 1 - M_final. Statistics are in float64. Code that `renew` calls reads
no value on the host, so shapes and the number of launches depend on sizes alone; set-up, checkpoints and
pictures read values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.config import State
from ambiguous_wild.methods.refinesplat.evidence import (
    ComparisonMaps,
    global_mask_from_maps,
    scale_by_identities,
)
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig, RefineSplatConfig
from ambiguous_wild.methods.refinesplat.maps import EnlargedMaps, spread_of
from ambiguous_wild.methods.refinesplat.mask_prior import InitialMaskPrior
from ambiguous_wild.methods.refinesplat.pixels import PixelEvidence, final_mask, hysteresis
from ambiguous_wild.methods.refinesplat.threshold import (
    InstanceStats,
    Threshold,
    instance_stats,
    t_ent,
    updated_theta,
)
from ambiguous_wild.splat.backend import backend_of

if TYPE_CHECKING:
    from ambiguous_wild.splat.step import Step, TrainData

# shares of an instance, masked of its maskable pixels and maskable of all, from which the rest is masked
WHOLE, JUDGED = 0.6, 0.3
PRICE = 3.0  # cost of a masked pixel, in MADs above the median distance, if `disagree` is off


@dataclass(frozen=True)
class PhotoMasks:
    """Masks of one photo, and the statistics that they were made from."""

    local: Tensor  # [H, W] bool, M_local
    global_: Tensor  # [H, W] bool, M_global
    keep: Tensor  # [H, W] float32, 1 - M_final, bounded
    means: Tensor  # [K] float64, mean statistic of every instance, NaN for missing ones
    distances: Tensor  # [K] float64, mean distance in units
    cut: Threshold
    pool: InstanceStats  # instances that the threshold divided

    def shares(self) -> Tensor:
        """Return the shares masked in all, locally and globally, and T_ent, [4] float64."""
        masked = torch.stack([self.keep < 0.5, self.local, self.global_]).double().mean((1, 2))
        return torch.cat([masked, self.cut.threshold[None]])


@dataclass(frozen=True)
class InstanceStatistics:
    """Statistics of a photo's instances when its mask was last made, for pictures."""

    values: np.ndarray  # [K] float64, mean statistic (Hbar)
    distances: np.ndarray  # [K] float64, mean distance in units
    areas: np.ndarray  # [K] float64, px


def enlarge(grid: Tensor, height: int, width: int) -> Tensor:
    """Enlarge a map [h, w] to pixels [H, W], each with the value of its cell."""
    if grid.shape == (height, width):
        return grid
    rows = (torch.arange(height, device=grid.device) * grid.shape[0]) // height
    columns = (torch.arange(width, device=grid.device) * grid.shape[1]) // width
    return grid[rows[:, None], columns[None, :]]


def instance_means(grid: Tensor, labels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return Hbar of labels 1..count (Eq. 3), each cell weighted by the instance's area in it.

    Args:
        grid: [h, w], e.g. the entropy map.
        labels: [H, W] int, instances from 1; 0 and negative labels are none.
        count: number of labels.

    Returns:
        means [count] float64 (NaN for a label without pixels), areas [count] px, float64.
    """
    flat, backend = labels.int().clamp(min=0).flatten(), backend_of(labels.device)
    areas = backend.label_sums(flat, count + 1)[1 : count + 1]
    values = enlarge(grid.double(), *labels.shape).flatten()
    sums = backend.label_sums(flat, count + 1, values)[1 : count + 1]
    return sums / areas.masked_fill(areas == 0, torch.nan), areas


class InstanceLabels:
    """The instances of every photo; K is the largest number in a photo."""

    def __init__(
        self,
        labels: Sequence[np.ndarray],  # [H, W] int, 0 = none
        static: Sequence[np.ndarray],  # [K of the photo] bool, must not be masked
        seen: Iterable[np.ndarray | None],  # [H, W] bool, may be judged
        device: torch.device | str,
    ) -> None:
        self.shapes = [label.shape for label in labels]
        counts = [len(s) for s in static]
        self.most = max([*counts, 1])
        whole = [np.where(label > 0, label, 0).astype(label_dtype(self.most)) for label in labels]
        clean = [w if s is None else np.where(s, w, 0) for w, s in zip(whole, seen, strict=True)]
        self._of_pixel = [torch.from_numpy(label.ravel()).to(device) for label in clean]
        # also of pixels that may not be judged
        self._all = [
            judged if w is c else torch.from_numpy(w.ravel()).to(device)
            for judged, w, c in zip(self._of_pixel, whole, clean)
        ]
        areas = np.full((len(clean), self.most), np.nan)
        flags = np.zeros((len(clean), self.most), bool)
        for view, (label, count) in enumerate(zip(clean, counts)):
            areas[view, :count] = np.bincount(label.ravel(), minlength=count + 1)[1 : count + 1]
            flags[view, :count] = static[view]
        areas[areas == 0] = np.nan
        self.known = np.isfinite(areas)  # [views, K]
        self.areas = torch.from_numpy(areas).to(device)  # [views, K] float64 px, NaN for missing ones
        self.static_flags = torch.from_numpy(flags).to(device)  # [views, K]
        # view -> its instances that structure from motion shows to be static, [H, W] bool; absent if none
        self.static = {
            view: torch.from_numpy(np.r_[False, flags[view]][label]).to(device)
            for view, label in enumerate(clean)
            if flags[view].any()
        }

    def of_pixel(self, view: int) -> Tensor:
        """Return the label of each pixel, [H * W] int32; 0 = none."""
        return self._of_pixel[view].int()

    def means(self, view: int, pixels: Tensor) -> Tensor:
        """Return the mean of a map [H, W] over every instance, [K] float64; NaN for missing ones."""
        backend = backend_of(pixels.device)
        sums = backend.label_sums(self.of_pixel(view), self.most + 1, pixels.double().flatten())
        return sums[1:] / self.areas[view]

    def on_pixels(self, view: int, values: Tensor, shape: tuple[int, ...]) -> Tensor:
        """Return the value of each instance [K] at its pixels [H, W]; 0 outside of instances."""
        return F.pad(values, (1, 0)).index_select(0, self.of_pixel(view)).view(shape)

    def beyond(self, view: int, masked: Tensor, maskable: Tensor) -> Tensor:
        """Return the pixels outside of `maskable` of instances that are mostly masked, [H, W] bool.

        A distractor does not end where the other photos' frames do: its rest would be learnt. Static
        instances and those of which little is maskable stay.

        Args:
            view: index of the photo.
            masked: [H, W] bool.
            maskable: pixels that may be masked, [H, W] bool.
        """
        labels, backend = self._all[view].int(), backend_of(masked.device)
        hit, judged = (
            backend.label_sums(labels, self.most + 1, m.double().flatten()) for m in (masked, maskable)
        )
        pixels = backend.label_sums(labels, self.most + 1)
        taken = (hit > 0) & (hit >= WHOLE * judged) & (judged >= JUDGED * pixels)
        taken[:1] = False
        taken[1:] &= ~self.static_flags[view]
        return taken.index_select(0, labels).view(masked.shape) & ~maskable


def label_dtype(most: int) -> type[np.uint8 | np.int32]:
    """Return the type in which labels up to `most` take least memory."""
    return np.uint8 if most < 256 else np.int32


def make_masks(
    view: int,
    maps: ComparisonMaps,
    labels: InstanceLabels,
    others: tuple[Tensor, Tensor],
    w2: Tensor | float,
    config: MaskConfig,
    ceiling: Tensor | None = None,
    maskable: Tensor | None = None,
    moving: Tensor | None = None,
) -> PhotoMasks:
    """Make M_local, M_global and the keep map of one photo (Eqs. 3-7).

    Args:
        view: index of the photo.
        maps: maps of the photo, on its pixels or on the feature grid.
        labels: instances of all photos.
        others: means and distances of all photos' instances when they were last judged (`scope` = scene),
            [views, K] float64 each, NaN = none; the row of this view is not read.
        w2: weight of T_ent's lower subset.
        config: thresholds.
        ceiling: upper limit of the threshold, 0-d; None: no limit.
        maskable: pixels that may be masked, with the rest of their instances, [H, W] bool; None: all.
        moving: pixels that move for certain, [H, W] bool; None: none do.
    """
    height, width = shape = labels.shapes[view]
    pixels = enlarge(maps.statistic, height, width)
    means = distances = labels.means(view, pixels)
    if maps.distance is not maps.statistic:
        distances = labels.means(view, enlarge(maps.distance, height, width))
    values = [means, distances]
    if config.scope == "scene":
        values = [_with_row(rows, view, row).view(-1) for rows, row in zip(others, values)]
    pool = instance_stats(values[0])
    cut = t_ent(pool, w2, config.threshold, config.gate, config.floor, config.hard).capped(ceiling)
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
        inside = labels.of_pixel(view).view(shape) > 0
        judging = torch.where(inside, (pixels * of_instance).sqrt_(), pixels)
        regions.append(judging)
    # the default settings compute two sets of regions at once
    connected = list(hysteresis(torch.stack([r.double() for r in regions]), weak, strong)) if regions else []
    global_ = nothing
    if config.use_global:
        by_pixel = config.statistic == "structure"
        global_ = connected[0] if by_pixel else enlarge(global_mask_from_maps(maps, config), *shape)
    final = connected[-1] if fused else local | global_
    if static is not None:
        # no mask contains static instances
        final, global_ = final & ~static, global_ & ~static
    if maskable is not None:
        final = final & maskable
    final = final_mask(final, config, judging)
    if maskable is not None:
        final = final & maskable
        final = final | labels.beyond(view, final, maskable)
    if moving is not None:
        final = final | moving
    return PhotoMasks(local, global_, (~final).float(), means, distances, cut, pool)


def _with_row(rows: Tensor, view: int, row: Tensor) -> Tensor:
    rows = rows.clone()
    rows[view].copy_(row)
    return rows


class MaskStore:
    """Masks of all views, their inputs beside the render, and the learnt w2."""

    def __init__(
        self,
        config: RefineSplatConfig,
        data: TrainData,
        surfaces: Sequence[np.ndarray | None],  # inverse depths of the sparse points
        priors: Mapping[int, InitialMaskPrior],
        labels: Sequence[np.ndarray],  # [H, W] int instances, 0 = none
        static: Sequence[np.ndarray],  # [K of the photo] bool, not to be masked
        compare: Callable[
            [Step], ComparisonMaps
        ],  # on the feature grid; called only if the statistic needs it
    ) -> None:
        self.config, self.compare = config, compare
        photos, cameras, device = data.photos, data.cameras, data.device
        self.pixels = PixelEvidence(photos, cameras, surfaces, config.mask, device)
        structure = config.mask.statistic == "structure"
        # features are judged on their whole grid
        judged = (self.pixels.seen[view] if structure else None for view in range(len(photos)))
        self.labels = InstanceLabels(
            labels, static, (None if s is None else s.cpu().numpy() for s in judged), device
        )
        sizes = [(camera.height, camera.width) for camera in cameras]

        def factor(view: int) -> np.ndarray | None:
            prior = priors.get(view)
            return None if prior is None or prior.weight == 1 else prior.factor(sizes[view])

        def maskable(view: int) -> np.ndarray | None:
            prior = priors.get(view)
            keep = None if prior is None or not prior.within else prior.keep(sizes[view])
            return None if keep is None else ~keep

        def moving(view: int) -> np.ndarray | None:
            prior = priors.get(view)
            return None if prior is None else prior.moving(sizes[view])

        # factor of the evidence of each view, [H, W]; None if it is 1
        self.factors = EnlargedMaps(factor, len(photos), device)
        # pixels of each view that may be masked, [H, W] bool; None if all may
        self.maskable = EnlargedMaps(maskable, len(photos), device)
        # pixels of each view that move for certain, [H, W] bool; None if none do
        self.moving = EnlargedMaps(moving, len(photos), device)
        self.limited = {view: config.mask.limited(prior.most) for view, prior in priors.items()}
        self.keeps: dict[int, Tensor] = {}  # view -> its keep map [H, W] uint8, if it has one
        wide, views = torch.float64, len(photos)
        # [views, K] mean of every instance when its mask was last made, NaN for missing ones
        self.means = torch.full((views, self.labels.most), torch.nan, dtype=wide, device=device)
        self.distances = self.means if structure else self.means.clone()
        self._shares = torch.zeros((views, 4), dtype=wide, device=device)
        self.theta = torch.zeros((), dtype=wide, device=device)  # w2 = sigmoid(theta)

    @torch.no_grad()
    def renew(self, step: Step) -> None:
        """Compute the mask of the step's view, store its evidence for other views, and learn w2."""
        view, config = step.view, self.config.mask
        with backend_of(self.theta.device).all_threads():
            _, masks = self.examine(step, store=True)
        self.means[view].copy_(masks.means)
        self.distances[view].copy_(masks.distances)
        if config.w2 is None:
            self._learn(view, masks)
        self.keeps[view] = masks.keep.to(torch.uint8)
        self._shares[view].copy_(masks.shares())

    def _learn(self, view: int, masks: PhotoMasks) -> None:
        """Learn w2 from all instances; the price of a masked pixel is a robustly high distance."""
        config = self.config.mask
        rows = slice(None) if config.scope == "scene" else slice(view, view + 1)
        # instances of photos without a mask have no value yet
        judged = ~self.means[rows].isnan()
        areas = self.labels.areas[rows].masked_fill(~judged, torch.nan).reshape(-1)
        distances = self.distances[rows].reshape(-1)
        middle, spread = (
            (masks.pool.middle, masks.pool.spread) if self.distances is self.means else spread_of(distances)
        )
        price = middle + (max(config.disagree, 1.0) if config.disagree > 0 else PRICE) * spread
        costs = distances / price.clamp(min=1e-12)
        self.theta = updated_theta(self.theta, masks.pool, costs, areas, masks.cut.floor, config.threshold)

    @torch.no_grad()
    def examine(self, step: Step, *, store: bool = False) -> tuple[ComparisonMaps, PhotoMasks]:
        """Return the maps of the step's view and its masks at the photo's own size.

        Args:
            step: step of any train view.
            store: whether to store the evidence for other views.
        """
        view, rendered = step.view, step.rendered
        mask = self.limited.get(view, self.config.mask)
        ceiling = maskable = None
        if mask.statistic == "structure":
            image, alpha, depth = (t.detach() for t in (rendered.image, rendered.alpha, rendered.depth))
            evidence, unit = self.pixels.compute(view, image, alpha, depth, store=store)
            factor = self.factors[view]
            if factor is not None:
                evidence = evidence * factor
            if mask.entropy_weight > 0:
                evidence = scale_by_identities(evidence, self.compare(step).statistic, mask.entropy_weight)
            maps = ComparisonMaps(evidence, evidence)
            maskable, ceiling = self.pixels.seen[view], self.pixels.ceiling(unit)
        else:
            maps = self.compare(step)
        crowd = self.maskable[view]
        if crowd is not None:
            maskable = crowd if maskable is None else maskable & crowd
        w2 = torch.sigmoid(self.theta) if mask.w2 is None else mask.w2
        others = self.means, self.distances
        return maps, make_masks(
            view, maps, self.labels, others, w2, mask, ceiling, maskable, self.moving[view]
        )

    @property
    def w2(self) -> float:
        """Weight of T_ent's lower subset, learnt or fixed."""
        return float(torch.sigmoid(self.theta)) if self.config.mask.w2 is None else self.config.mask.w2

    @property
    def judged(self) -> dict[int, InstanceStatistics]:
        """Each view's instances when its mask was last made."""
        means, distances, areas = (t.cpu().numpy() for t in (self.means, self.distances, self.labels.areas))
        known = self.labels.known
        return {
            v: InstanceStatistics(*(rows[v, known[v]] for rows in (means, distances, areas)))
            for v in self.keeps
        }

    @property
    def shares(self) -> dict[int, tuple[float, float, float, float]]:
        """Each view's shares masked in all, locally and globally, and T_ent."""
        rows = self._shares.tolist()
        return {view: tuple(rows[view]) for view in self.keeps}

    def state_dict(self) -> State:
        return {
            "keeps": {str(view): keep for view, keep in self.keeps.items()},
            # stored as text: T_ent is inf if no instance is an outlier, and JSON has no inf
            "shares": {str(view): [repr(x) for x in row] for view, row in self.shares.items()},
            "judged": {
                str(view): torch.from_numpy(np.stack([j.values, j.distances, j.areas]))
                for view, j in self.judged.items()
            },
            "theta": float(self.theta),
            "pixels": self.pixels.state_dict(),
        }

    def load_state_dict(self, state: State) -> None:
        device = self.theta.device
        shares = np.zeros(self._shares.shape)
        for view, row in state["shares"].items():
            shares[int(view)] = [float(x) for x in row]
        rows = np.full((2, *self.means.shape), np.nan)
        for view, statistics in state["judged"].items():
            rows[:, int(view), self.labels.known[int(view)]] = statistics[:2].cpu().numpy()
        self.keeps = {int(v): keep.to(device) for v, keep in state["keeps"].items()}
        self._shares = torch.from_numpy(shares).to(device)
        same = self.distances is self.means
        self.means = torch.from_numpy(rows[0]).to(device)
        self.distances = self.means if same else torch.from_numpy(rows[1]).to(device)
        self.theta = torch.full_like(self.theta, float(state["theta"]))
        self.pixels.load_state_dict(state["pixels"])
