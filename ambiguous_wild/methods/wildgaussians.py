"""WildGaussians: masks from a learnt uncertainty, and colours from embeddings of Gaussians and photos.

Source: "WildGaussians: 3D Gaussian Splatting in the Wild", Kulhanek et al., NeurIPS 2024 (arXiv 2407.08447),
and its code. A linear head on features of the photo gives an uncertainty, which learns from their distance to
the features of the render; pixels of high uncertainty are masked. An MLP of (colour, embedding of the
Gaussian, embedding of the photo) gives (o, m); the colour becomes m colour + o.

Different from the release: features (Lab and HOG for DINOv2's, option `features`) with a distance in units of
what blur alone causes; the head normalises by all photos' features, drops channels after that, and learns
from the first iteration on; masks begin at once, without a blend; a photo without a static pixel is kept; the
MLP reads the colour in the view's direction, not the constant harmonic; m is 1 + its output, so that training
starts from unchanged colours; D-SSIM is of the toned picture (one render a step); the MLP runs on visible
Gaussians only; a test photo's embedding is fitted without masks. Left out: sky, 3D filter and growth.

Cost: features of every render.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core.config import Facts, State, check_limits
from ambiguous_wild.methods.masking_common import (
    CountingMask,
    MaskedShares,
    PausingMask,
    adam_of,
    calibrated,
    hashed_uniform,
    learner_state,
    load_learner,
    resized,
)
from ambiguous_wild.splat.effects.autograd_effect import (
    AutogradEffect,
    Leaf,
    VisibleGaussians,
    mlp,
    mlp_leaves,
)
from ambiguous_wild.splat.effects.base import rate_for_run_length
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.step import Step, TrainData, ViewContext
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS
from ambiguous_wild.vision.backends import check_features, make_features
from ambiguous_wild.vision.precompute import photo_features


class FeatureDistance:
    """The distance of features of photo and render: clip(2 - 2 cosine, 0, 1), as in WildGaussians."""

    def __init__(self, features: str, normal_units: float) -> None:
        """
        Args:
            features: a back end, see vision/backends.py.
            normal_units: for hand-made features: distance in units of blur that counts as 1.

        Raises:
            AwError: the features are unknown, or their weights are missing.
        """
        self.features = make_features(features)
        self.normal_units = normal_units if features.startswith("labhog") else None

    @property
    def name(self) -> str:
        return self.features.name

    def setup(self, data: TrainData) -> None:
        self.cameras = data.cameras
        self.features.fit(data.photos)
        self.photos = photo_features(self.features, data.photos, data.cache_dir)  # [h, w, C] each

    @torch.no_grad()
    def __call__(self, step: Step) -> Tensor:
        """Return the distance [H, W] at the size of the step's photo."""
        full = self.cameras[step.view]  # not the photo, which may not be on the device
        seen = self.features(resized(step.rendered.image.detach(), full.height, full.width))
        cosine = F.cosine_similarity(self.photos[step.view], seen, dim=2)
        if self.normal_units is not None:
            cosine = calibrated(cosine, self.features.unit, self.normal_units)
        return resized((2.0 - 2.0 * cosine).clamp(0.0, 1.0), *step.photo.shape[:2])


PHOTO, OCTAVES = 32, 4  # length of a photo's embedding; octaves of Fourier features for Gaussians' embeddings
GAUSSIAN = 6 * OCTAVES


