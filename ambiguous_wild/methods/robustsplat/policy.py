"""RobustSplat's mask policy: a net on frozen features, taught coarse to fine from agreement with renders."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.io.palette import MASKED, faded, ramp, tint
from ambiguous_wild.methods.masking_common import MaskedShares, PausingMask, upsampled
from ambiguous_wild.methods.robustsplat import supervision
from ambiguous_wild.methods.robustsplat.config import RobustSplatConfig
from ambiguous_wild.methods.robustsplat.net import MaskNet, adam_of, adam_state, load_adam_state
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.data import shrink, shrink_camera
from ambiguous_wild.splat.parts import State
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import make_features, parse
from ambiguous_wild.vision.precompute import photo_features
from ambiguous_wild.vision.protocols import Features, SceneFeatures


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
        return supervision.keep_of(mask.detach(), self.config.threshold, self.config.erosion)

    def _loss(self, mask: Tensor, step: Step) -> Tensor:
        config = self.config
        with torch.no_grad():
            lower, upper = self._bounds(step)
            target = self._target(step, learning=True)
        return supervision.mask_loss(
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
                cosine = supervision.calibrated(cosine, features.unit, self.config.normal_units)
            target = supervision.cosine_target(cosine)
        return supervision.resized(target, *step.photo.shape[:2])

    def _relative_target(self, cosine: Tensor, stage: int, learning: bool) -> Tensor:
        """Against what the renders of this stage lately lacked."""
        distance = 0.5 * (1.0 - cosine).clamp(0.0, 2.0)
        # counted by the root, or small distances would share a bin
        counts = supervision.update_histogram(self.distances[stage], distance.sqrt(), self.config.decay)
        if learning:
            self.distances[stage] = counts
        usual = supervision.percentile(counts, self.config.lower) ** 2
        return supervision.relative_target(distance, usual, self.config.reach)

    def _bounds(self, step: Step) -> tuple[Tensor, Tensor]:
        """Lower and upper bound [H, W]; this step's residuals enter the running histogram first."""
        config = self.config
        if step.nominal < config.bootstrap:
            e = supervision.residual(shrink(step.photo, config.coarse_divisor), self._coarse_render(step))
        else:
            e = supervision.residual(step.photo, step.rendered.image.detach())
        self.histogram = supervision.update_histogram(self.histogram, e, config.decay)
        size = step.photo.shape[:2]
        lower, upper = (
            supervision.resized(supervision.bound(e, supervision.percentile(self.histogram, share)), *size)
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
