"""RobustSplat's mask policy: a net on frozen features, taught coarse to fine by agreement with renders."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.io.palette import MASKED, faded, ramp, tint
from ambiguous_wild.methods.later import later
from ambiguous_wild.methods.robustsplat import supervision
from ambiguous_wild.methods.robustsplat.config import RobustSplatConfig
from ambiguous_wild.methods.robustsplat.net import MaskNet, adam_of, adam_state, load_adam_state
from ambiguous_wild.splat.data import shrink, shrink_camera
from ambiguous_wild.splat.parts import MaskPolicy, State
from ambiguous_wild.splat.render import render
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import make_features, parse
from ambiguous_wild.vision.protocols import Features
from ambiguous_wild.vision.stage import photo_features


class RobustSplatMask(MaskPolicy):
    """The net learns every iteration from mask_start on; its map, cut and eroded, is the keep map."""

    def __init__(self, config: RobustSplatConfig, sh_every: float = 1000.0, sh_degree: int = 3) -> None:
        """
        Args:
            config: the method's options.
            sh_every, sh_degree: of the host's schedule, for the coarse render.
        """
        self.config, self.sh_every, self.sh_degree = config, sh_every, sh_degree
        self.fine: Features = make_features(config.features)
        self.coarse: Features = make_features(config.coarse_features or coarse_spec(config))
        self.histogram = torch.zeros(config.bins, dtype=torch.float64)
        self.last_reset = 0  # iteration, 0 = never
        self.shares: dict[int, float | Tensor] = {}  # view: share masked when it was last seen
        self.loss_sum: float | Tensor = 0.0  # of the mask loss
        self.loss_count = 0.0
        self._coarse_cameras: dict[int, tuple[Camera, Camera]] = {}  # view: a step's, and its coarse one

    def setup(self, data: TrainData) -> None:
        self.data = data
        self.histogram = self.histogram.to(data.device)
        self.fine.fit(data.photos)
        self.phi = photo_features(self.fine, data.photos, data.cache_dir)
        small = [self._coarse_picture(photo) for photo in data.photos]
        self.coarse.fit(small)
        self.phi_coarse = photo_features(self.coarse, small, data.cache_dir)
        self.inputs = [self._inputs(phi) for phi in self.phi]
        self.net = MaskNet(*self._statistics(), self.config.net_hidden, data.seed)
        self.optimiser = adam_of(self.net, self.config.net_lr, data.device)

    def keep(self, step: Step) -> Tensor | None:
        if not self._begun(step):
            return None
        if self._paused(step):
            keep = self._cut(self._map(step))
        else:
            with torch.enable_grad():
                mask = self._map(step)
                loss = self._loss(mask, step)
                self.optimiser.zero_grad(set_to_none=True)
                loss.backward()
            keep = self._cut(mask.detach())  # of the net before this step, as the authors have it
            self.optimiser.step()
            self.loss_sum, self.loss_count = self.loss_sum + later(loss), self.loss_count + 1
        self.shares[step.view] = later(1.0 - keep.mean())
        return keep

    def predict(self, step: Step) -> Tensor | None:
        return self._cut(self._map(step)) if self._begun(step) else None

    def on_opacity_reset(self, step: Step) -> None:
        self.last_reset = step.iteration

    def facts(self) -> dict[str, Any]:
        shares = [float(self.shares[view]) for view in sorted(self.shares)]
        return {
            "masked_share": sum(shares) / len(shares) if shares else 0.0,
            "mask_loss_mean": float(self.loss_sum) / self.loss_count if self.loss_count else None,
            "features": self.fine.name,
        }

    @torch.no_grad()
    def panels(self, step: Step) -> dict[str, np.ndarray]:
        mask = self._map(step)
        masked = self._cut(mask).cpu().numpy() < 0.5
        stage = "coarse" if step.nominal < self.config.bootstrap else "fine"
        photo = faded((step.photo.cpu().numpy() * 255 + 0.5).astype(np.uint8))
        used = "" if self._begun(step) else ", not used yet"
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
            target = self._target(step)
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

    def _target(self, step: Step) -> Tensor:
        """T_cos [H, W] of the render, coarse before the switch and fine after."""
        early = step.nominal < self.config.bootstrap
        features, phi = (self.coarse, self.phi_coarse) if early else (self.fine, self.phi)
        full = self.data.cameras[step.view]  # not the photo: it need not lie on the device
        image = _enlarge(step.rendered.image.detach(), full.height, full.width)
        seen = features(self._coarse_picture(image) if early else image)
        cosine = F.cosine_similarity(phi[step.view], seen, dim=2)
        if self._calibrate:
            cosine = supervision.calibrated(cosine, features.unit, self.config.normal_units)
        return supervision.resized(supervision.cosine_target(cosine), *step.photo.shape[:2])

    def _bounds(self, step: Step) -> tuple[Tensor, Tensor]:
        """Lower and upper bound [H, W]; the running histogram takes this step's residuals in first."""
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
        degree = min(int(step.nominal // self.sh_every), self.sh_degree, step.gaussians.sh_degree)
        return render(step.gaussians, known[1], sh_degree=degree).image.detach()

    def _coarse_picture(self, image: Tensor) -> Tensor:
        """What coarse features see: hand-made ones a smaller picture, nets resize by themselves."""
        if not self.config.hand_made:
            return image
        share = self.config.coarse_share
        size = [max(round(side * share), 8) for side in image.shape[:2]]
        chw = image.permute(2, 0, 1)[None]
        small = F.interpolate(chw, size=size, mode="bilinear", align_corners=False, antialias=True)
        return small[0].permute(1, 2, 0).contiguous()

    @property
    def _calibrate(self) -> bool:
        return self.config.cosine == "calibrated" or (self.config.cosine == "auto" and self.config.hand_made)

    def _inputs(self, phi: Tensor) -> Tensor:
        """What the net sees of a photo, [h, w, C']: its features, and hand-made ones averaged more widely."""
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
        raw = self.config.inputs == "raw" or (self.config.inputs == "auto" and not self.config.hand_made)
        if raw:
            device = self.data.device
            return torch.zeros(channels, device=device), torch.ones(channels, device=device)
        cells = torch.cat([x.reshape(-1, channels) for x in self.inputs]).double()
        return cells.mean(0).float(), cells.std(0, correction=0).clamp(min=1e-6).float()

    # -- when -------------------------------------------------------------------------------------

    def _begun(self, step: Step) -> bool:
        return step.nominal >= self.config.mask_start and step.iteration >= self.config.min_mask_start

    def _paused(self, step: Step) -> bool:
        if not self.last_reset:
            return False
        pause = max(self.config.reset_pause * step.iteration / step.nominal, self.config.min_reset_pause)
        return step.iteration - self.last_reset < pause

    # -- state ------------------------------------------------------------------------------------

    def state_dict(self) -> State:
        return {
            "net": {name.replace(".", "_"): value for name, value in self.net.state_dict().items()},
            "adam": adam_state(self.optimiser),
            "histogram": self.histogram,
            "last_reset": self.last_reset,
            "shares": {str(view): float(share) for view, share in self.shares.items()},
            "losses": [float(self.loss_sum), self.loss_count],
        }

    def load_state_dict(self, state: State) -> None:
        names = list(self.net.state_dict())
        self.net.load_state_dict({name: state["net"][name.replace(".", "_")] for name in names})
        load_adam_state(self.optimiser, state["adam"])
        self.histogram = state["histogram"].to(self.data.device)
        self.last_reset = int(state["last_reset"])
        self.shares = {int(view): float(share) for view, share in state["shares"].items()}
        self.loss_sum, self.loss_count = state["losses"]


def coarse_spec(config: RobustSplatConfig) -> str:
    """The coarse stage's features: the same back end, a net's picture at `coarse_share` of the size."""
    if config.hand_made:
        return config.features
    found = parse(config.features)
    head = f"{found.name}@{round((found.size or 504) * config.coarse_share)}"
    return head + "".join(f",{key}={value}" for key, value in found.options.items())


def _enlarge(image: Tensor, height: int, width: int) -> Tensor:
    """A render [h, w, 3] at [height, width, 3], the size of its photo, bilinear."""
    if image.shape[:2] == (height, width):
        return image
    chw = image.permute(2, 0, 1)[None]
    return F.interpolate(chw, size=(height, width), mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