@dataclass(frozen=True)
class WildGaussiansConfig:
    """Options; times in nominal iterations (of 30 000).

    Its code has lr_photo 1e-3, lr_net 5e-4 and scale 0.01, for 70 000 to 200 000 iterations.
    """

    masks: bool = True  # masks by the uncertainty
    appearance: bool = True  # published: on for photo collections, off for captures
    features: str = "labhog"  # see vision/backends.py; published: dinov2-small-registers@350,blocks=6
    normal_units: float = 80.0  # for hand-made features: distance in units of blur that counts as 1
    mask_start: float = 2000.0
    min_mask_start: int = 300  # iterations: earlier renders show too little
    reset_pause: float = 500.0  # time after an opacity reset in which the head does not learn
    min_reset_pause: int = 100
    prior: float = 0.5  # weight of the mean ln sigma
    dropout: float = 0.5  # share of the head's input channels
    lr_head: float = 1e-3  # published for 30 000 iterations; higher in shorter runs
    lr_photo: float = 0.01
    lr_gaussian: float = 5e-3
    lr_net: float = 1e-3
    width: int = 128  # units of both hidden layers
    scale: float = 0.1  # factor of the MLP's output; at 0.01 a run of 700 iterations gains 0.8 dB, at 0.1 2.0

    def __post_init__(self) -> None:
        check_features(self.features)
        check_limits(self, "wildgaussians", normal_units=(1e-3, 1e9), dropout=(0, 0.9), prior=(1e-3, 1e3))


def build(options: WildGaussiansConfig) -> MethodHooks:
    """Return 3DGS with the masks, the appearance, or both."""
    effects = (WildAppearance(options),) if options.appearance else ()
    return MethodHooks(mask=UncertaintyMask(options) if options.masks else MaskPolicy(), effects=effects)


