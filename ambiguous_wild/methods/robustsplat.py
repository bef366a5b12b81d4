"""RobustSplat as a recipe of parts.

Source: "RobustSplat: Decoupling Densification and Dynamics for Transient-Free 3DGS", ICCV 2025 (arXiv
2506.02751) and its released code. Densification and opacity resets wait until the static scene and the
masks are stable; a per-pixel net on frozen features learns from the agreement of photos with renders,
first at a low scale.

The published form is `features=dinov2-small-registers@504,normalise=raw`, the default where its weights are;
else EfficientNet-Lite0, else hand-made features (Lab and HOG). Settings that change with that are "auto" in
`config.py`.

RobustSplat's mask policy: a net on frozen features, taught coarse to fine from agreement with renders.

Every hyper-parameter of RobustSplat in one place; values without a comment are the authors'.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import AwError, Camera
from ambiguous_wild.core.config import State
from ambiguous_wild.io.palette import MASKED, faded, ramp, tint
from ambiguous_wild.methods import masking_common
from ambiguous_wild.methods.mask_net import MaskNet, adam_of, adam_state, load_adam_state
from ambiguous_wild.methods.masking_common import MaskedShares, PausingMask, upsampled
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.data import shrink, shrink_camera
from ambiguous_wild.splat.density import NO_SIZE_PRUNING, DensityConfig
from ambiguous_wild.splat.parts import Parts, Schedule
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import BY_MACHINE, DINO, check_features, first_here, make_features, parse
from ambiguous_wild.vision.precompute import photo_features
from ambiguous_wild.vision.protocols import Features, SceneFeatures

_SIZES = dict.fromkeys((*DINO, "vgg16"), 252)  # px of a net's input without "@"; others take the photo's size
PUBLISHED = "dinov2-small-registers@504,normalise=raw"


def features() -> str:
    """The published features where their weights are on this machine, else EfficientNet-Lite0, else `labhog`.

    Of those that need no hub EfficientNet-Lite0 alone falls below 3DGS on no capture (docs/fidelity.md).
    """
    return first_here(PUBLISHED, "efficientnet-lite0", "labhog")


def _delayed_growth() -> DensityConfig:
    return DensityConfig(
        start=10_000.0, stop=20_000.0, resets=(15_000.0, 18_000.0), prune_scale=NO_SIZE_PRUNING
    )


@dataclass(frozen=True)
class RobustSplatConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run.

    "auto" and None are the published form with DINO's features, and with all others, whose cells see a small
    part of the photo and whose cosines have other scales, what was tuned with `labhog` on
    two simulated captures that are not reported (240x135, 2000 iterations, 10 900 Gaussians). Distractors in
    the background's colours: 26.3 dB and IoU 0.41 with features of the cell alone, 29.1 dB and 0.62 with
    wider context and a wider net, both at lr 0.003; twins of static things: 29.5 dB and 0.68 with the latter.
    """

    features: str = field(default_factory=features, metadata=BY_MACHINE)  # see vision/backends.py
    coarse_features: str = ""  # of the coarse stage; "" = the same kind at 16/36 of the size, as published
    coarse_share: float = 16 / 36  # of the side of the pictures that coarse features see
    # what the cosine target is made of: the cosine; its distance in units of what blur makes; or in units of
    # the distance that a share `lower` of all cells lately stayed below
    cosine: Literal["auto", "calibrated", "plain", "relative"] = "auto"
    reach: float = 3.0  # of those units, where the relative target is 0
    normal_units: float = (
        10.0  # of distance, where the calibrated cosine is 0; the target is 0 from half of it on
    )
    inputs: Literal["auto", "standardised", "raw"] = "auto"  # of the net
    # cells over which local features are averaged and put beside the cell's own: a token of DINO sees the
    # whole photo, a cell of labhog 20 px
    context: tuple[int, ...] | None = None  # None: 5,15 with local features; DINO never takes any
    hidden: int | None = None  # None: 16, published; 64 with local features
    lr: float | None = None  # None: 0.001, published; 0.003 with local features
    density: DensityConfig = field(default_factory=_delayed_growth)
    lr_opacity: float = 0.025
    lambda_dssim: float = 0.2
    mask_start: float = 500.0
    min_mask_start: int = 300  # earlier renders show too little
    bootstrap: float = 20_000.0  # coarse supervision before, fine after
    coarse_divisor: int = 4  # of the render's side for the coarse residual
    coarse_render: Literal["render", "shrink"] = "render"  # a render of its own, or the full one shrunk
    lower: float = 0.6  # share of residuals that are surely static
    upper: float = 0.8  # share that may be static
    decay: float = 0.95  # of the running histogram
    bins: int = 10_000
    beta: float = 2000.0  # decay of the pull towards "all static"
    lambda_pull: float = 2.0
    lambda_cosine: float = 0.5
    lambda_residual: float = 0.5
    threshold: float = 0.25  # kept above
    erosion: int = 7  # px, side of the min-pool
    reset_pause: float = 300.0  # the net does not learn for so long after an opacity reset
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
        """Sides in cells of the boxes whose means the net sees beside a cell's own features."""
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
        return parse(self.features).name not in DINO

    @property
    def coarse_size(self) -> int | None:
        """Longer side in px of the coarse net's input; None: the features follow the size of the picture."""
        found = parse(self.features)
        size = _SIZES.get(found.name, 0) if found.size is None else found.size
        if found.size == 0 or not size:
            return None
        return round(size * self.coarse_share)


