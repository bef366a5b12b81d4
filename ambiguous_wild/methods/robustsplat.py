"""RobustSplat: growth waits until masks are stable, and a net on frozen features makes the masks.

Source: "RobustSplat: Decoupling Densification and Dynamics for Transient-Free 3DGS", ICCV 2025 (arXiv
2506.02751) and its released code. Densification and opacity resets wait until the static scene and the masks
are stable; a per-pixel net on frozen features learns from the agreement of photos and renders, first at a low
scale.

The published form is `features=dinov2-small-registers@504,normalise=raw`, the default where its weights are,
but for the net's input: published a square, here the photo's aspect; else EfficientNet-Lite0, else hand-made
features (Lab and HOG). Settings that depend on the features are "auto". Values without a comment are the
authors'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.io.palette import MASKED, faded, ramp, tint
from ambiguous_wild.methods import masking_common
from ambiguous_wild.methods.masking_common import (
    CountingMask,
    MaskedShares,
    MaskNet,
    PausingMask,
    adam_of,
    learner_state,
    load_learner,
    resized,
)
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.data import shrink, shrink_camera
from ambiguous_wild.splat.density import NO_SIZE_PRUNING, DensityConfig
from ambiguous_wild.splat.method_hooks import MethodHooks, Schedule
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import (
    BY_MACHINE,
    DINO,
    check_features,
    first_available,
    make_features,
    parse_spec,
)
from ambiguous_wild.vision.precompute import photo_features
from ambiguous_wild.vision.protocols import Features

_SIZES = dict.fromkeys((*DINO, "vgg16"), 252)  # px, input of nets without "@"; others take the photo's size
PUBLISHED = "dinov2-small-registers@504,normalise=raw"


def features() -> str:
    """Return the published features if their weights are here, else EfficientNet-Lite0, else `labhog`.

    Of the others EfficientNet-Lite0 alone is below 3DGS on no capture (docs/fidelity.md).
    """
    return first_available(PUBLISHED, "efficientnet-lite0", "labhog")


def _delayed_growth() -> DensityConfig:
    return DensityConfig(
        start=10_000.0, stop=20_000.0, resets=(15_000.0, 18_000.0), prune_scale=NO_SIZE_PRUNING
    )


@dataclass(frozen=True)
class RobustSplatConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run.

    "auto" and None stand for the published values with DINO's features. Cells of other features see a small
    part of the photo, and their cosines have other scales: for these the values were tuned with `labhog` on
    two simulated captures that are not reported (240x135, 2000 iterations, 10 900 Gaussians). Distractors in
    the background's colours: 26.3 dB and IoU 0.41 with features of the cell alone, 29.1 dB and 0.62 with
    wider context and a wider net, both at lr 0.003; twins of static things: 29.5 dB and 0.68 with the latter.
    """

    features: str = field(default_factory=features, metadata=BY_MACHINE)  # see vision/backends.py
    coarse_features: str = ""  # for the coarse stage; "" = the same kind at 16/36 of the size, as published
    coarse_share: float = 16 / 36  # side of the pictures for coarse features, as a share of the photo's
    # source of the cosine target: the cosine; its distance in units of what blur alone causes; or in units of
    # the distance that a share `lower` of all cells had lately
    cosine: Literal["auto", "calibrated", "plain", "relative"] = "auto"
    reach: float = 3.0  # distance in those units at which the relative target is 0
    normal_units: float = 10.0  # distance where the calibrated cosine is 0; from half of it the target is 0
    inputs: Literal["auto", "standardised", "raw"] = "auto"  # inputs of the net
    # sides in cells of boxes whose mean features the net also gets: a token of DINO sees the whole photo, a
    # cell of labhog 20 px
    context: tuple[int, ...] | None = None  # None: 5,15 with local features; DINO never takes any
    hidden: int | None = None  # None: 16, published; 64 with local features
    lr: float | None = None  # None: 0.001, published; 0.003 with local features
    density: DensityConfig = field(default_factory=_delayed_growth)
    lr_opacity: float = 0.025
    lambda_dssim: float = 0.2
    mask_start: float = 500.0
    min_mask_start: int = 300  # earlier renders show too little
    bootstrap: float = 20_000.0  # coarse supervision before, fine after
    coarse_divisor: int = 4  # the coarse residual is at 1/4 of the render's side
    coarse_render: Literal["render", "shrink"] = "render"  # draw a small render, or shrink the full one
    lower: float = 0.6  # share of residuals that are surely static
    upper: float = 0.8  # share of residuals that may be static
    decay: float = 0.95  # decay of the running histogram in each step
    bins: int = 10_000
    beta: float = 2000.0  # decay of the pull towards "all static"
    lambda_pull: float = 2.0
    lambda_cosine: float = 0.5
    lambda_residual: float = 0.5
    threshold: float = 0.25  # pixels above are kept
    erosion: int = 7  # px, side of the min-pool
    reset_pause: float = 300.0  # time after an opacity reset in which the net does not learn
    min_reset_pause: int = 200

    def __post_init__(self) -> None:
        for spec in (self.features, self.coarse_features):
            if spec:
                check_features(spec)
        if not 0 < self.lower <= self.upper <= 1:
            raise AwError(f"robustsplat: need 0 < lower <= upper <= 1, got {self.lower} and {self.upper}")
        if not 0 < self.coarse_share <= 1:
            raise AwError(f"robustsplat.coarse_share is above 0, at most 1, got {self.coarse_share}")
        if not 0 <= self.decay < 1:
            raise AwError(f"robustsplat.decay is from 0 to below 1, got {self.decay}")
        if self.reach <= 1:
            raise AwError(f"robustsplat.reach must be above 1, got {self.reach}")
        if self.erosion < 1 or self.erosion % 2 == 0:
            raise AwError(f"robustsplat.erosion is an odd number of px, got {self.erosion}")
        if any(size < 1 or size % 2 == 0 for size in self.context or ()):
            raise AwError(f"robustsplat.context holds odd numbers of cells, got {self.context}")
        for name in ("hidden", "bins", "coarse_divisor", "lr", "beta", "normal_units"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise AwError(f"robustsplat.{name} must be above 0, got {value}")

    @property
    def net_context(self) -> tuple[int, ...]:
        """Sides in cells of the boxes whose mean features the net also gets."""
        if not self.local:
            return ()
        return (5, 15) if self.context is None else self.context

    @property
    def net_hidden(self) -> int:
        """Width of the net."""
        return self.hidden or (64 if self.local else 16)

    @property
    def net_lr(self) -> float:
        """Learning rate of the net."""
        return self.lr or (3e-3 if self.local else 1e-3)

    @property
    def local(self) -> bool:
        """Whether a cell of the features sees a small part of the photo: all but DINO's."""
        return parse_spec(self.features).name not in DINO

    @property
    def coarse_size(self) -> int | None:
        """Longer side in px of the coarse net's input; None: it follows the size of the picture."""
        spec = parse_spec(self.features)
        size = _SIZES.get(spec.name, 0) if spec.size is None else spec.size
        if spec.size == 0 or not size:
            return None
        return round(size * self.coarse_share)


def mask_loss(
    mask: Tensor,  # [H, W] of the net, in (0, 1)
    target: Tensor,  # [H, W] T_cos
    lower: Tensor,  # [H, W] bound below
    upper: Tensor,  # [H, W] bound above
    nominal: float,
    config: RobustSplatConfig,
) -> Tensor:
    """Return 0.5 mean|M - T_cos| + 0.5 mean(relu(M - u) + relu(l - M)) + 2 exp(-it / beta) mean(1 - M).

    The authors' last term, 0.5 max|W1| max|W2|, is made from detached weights, hence constant and left out.
    """
    pull = config.lambda_pull * math.exp(-nominal / config.beta)
    bounds = (F.relu(mask - upper) + F.relu(lower - mask)).mean()
    agreement = config.lambda_cosine * (mask - target).abs().mean()
    return agreement + config.lambda_residual * bounds + pull * (1.0 - mask).mean()


class RobustSplatMask(CountingMask, PausingMask):
    """The net learns every iteration from mask_start on; its map, thresholded and eroded, is the keep map."""

    config: RobustSplatConfig

    def __init__(self, config: RobustSplatConfig) -> None:
        self.config = config
        self.fine: Features = make_features(config.features)
        self.coarse: Features = make_features(config.coarse_features or coarse_spec(config))
        self.histogram = torch.zeros(config.bins, dtype=torch.float64)
        # histograms of the roots of feature distances, coarse and fine, for a relative cosine target
        self.distances = [torch.zeros_like(self.histogram) for _ in range(2)]
        self.shares = MaskedShares()
        self.loss_sum: float | Tensor = 0.0  # sum of mask losses
        self.loss_count = 0.0
        self._coarse_cameras: dict[int, tuple[Camera, Camera]] = {}  # view -> its camera in both sizes

    def setup(self, data: TrainData) -> None:
        self.data = data
        self.histogram = self.histogram.to(data.device)
        self.distances = [counts.to(data.device) for counts in self.distances]
        _fit(self.fine, data.photos, data)
        self.phi = photo_features(self.fine, data.photos, data.cache_dir)
        small = data.photos  # not read here: they may not fit into memory
        if self.config.coarse_size is None:
            small = [self._coarse_picture(photo) for photo in data.photos]
        _fit(self.coarse, small, data)
        self.phi_coarse = photo_features(self.coarse, small, data.cache_dir)
        self.inputs = [self._inputs(phi) for phi in self.phi]
        self.net = MaskNet(*self._statistics(), self.config.net_hidden, data.seed)
        self.optimiser = adam_of(self.net, self.config.net_lr, data.device)

    def keep(self, step: Step) -> Tensor | None:
        if not self.begun(step):
            return None
        if self.paused(step):
            keep = self._cut(self._map(step))
        else:
            with torch.enable_grad():
                mask = self._map(step)
                loss = self._loss(mask, step)
                self.optimiser.zero_grad(set_to_none=True)
                loss.backward()
            keep = self._cut(mask.detach())  # from the net before this step, as in the authors' code
            self.optimiser.step()
            self.loss_sum = self.loss_sum + backend_of(loss.device).number(loss)
            self.loss_count += 1
        self.shares.take(step.view, keep)
        return keep

    def predict(self, step: Step) -> Tensor | None:
        return self._cut(self._map(step)) if self.begun(step) else None

    def facts(self) -> Facts:
        return {
            **super().facts(),
            "mask_loss_mean": float(self.loss_sum) / self.loss_count if self.loss_count else None,
            "features": self.fine.name,
        }

    @torch.no_grad()
    def panels(self, step: Step) -> dict[str, np.ndarray]:
        mask = self._map(step)
        masked = self._cut(mask).cpu().numpy() < 0.5
        stage = "coarse" if step.nominal < self.config.bootstrap else "fine"
        photo = faded((step.photo.cpu().numpy() * 255 + 0.5).astype(np.uint8))
        used = "" if self.begun(step) else ", not used yet"
        return {
            f"disagreement, {stage}": ramp(1.0 - self._target(step).cpu().numpy(), 0.0, 1.0),
            "the net": ramp(1.0 - mask.cpu().numpy(), 0.0, 1.0),
            f"masked {100 * masked.mean():.0f} %{used}": tint(photo, masked, MASKED),
        }

    # -- the net ----------------------------------------------------------------------------------

    def _map(self, step: Step) -> Tensor:
        """Return M [H, W] in (0, 1) at the step's resolution; differentiable if gradients are enabled."""
        height, width = step.photo.shape[:2]
        if torch.is_grad_enabled():
            return self.net(self.inputs[step.view], height, width)
        return self.net(self.inputs[step.view], height, width).detach()

    def _cut(self, mask: Tensor) -> Tensor:
        return masking_common.keep_of(mask.detach(), self.config.threshold, self.config.erosion)

    def _loss(self, mask: Tensor, step: Step) -> Tensor:
        with torch.no_grad():
            lower, upper = self._bounds(step)
            target = self._target(step, learning=True)
        return mask_loss(mask, target, lower, upper, step.nominal, self.config)

    # -- supervision ------------------------------------------------------------------------------

    def _target(self, step: Step, *, learning: bool = False) -> Tensor:
        """Return T_cos [H, W] of the render, coarse before the switch and fine after."""
        early = step.nominal < self.config.bootstrap
        features, phi = (self.coarse, self.phi_coarse) if early else (self.fine, self.phi)
        full = self.data.cameras[step.view]  # not the photo, which may not be on the device
        image = resized(step.rendered.image.detach(), full.height, full.width)
        seen = features(self._coarse_picture(image) if early else image)
        cosine = F.cosine_similarity(phi[step.view], seen, dim=2)
        if self.config.cosine == "relative":
            target = self._relative_target(cosine, 0 if early else 1, learning)
        else:
            if self._calibrate:
                cosine = masking_common.calibrated(cosine, features.unit, self.config.normal_units)
            target = masking_common.cosine_target(cosine)
        return resized(target, *step.photo.shape[:2])

    def _relative_target(self, cosine: Tensor, stage: int, learning: bool) -> Tensor:
        """Return the target relative to the distances that renders of this stage lately had."""
        distance = 0.5 * (1.0 - cosine).clamp(0.0, 2.0)
        # the histogram is of roots, or small distances would share a bin
        counts = masking_common.update_histogram(self.distances[stage], distance.sqrt(), self.config.decay)
        if learning:
            self.distances[stage] = counts
        usual = masking_common.percentile(counts, self.config.lower) ** 2
        return masking_common.relative_target(distance, usual, self.config.reach)

    def _bounds(self, step: Step) -> tuple[Tensor, Tensor]:
        """Return the bounds [H, W], after adding this step's residuals to the running histogram."""
        config = self.config
        if step.nominal < config.bootstrap:
            e = masking_common.residual(shrink(step.photo, config.coarse_divisor), self._coarse_render(step))
        else:
            e = masking_common.residual(step.photo, step.rendered.image.detach())
        self.histogram = masking_common.update_histogram(self.histogram, e, config.decay)
        size = step.photo.shape[:2]
        lower, upper = (
            resized(masking_common.inlier_map(e, masking_common.percentile(self.histogram, share)), *size)
            for share in (config.lower, config.upper)
        )
        return lower, upper

    def _coarse_render(self, step: Step) -> Tensor:
        """Draw the scene at a quarter of the size, without a backward pass. The camera sees what the step's
        camera sees, so the optimiser has already brought the rows up to date."""
        config = self.config
        if config.coarse_render == "shrink":
            return shrink(step.rendered.image.detach(), config.coarse_divisor)
        pair = self._coarse_cameras.get(step.view)
        if pair is None or pair[0] is not step.camera:  # kept, because a renderer copies every new camera
            pair = (step.camera, shrink_camera(step.camera, config.coarse_divisor))
            self._coarse_cameras[step.view] = pair
        return step.draw(camera=pair[1]).image.detach()

    def _coarse_picture(self, image: Tensor) -> Tensor:
        """Return the input of coarse features: a smaller picture, except for nets that resize themselves."""
        if self.config.coarse_size is not None:
            return image
        share = self.config.coarse_share
        size = [max(round(side * share), 8) for side in image.shape[:2]]
        chw = image.permute(2, 0, 1)[None]
        small = F.interpolate(chw, size=size, mode="bilinear", align_corners=False, antialias=True)
        return small[0].permute(1, 2, 0).contiguous()

    @property
    def _calibrate(self) -> bool:
        return self.config.cosine == "calibrated" or (self.config.cosine == "auto" and self.config.local)

    def _inputs(self, phi: Tensor) -> Tensor:
        """Return the net's input of a photo: features, and means of local ones over boxes, [h, w, C']."""
        if not self.config.net_context:
            return phi
        maps = phi.permute(2, 0, 1)[None]
        wide = [
            F.avg_pool2d(maps, size, stride=1, padding=size // 2, count_include_pad=False)
            for size in self.config.net_context
        ]
        return torch.cat([maps, *wide], dim=1)[0].permute(1, 2, 0).contiguous()

    def _statistics(self) -> tuple[Tensor, Tensor]:
        """Return mean and std [C] that standardise the net's inputs."""
        channels = self.inputs[0].shape[2]
        raw = self.config.inputs == "raw" or (self.config.inputs == "auto" and not self.config.local)
        if raw:
            device = self.data.device
            return torch.zeros(channels, device=device), torch.ones(channels, device=device)
        cells = torch.cat([x.reshape(-1, channels) for x in self.inputs]).double()
        return cells.mean(0).float(), cells.std(0, correction=0).clamp(min=1e-6).float()

    # -- when -------------------------------------------------------------------------------------

    def pause_iterations(self, step: Step) -> float:
        # multiplied first: the last bit decides whether long runs pause for one more iteration
        return self.config.reset_pause * step.iteration / step.nominal

    # -- state ------------------------------------------------------------------------------------

    def state_dict(self) -> State:
        return {
            **super().state_dict(),
            **learner_state(self.net, self.optimiser),
            "histogram": self.histogram,
            "distances": self.distances,
            "losses": [float(self.loss_sum), self.loss_count],
        }

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        load_learner(self.net, self.optimiser, state)
        self.histogram = state["histogram"].to(self.data.device)
        self.distances = [counts.to(self.data.device) for counts in state["distances"]]
        self.loss_sum, self.loss_count = state["losses"]


def _fit(features: Features, photos: Sequence[Tensor], data: TrainData) -> None:
    """Fit features to photos, which may be smaller than the scene's; tracks are in px of the scene's."""
    from ambiguous_wild.methods.refinesplat.inputs import train_tracks  # wants SciPy
    from ambiguous_wild.vision.sceneconv import SceneConv

    if not isinstance(features, SceneConv):
        features.fit(photos)
        return

    point, photo, xy = train_tracks(data.scene)
    scale = photos[0].shape[1] / data.cameras[0].width
    features.fit_scene(photos, (point, photo, xy * scale), data.cache_dir)


def coarse_spec(config: RobustSplatConfig) -> str:
    """Return the features of the coarse stage: the same back end with an input of `coarse_size`."""
    if config.coarse_size is None:
        return config.features
    spec = parse_spec(config.features)
    head = f"{spec.name}@{config.coarse_size}"
    return head + "".join(f",{key}={value}" for key, value in spec.options.items())


def build(options: RobustSplatConfig) -> MethodHooks:
    """Return 3DGS with a mask net, delayed growth, and both pictures masked before SSIM."""
    return MethodHooks(
        mask=RobustSplatMask(options),
        density_config=options.density,
        schedule=Schedule(lr_opacity=options.lr_opacity),
        lambda_dssim=options.lambda_dssim,
        weighting="images",
    )
