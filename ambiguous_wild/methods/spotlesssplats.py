"""SpotLessSplats: a small net, or a vote in clusters, on frozen features tells which residuals are outliers.

Source: arXiv 2406.20055 and the authors' gsplat port, lilygoli/SpotLessSplats; how the original differs from
it is unverified. Ours: features are Lab and HOG (published: Stable Diffusion's), and for them the net's input
is standardised; the port's 0.5 max|W1| max|W2| carries no gradient and is left out; the annealing counts
iterations of the run where these are fewer than nominal ones; clusters lie on a grid of 50 cells.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core.config import Facts, State, check_limits
from ambiguous_wild.methods.dronesplat import label_means
from ambiguous_wild.methods.masking_common import (
    CountingMask,
    MaskedShares,
    MaskNet,
    adam_of,
    annealed,
    init_uniform,
    inlier_map,
    learner_state,
    load_learner,
    nearest,
    percentile,
    residual,
    sampled,
    update_histogram,
    upsampled,
)
from ambiguous_wild.splat.density import NO_SIZE_PRUNING, DensityConfig, DensityControl
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.optim import SplatAdam
from ambiguous_wild.splat.rendered import Gradients
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import check_features, make_features
from ambiguous_wild.vision.precompute import photo_features
from ambiguous_wild.vision.segments import ward_clusters

OCTAVES = 20
CELLS, BINS = 50, 10_000  # cells on the longer side of the clusters' grid; bins of the histogram


@dataclass(frozen=True)
class SpotLessDensityConfig(DensityConfig):
    """Density control of 3DGS without opacity resets and without pruning by size."""

    resets: tuple[float, ...] = ()
    prune_scale: float = NO_SIZE_PRUNING
    free_colour: float = 8002.0  # nominal iteration at which higher harmonics are cut
    most_colour: float = 0.001  # their largest value after the cut
    least_use: float = 0.0  # prune below this sum of squared screen gradients; published 1e-14, also off


class SpotLessDensity(DensityControl):
    """Clones, splits and prunes as 3DGS, and cuts the higher harmonics once."""

    config: SpotLessDensityConfig
    saved = (*DensityControl.saved, "cut")
    cut = False  # whether the higher harmonics were cut

    @torch.no_grad()
    def refine(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> tuple[Gaussians, list[str]]:
        gaussians, events = super().refine(step, gaussians, optimiser)
        if self._cut_due(step):
            optimiser.bind(gaussians)
            optimiser.reset_moments(["sh_rest"])  # takes pending steps first
            gaussians.sh_rest.clamp_(max=self.config.most_colour)
            self.cut = True
        return gaussians, events

    def due(self, step: Step) -> bool:
        return super().due(step) or self._cut_due(step)

    def _cut_due(self, step: Step) -> bool:
        return not self.cut and step.nominal >= self.config.free_colour


class PruningDensity(SpotLessDensity):
    """Density control that also removes Gaussians on which pictures hardly depended since the last round."""

    needs: ClassVar[frozenset[str]] = frozenset({"squared"})
    sums: ClassVar[Mapping[str, tuple[int, ...]]] = {"grad_sum": (), "views_seen": (), "use_sum": ()}
    use_sum: Tensor  # [N] sum of squared screen gradients, 1/px^2

    @torch.no_grad()
    def observe(self, step: Step, gradients: Gradients, keep: Tensor | None = None) -> None:
        super().observe(step, gradients, keep)
        if step.nominal <= self.config.stop:
            assert gradients.squared is not None
            self.use_sum += gradients.squared

    def _grow(self, step: Step, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        grown = super()._grow(step, gaussians, optimiser)
        new = self.log.now.cloned + 2 * self.log.now.split
        self.use_sum[len(grown) - new :] = 1.0  # large: new Gaussians are not pruned before they were drawn
        return grown

    def _prune(self, gaussians: Gaussians, optimiser: SplatAdam) -> Gaussians:
        gaussians = super()._prune(gaussians, optimiser)
        drop = self.mutable_rows(~(self.use_sum >= self.config.least_use), gaussians)
        return self.drop_rows(gaussians, optimiser, drop)


class PositionalMaskNet(MaskNet):
    """The net of RobustSplat that also gets the position of the pixel."""

    def __init__(self, mean: Tensor, std: Tensor, hidden: int, seed: int) -> None:
        super().__init__(mean, std, hidden, seed)
        self.place = nn.Linear(4 * OCTAVES, hidden, bias=False, device=mean.device)
        limit = (len(mean) + 4 * OCTAVES) ** -0.5  # features and position form the input of one layer
        init_uniform([(self.place, limit)], seed + 1)
        with torch.no_grad():
            for values in (self.first.weight, self.first.bias):
                values *= limit * len(mean) ** 0.5

    def forward(self, features: Tensor, height: int, width: int) -> Tensor:
        """Return the map [height, width]; columns and rows are encoded separately, then summed."""
        z = upsampled(self.first((features - self.mean) / self.std), height, width)
        x, y = (positional_encoding(size, z) for size in (width, height))
        across, down = self.place.weight[:, : 2 * OCTAVES], self.place.weight[:, 2 * OCTAVES :]
        z = z + (x @ across.T)[None, :, :] + (y @ down.T)[:, None, :]
        return torch.sigmoid(self.last(F.relu(z)).squeeze(2))


def positional_encoding(size: int, like: Tensor) -> Tensor:
    """Return sin and cos of pi 2^k x, k = 0..19, at x from 0 to 1 along a side, [size, 40]."""
    at = torch.arange(size, device=like.device, dtype=torch.float64) / max(size - 1, 1)
    angles = torch.pi * torch.stack([2.0**k * at for k in range(OCTAVES)], dim=1)
    return torch.cat([angles.sin(), angles.cos()], dim=1).to(like)


@dataclass(frozen=True)
class SpotLessSplatsConfig:
    """Options; shares are of the pixels of all photos."""

    features: str = "labhog"  # see vision/backends.py
    mask: Literal["mlp", "cluster", "filter"] = "mlp"
    density: SpotLessDensityConfig = field(default_factory=SpotLessDensityConfig)
    inliers: float = 0.7  # for `cluster` and `filter`: share of the smallest residuals that are inliers
    lower: float = 0.5  # for `mlp`: share that is surely static; published also 0.3 (patio-high, spot)
    upper: float = 0.9  # for `mlp`: share that may be static; published also 0.8
    clusters: int = 100  # number in a photo
    beta: float = 0.003  # decay of the chance that a masked pixel is kept nevertheless
    lr: float = 1e-3
    lambda_dssim: float = 0.0

    def __post_init__(self) -> None:
        check_features(self.features)
        shares = dict.fromkeys(("inliers", "lower", "upper", "lambda_dssim"), (0, 1))
        check_limits(self, "spotlesssplats", clusters=(1, 1e5), beta=(0, 1e3), lr=(1e-9, 10), **shares)


@dataclass(frozen=True)
class ClusterConfig(SpotLessSplatsConfig):
    """Options of the form that votes in clusters."""

    mask: Literal["mlp", "cluster", "filter"] = "cluster"


def build(options: SpotLessSplatsConfig) -> MethodHooks:
    """Return 3DGS with masked L1, without opacity resets, and with harmonics that are cut once."""
    density = PruningDensity if options.density.least_use > 0 else SpotLessDensity
    return MethodHooks(SpotLessMask(options), density, options.density, lambda_dssim=options.lambda_dssim)


class SpotLessMask(CountingMask):
    """Keep maps between a strict and a loose bound of the residual, at first drawn at random."""

    def __init__(self, config: SpotLessSplatsConfig) -> None:
        self.config, self.features, self.shares = config, make_features(config.features), MaskedShares()
        self.histogram, self.seen = torch.zeros(BINS, dtype=torch.float64), 0

    def setup(self, data: TrainData) -> None:
        self.seed, self.histogram = data.seed, self.histogram.to(data.device)
        if self.config.mask == "filter":
            return
        self.features.fit(data.photos)
        phi = photo_features(self.features, data.photos, data.cache_dir)
        if self.config.mask == "cluster":
            self.labels = [
                torch.from_numpy(self._clusters(x, p)).to(x.device) for x, p in zip(phi, data.photos)
            ]
            return
        cells = torch.cat([x.reshape(-1, x.shape[2]) for x in phi]).double()
        mean, std = cells.mean(0).float(), cells.std(0, correction=0).clamp(min=1e-6).float()
        if not self.config.features.startswith("labhog"):
            mean, std = torch.zeros_like(mean), torch.ones_like(std)
        self.phi, self.net = phi, PositionalMaskNet(mean, std, 16, data.seed)
        self.optimiser = adam_of(self.net, self.config.lr, data.device)

    def _clusters(self, phi: Tensor, photo: Tensor) -> np.ndarray:
        h, w = (max(round(side * CELLS / max(phi.shape[:2])), 1) for side in phi.shape[:2])
        size = (min(h, phi.shape[0]), min(w, phi.shape[1]))
        small = F.adaptive_avg_pool2d(phi.permute(2, 0, 1)[None], size)[0].permute(1, 2, 0)
        labels = torch.from_numpy(ward_clusters(small.cpu().numpy(), self.config.clusters))
        return F.interpolate(labels[None, None].float(), size=photo.shape[:2])[0, 0].long().numpy()

    def keep(self, step: Step) -> Tensor:
        mask = self._mask(step, learn=True)
        if step.nominal < 15_000:
            error = residual(step.photo, step.rendered.image.detach())
            self.histogram, self.seen = update_histogram(self.histogram, error, 0.95), self.seen + 1
        self.shares.take(step.view, mask)
        return sampled(mask, annealed(step, self.config.beta), (self.seed, step.iteration))

    def predict(self, step: Step) -> Tensor:
        return self._mask(step, learn=False)

    def _mask(self, step: Step, learn: bool) -> Tensor:
        error = residual(step.photo, step.rendered.image.detach())
        if self.config.mask != "mlp":
            inlier = self._bound(error, self.config.inliers, 1.0)
            return inlier if self.config.mask == "filter" else self._vote(inlier, step.view)
        with torch.set_grad_enabled(learn):
            mask: Tensor = self.net(self.phi[step.view], *step.photo.shape[:2])
        if learn:
            loose, strict = (self._bound(error, share, first) for share, first in self._limits)
            loss = (F.relu(mask - loose) + F.relu(strict - mask)).mean()
            self.optimiser.zero_grad(set_to_none=True)
            with torch.enable_grad():
                loss.backward()
            self.optimiser.step()
        return mask.detach()

    @property
    def _limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        return (self.config.upper, 1.0), (self.config.lower, 0.0)

    def _bound(self, error: Tensor, share: float, first: float) -> Tensor:
        """Return inliers [H, W] below the threshold of earlier steps; in the first step it is `first`."""
        return inlier_map(error, percentile(self.histogram, share) if self.seen else first)

    def _vote(self, inlier: Tensor, view: int) -> Tensor:
        labels = nearest(self.labels[view], *inlier.shape)
        return (label_means(inlier, labels, self.config.clusters) > 0.5)[labels].float()

    def facts(self) -> Facts:
        used = "none" if self.config.mask == "filter" else self.features.name
        return {**super().facts(), "features": used}

    def state_dict(self) -> State:
        state = {**super().state_dict(), "histogram": self.histogram, "seen": self.seen}
        if self.config.mask == "mlp":
            state |= learner_state(self.net, self.optimiser)
        return state

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        self.histogram, self.seen = state["histogram"].to(self.histogram.device), int(state["seen"])
        if self.config.mask == "mlp":
            load_learner(self.net, self.optimiser, state)