class RobustSplatMask(PausingMask):
    """The net learns every iteration from mask_start on; its map, thresholded and eroded, is the keep map."""

    config: RobustSplatConfig

    def __init__(self, config: RobustSplatConfig) -> None:
        self.config = config
        self.fine: Features = make_features(config.features)
        self.coarse: Features = make_features(config.coarse_features or coarse_spec(config))
        self.histogram = torch.zeros(config.bins, dtype=torch.float64)
        # roots of feature distances, coarse and fine; where the cosine target is relative
        self.distances = [torch.zeros_like(self.histogram) for _ in range(2)]
        self.shares = MaskedShares()
        self.loss_sum: float | Tensor = 0.0  # of the mask loss
        self.loss_count = 0.0
        self._coarse_cameras: dict[int, tuple[Camera, Camera]] = {}  # view: a step's, and its coarse one

    def setup(self, data: TrainData) -> None:
        self.data = data
        self.histogram = self.histogram.to(data.device)
        self.distances = [counts.to(data.device) for counts in self.distances]
        _fit(self.fine, list(data.photos), data)
        self.phi = photo_features(self.fine, data.photos, data.cache_dir)
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
            keep = self._cut(mask.detach())  # of the net before this step, as the authors have it
            self.optimiser.step()
            self.loss_sum = self.loss_sum + backend_of(loss.device).number(loss)
            self.loss_count += 1
        self.shares.take(step.view, keep)
        return keep

    def predict(self, step: Step) -> Tensor | None:
        return self._cut(self._map(step)) if self.begun(step) else None

    def facts(self) -> dict[str, Any]:
        return {
            "masked_share": self.shares.mean(),
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
        """M [H, W] in (0, 1) at the step's resolution; differentiable where gradients are enabled."""
        height, width = step.photo.shape[:2]
        if torch.is_grad_enabled():
            return self.net(self.inputs[step.view], height, width)
        return self.net(self.inputs[step.view], height, width).detach()

    def _cut(self, mask: Tensor) -> Tensor:
        return masking_common.keep_of(mask.detach(), self.config.threshold, self.config.erosion)

    def _loss(self, mask: Tensor, step: Step) -> Tensor:
        config = self.config
        with torch.no_grad():
            lower, upper = self._bounds(step)
            target = self._target(step, learning=True)
        return masking_common.mask_loss(
            mask,
            target,
            lower,
            upper,
            step.nominal,
            lambda_cosine=config.lambda_cosine,
            lambda_residual=config.lambda_residual,
            lambda_pull=config.lambda_pull,
            beta=config.beta,
        )

    # -- supervision ------------------------------------------------------------------------------

    def _target(self, step: Step, *, learning: bool = False) -> Tensor:
        """T_cos [H, W] of the render, coarse before the switch and fine after."""
        early = step.nominal < self.config.bootstrap
        features, phi = (self.coarse, self.phi_coarse) if early else (self.fine, self.phi)
        full = self.data.cameras[step.view]  # not the photo, which may not be on the device
        image = upsampled(step.rendered.image.detach(), full.height, full.width)
        seen = features(self._coarse_picture(image) if early else image)
        cosine = F.cosine_similarity(phi[step.view], seen, dim=2)
        if self.config.cosine == "relative":
            target = self._relative_target(cosine, 0 if early else 1, learning)
        else:
            if self._calibrate:
                cosine = masking_common.calibrated(cosine, features.unit, self.config.normal_units)
            target = masking_common.cosine_target(cosine)
        return masking_common.resized(target, *step.photo.shape[:2])

    def _relative_target(self, cosine: Tensor, stage: int, learning: bool) -> Tensor:
        """Against what the renders of this stage lately lacked."""
        distance = 0.5 * (1.0 - cosine).clamp(0.0, 2.0)
        # counted by the root, or small distances would share a bin
        counts = masking_common.update_histogram(self.distances[stage], distance.sqrt(), self.config.decay)
        if learning:
            self.distances[stage] = counts
        usual = masking_common.percentile(counts, self.config.lower) ** 2
        return masking_common.relative_target(distance, usual, self.config.reach)

    def _bounds(self, step: Step) -> tuple[Tensor, Tensor]:
        """Lower and upper bound [H, W]; this step's residuals enter the running histogram first."""
        config = self.config
        if step.nominal < config.bootstrap:
            e = masking_common.residual(shrink(step.photo, config.coarse_divisor), self._coarse_render(step))
        else:
            e = masking_common.residual(step.photo, step.rendered.image.detach())
        self.histogram = masking_common.update_histogram(self.histogram, e, config.decay)
        size = step.photo.shape[:2]
        lower, upper = (
            masking_common.resized(
                masking_common.bound(e, masking_common.percentile(self.histogram, share)), *size
            )
            for share in (config.lower, config.upper)
        )
        return lower, upper

    def _coarse_render(self, step: Step) -> Tensor:
        """The scene at a quarter of the size. Its camera sees what the step's sees, so the optimiser has
        brought every row it needs up to date; there is no backward pass."""
        config = self.config
        if config.coarse_render == "shrink":
            return shrink(step.rendered.image.detach(), config.coarse_divisor)
        known = self._coarse_cameras.get(step.view)
        if known is None or known[0] is not step.camera:  # a renderer copies a camera it has not met
            known = (step.camera, shrink_camera(step.camera, config.coarse_divisor))
            self._coarse_cameras[step.view] = known
        return step.draw(camera=known[1]).image.detach()

    def _coarse_picture(self, image: Tensor) -> Tensor:
        """The input of coarse features: a smaller picture, except for nets that resize by themselves."""
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
        """The net's input of a photo, [h, w, C']: features; local ones also averaged more widely."""
        if not self.config.net_context:
            return phi
        maps = phi.permute(2, 0, 1)[None]
        wide = [
            F.avg_pool2d(maps, size, stride=1, padding=size // 2, count_include_pad=False)
            for size in self.config.net_context
        ]
        return torch.cat([maps, *wide], dim=1)[0].permute(1, 2, 0).contiguous()

    def _statistics(self) -> tuple[Tensor, Tensor]:
        """Mean and std [C] that the net's inputs are standardised by."""
        channels = self.inputs[0].shape[2]
        raw = self.config.inputs == "raw" or (self.config.inputs == "auto" and not self.config.local)
        if raw:
            device = self.data.device
            return torch.zeros(channels, device=device), torch.ones(channels, device=device)
        cells = torch.cat([x.reshape(-1, channels) for x in self.inputs]).double()
        return cells.mean(0).float(), cells.std(0, correction=0).clamp(min=1e-6).float()

    # -- when -------------------------------------------------------------------------------------

    def pause_iterations(self, step: Step) -> float:
        # multiplied first: the last bit decides whether some runs of over 20 000 iterations rest one more
        return self.config.reset_pause * step.iteration / step.nominal

    # -- state ------------------------------------------------------------------------------------

    def state_dict(self) -> State:
        return {
            "net": {name.replace(".", "_"): value for name, value in self.net.state_dict().items()},
            "adam": adam_state(self.optimiser),
            "histogram": self.histogram,
            "distances": self.distances,
            "last_reset": self.last_reset,
            "shares": self.shares.state_dict(),
            "losses": [float(self.loss_sum), self.loss_count],
        }

    def load_state_dict(self, state: State) -> None:
        names = list(self.net.state_dict())
        self.net.load_state_dict({name: state["net"][name.replace(".", "_")] for name in names})
        load_adam_state(self.optimiser, state["adam"])
        self.histogram = state["histogram"].to(self.data.device)
        self.distances = [counts.to(self.data.device) for counts in state["distances"]]
        self.last_reset = int(state["last_reset"])
        self.shares = MaskedShares.from_state(state["shares"])
        self.loss_sum, self.loss_count = state["losses"]


def _fit(features: Features, photos: list[Tensor], data: TrainData) -> None:
    """Fit to the photos, which may be smaller than the scene's; tracks are in px of the scene's."""
    if not isinstance(features, SceneFeatures):
        features.fit(photos)
        return
    from ambiguous_wild.methods.refinesplat.inputs import train_tracks  # wants SciPy

    point, photo, xy = train_tracks(data.scene)
    scale = photos[0].shape[1] / data.photos[0].shape[1]
    features.fit_scene(photos, (point, photo, xy * scale), data.cache_dir)


def coarse_spec(config: RobustSplatConfig) -> str:
    """The coarse stage's features: the same back end, a net's picture at `coarse_share` of the size."""
    if config.coarse_size is None:
        return config.features
    found = parse(config.features)
    head = f"{found.name}@{config.coarse_size}"
    return head + "".join(f",{key}={value}" for key, value in found.options.items())


Config = RobustSplatConfig


def build(options: RobustSplatConfig) -> Parts:
    """Mask net, delayed growth, both pictures masked before SSIM; the rest of the loop is 3DGS."""
    return Parts(
        mask=RobustSplatMask(options),
        density_config=options.density,
        schedule=Schedule(lr_opacity=options.lr_opacity),
        lambda_dssim=options.lambda_dssim,
        weighting="images",
    )
