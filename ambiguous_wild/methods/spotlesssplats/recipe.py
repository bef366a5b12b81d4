"""SpotLessSplats: a small net, or a vote in clusters, on frozen features says which residuals are outliers.

Source: arXiv 2406.20055 and the authors' gsplat port, lilygoli/SpotLessSplats; how the original differs
from that port is unverified. Ours: features (Lab and HOG for Stable Diffusion's, option `features`); with
them the net's input is standardised; the port's 0.5 max|W1| max|W2| carries no gradient and is left out;
the annealing counts iterations of the run where these are fewer than nominal ones; clusters lie on a grid
of 50 cells.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.dronesplat import label_means, nearest
from ambiguous_wild.methods.masking_common import MaskedShares, annealed, sampled
from ambiguous_wild.methods.robustsplat.net import adam_of, adam_state, load_adam_state
from ambiguous_wild.methods.robustsplat.supervision import bound, percentile, residual, update_histogram
from ambiguous_wild.methods.spotlesssplats.density import (
    PruningDensity,
    SpotLessDensity,
    SpotLessDensityConfig,
)
from ambiguous_wild.methods.spotlesssplats.net import PlacedNet
from ambiguous_wild.splat.parts import MaskPolicy, Parts, State
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import check_features, make_features
from ambiguous_wild.vision.precompute import photo_features
from ambiguous_wild.vision.segments import ward_clusters

CELLS, BINS = 50, 10_000  # on the longer side of the clusters' grid; of the histogram


@dataclass(frozen=True)
class SpotLessSplatsConfig:
    """Options; shares are of the pixels of all photos."""

    features: str = "labhog"  # see vision/backends.py
    mask: Literal["mlp", "cluster", "filter"] = "mlp"
    density: SpotLessDensityConfig = field(default_factory=SpotLessDensityConfig)
    inliers: float = 0.7  # share of the smallest residuals, of `cluster` and `filter`
    lower: float = 0.5  # of `mlp`: surely static; published also 0.3 (patio-high, spot)
    upper: float = 0.9  # of `mlp`: may be static; published also 0.8
    clusters: int = 100  # a photo
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


def build(options: SpotLessSplatsConfig) -> Parts:
    """Masked L1, no opacity reset, harmonics that start anew."""
    density = PruningDensity if options.density.least_use > 0 else SpotLessDensity
    return Parts(SpotLessMask(options), density, options.density, lambda_dssim=options.lambda_dssim)


class SpotLessMask(MaskPolicy):
    """Keep maps between the strict and the loose bound of the residual, drawn at random at first."""

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
        self.phi, self.net = phi, PlacedNet(mean, std, 16, data.seed)
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
        """Inliers [H, W] under the threshold of the steps before; `first` is that of the first step."""
        return bound(error, percentile(self.histogram, share) if self.seen else first)

    def _vote(self, inlier: Tensor, view: int) -> Tensor:
        labels = nearest(self.labels[view], *inlier.shape)
        return (label_means(inlier, labels, self.config.clusters) > 0.5)[labels].float()

    def facts(self) -> dict[str, Any]:
        used = "none" if self.config.mask == "filter" else self.features.name
        return {"masked_share": self.shares.mean(), "features": used}

    def state_dict(self) -> State:
        state: State = {"histogram": self.histogram, "seen": self.seen, "shares": self.shares.state_dict()}
        if self.config.mask == "mlp":
            net = {name.replace(".", "_"): value for name, value in self.net.state_dict().items()}
            state |= {"net": net, "adam": adam_state(self.optimiser)}
        return state

    def load_state_dict(self, state: State) -> None:
        self.histogram, self.seen = state["histogram"].to(self.histogram.device), int(state["seen"])
        self.shares = MaskedShares.from_state(state["shares"])
        if self.config.mask == "mlp":
            self.net.load_state_dict({k: state["net"][k.replace(".", "_")] for k in self.net.state_dict()})
            load_adam_state(self.optimiser, state["adam"])