class WildAppearance(AutogradEffect):
    """Draws (1 + m) colour + o, with (o, m) = scale MLP(colour, g of the Gaussian, a of the photo)."""

    name = "wildgaussians"

    def __init__(self, config: WildGaussiansConfig) -> None:
        self.config = config

    def setup(self, data: TrainData) -> None:
        self.seed, self.points = data.seed, data.sfm_points
        super().setup(data)

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        start = torch.tensor(0.01 * rng.normal(size=(len(data.photos), PHOTO)), dtype=torch.float32)
        widths = (3 + GAUSSIAN + PHOTO, self.config.width, self.config.width, 6)
        net = mlp_leaves("net", widths, rng, self.config.lr_net)
        return {"photo": Leaf(start, self.config.lr_photo, per_photo=True), **net}

    def rows(self, gaussians: Gaussians) -> Mapping[str, GaussianAttribute]:
        start = noisy_fourier(gaussians.means, self.points, [self.seed, 0x36])
        return {"wild_embedding": GaussianAttribute(start, self.config.lr_gaussian)}

    def forward(self, visible: VisibleGaussians, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        photo = leaf["photo"].expand(len(visible.base), PHOTO)
        inputs = torch.cat([visible.base, visible.attributes["wild_embedding"], photo], dim=1)
        offset, gain = (self.config.scale * mlp(inputs, leaf, "net")).split(3, dim=1)
        return (1.0 + gain) * visible.base + offset


def fourier(means: Tensor, points: Tensor) -> Tensor:
    """Return sin(2 pi 2^k x + {0, pi/2}), k = 0..3, of positions scaled to [0, 1], [N, 24].

    The scale is the 97 % quantile of the SfM points [M, 3], because a skybox would shrink the scene.
    """
    centre = points.mean(dim=0)
    spread = torch.quantile((points - centre).abs(), 0.97, dim=0).clamp(min=1e-6)
    unit = 0.5 * (means - centre) / spread + 0.5
    angles = torch.cat([2.0 * torch.pi * 2.0**k * unit for k in range(OCTAVES)], dim=1)
    return torch.cat([angles.sin(), (angles + torch.pi / 2).sin()], dim=1)


def noisy_fourier(means: Tensor, points: Tensor, seed: list[int]) -> Tensor:
    """Return the start of an embedding of each Gaussian: `fourier` with a little noise, [N, 24]."""
    start = fourier(means, points)
    noise = 1e-4 * np.random.default_rng(seed).normal(size=tuple(start.shape))
    return start + torch.from_numpy(noise.astype(np.float32)).to(start.device)


class UncertaintyHead(nn.Module):
    """Maps features [h, w, C] of a photo to sigma [H, W] > 0, which starts near 1."""

    def __init__(self, photos: Sequence[Tensor], seed: int) -> None:
        """
        Args:
            photos: [h, w, C] features of every photo, whose mean and deviation normalise.
            seed: seed of the weights.
        """
        super().__init__()
        cells = sum(f.shape[0] * f.shape[1] for f in photos)
        mean = torch.stack([f.double().sum(dim=(0, 1)) for f in photos]).sum(dim=0) / cells
        apart = torch.stack([(f.double() - mean).square().sum(dim=(0, 1)) for f in photos]).sum(dim=0)
        self.mean, self.deviation = mean.to(photos[0]), (apart / cells).sqrt().clamp(min=1e-6).to(photos[0])
        weight = 0.01 * torch.randn(len(mean), generator=torch.Generator().manual_seed(seed))
        self.weight = nn.Parameter(weight.to(photos[0]))
        self.bias = nn.Parameter(photos[0].new_zeros(1))

    def forward(self, features: Tensor, height: int, width: int, kept: Tensor | None = None) -> Tensor:
        """Return sigma [H, W]; `kept` [C] are factors of channels."""
        normal = (features - self.mean) / self.deviation
        seen = normal if kept is None else normal * kept
        sigma = F.softplus(seen @ self.weight + self.bias + math.log(math.e - 1.0))
        return resized(sigma, height, width).clamp(min=0.1)


def uncertainty_loss(sigma: Tensor, distance: Tensor, prior: float) -> Tensor:
    """Return the mean of d / (2 sigma^2) + prior ln sigma, which is least at sigma^2 = d / prior."""
    return (distance * 0.5 / sigma.square()).mean() + prior * sigma.log().mean()


class UncertaintyMask(CountingMask, PausingMask):
    """Keeps pixels with 1 / (2 sigma^2) > 1; the head learns in every step, but not after opacity resets."""

    config: WildGaussiansConfig

    def __init__(self, config: WildGaussiansConfig) -> None:
        self.config, self.shares = config, MaskedShares()
        self.distance = FeatureDistance(config.features, config.normal_units)

    def setup(self, data: TrainData) -> None:
        self.distance.setup(data)
        self.seed, self.head = data.seed, UncertaintyHead(self.distance.photos, data.seed)
        self.optimiser = adam_of(self.head, self.config.lr_head, data.device)

    def keep(self, step: Step) -> Tensor | None:
        if not self.paused(step):
            self._learn(step)
        if not self.begun(step):
            return None
        keep = self._static(step)
        self.shares.take(step.view, keep)
        return keep

    def predict(self, step: Step) -> Tensor | None:
        return self._static(step) if self.begun(step) else None

    @torch.no_grad()
    def _static(self, step: Step) -> Tensor:
        """Return the keep map; a photo without a static pixel is kept whole, or nothing would be learnt."""
        sigma = self.head(self.distance.photos[step.view], *step.photo.shape[:2])
        static = sigma < math.sqrt(0.5)
        return torch.where(static.any(), static, True).float()

    def _learn(self, step: Step) -> None:
        photo, c = self.distance.photos[step.view], self.config
        key = (self.seed, step.iteration, 0x57)
        kept = (hashed_uniform(photo.shape[2], key, photo.device) >= c.dropout) / (1.0 - c.dropout)
        with torch.enable_grad():
            sigma = self.head(photo, *step.photo.shape[:2], kept)
            loss = uncertainty_loss(sigma, self.distance(step), c.prior)
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
        for group in self.optimiser.param_groups:
            group["lr"] = rate_for_run_length(c.lr_head, NOMINAL_ITERATIONS, step)
        self.optimiser.step()

    def facts(self) -> Facts:
        return {**super().facts(), "features": self.distance.name}

    def state_dict(self) -> State:
        return {**super().state_dict(), **learner_state(self.head, self.optimiser)}

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        load_learner(self.head, self.optimiser, state)
