"""RefineSplat as a recipe: its mask policy, the losses L_id and L_cr, and the parts of the training loop.

The mask policy decides when masks are made and refreshed, what is learnt, and what is saved. The losses (Eq.
13) give a gradient to the image through frozen features.

Source: "Rectifying Mask via Entropy for Distractor-Free 3DGS in Ambiguous Scenarios" (WACV 2027 submission).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.io.keep_resize import smaller_keep
from ambiguous_wild.io.mask_reasons import MaskReasons
from ambiguous_wild.io.motion_points import MotionPoints, read_motion_points
from ambiguous_wild.methods.masking_common import PausingMask, resized
from ambiguous_wild.methods.refinesplat import mask_pictures
from ambiguous_wild.methods.refinesplat.density_control import EntropyAwareDensity
from ambiguous_wild.methods.refinesplat.evidence import ComparisonMaps, compare, mask_unlearnt
from ambiguous_wild.methods.refinesplat.hyperparameters import RefineSplatConfig
from ambiguous_wild.methods.refinesplat.inputs import FrozenInputs
from ambiguous_wild.methods.refinesplat.maps import EnlargedMaps
from ambiguous_wild.methods.refinesplat.mask_prior import InitialMaskPrior, initial_mask_prior, masked_share
from ambiguous_wild.methods.refinesplat.masks import MaskStore
from ambiguous_wild.methods.refinesplat.threshold import Variant
from ambiguous_wild.methods.wildgaussians import WildAppearance, WildGaussiansConfig
from ambiguous_wild.splat.data import shrink_keep
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.method_hooks import MethodHooks, Schedule
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.vision.backends import make_features, make_instances
from ambiguous_wild.vision.motion_maps import certainly_moving, moving_labels, moving_map
from ambiguous_wild.vision.protocols import Instances
from ambiguous_wild.vision.segments import GraphSegments
from ambiguous_wild.vision.sparse_surface import static_surfaces


def identity_loss(
    logits: Tensor,  # [n, P]
    identities: Tensor,  # [n] int64 in 0..P; 0 = none
    weights: Tensor,  # [n] >= 0, the keep map at these cells
    variant: Variant = "sigmoid",
) -> Tensor:
    """Return L_id = CE(psi(phi(render)), identities), a mean over cells weighted by keep.

    Without weights the loss would make the render show the distractor. sigmoid: binary cross-entropy, one
    against rest, summed over identities; cells without identity are ignored.
    """
    counts = weights * (identities > 0)
    index = (identities - 1).clamp(min=0)[:, None]
    if variant == "sigmoid":
        # sum_k softplus(E_k) - E_target: binary cross-entropy against a one-hot target
        cells = F.softplus(logits).sum(1) - logits.gather(1, index)[:, 0]
    elif variant == "softmax":
        cells = -F.log_softmax(logits, 1).gather(1, index)[:, 0]
    else:
        raise unknown("entropy variant", variant, ("sigmoid", "softmax"))
    return (counts * cells).sum() / counts.sum().clamp(min=1e-6)


def consistency_loss(logits: Tensor, one_hot: Tensor, variant: Variant = "sigmoid") -> Tensor:
    """Return L_cr = 1/K sum_j mean_{p,q in j} KL(sigma(E(p)) || sigma(E(q))), in O(N).

    The paper prints a double loop over pixel pairs. With s = sigma(E), the mean of s_p (log s_p - log s_q)
    over pairs is mean_p[s log s] - mean_p[s] mean_q[log s], per channel; with the same for 1 - s, the
    covariance of s and E.

    Args:
        logits: [n, P].
        one_hot: [K, n] float, membership of each cell in each instance (weights are allowed: keep).
            Instances without cells are ignored.
        variant: sigmoid sums both sides of each channel; softmax has one distribution.
    """
    sizes = one_hot.sum(1)
    used = sizes > 0
    # instances without cells stay, with weights of 0, so that the host need not read which these are
    weights = one_hot / torch.where(used, sizes, 1.0)[:, None]
    # logits beyond +-1e4 are saturated; the clamp keeps products finite
    logits = logits.clamp(-1e4, 1e4)
    if variant == "sigmoid":
        # both sides of a channel in one: log s - log(1 - s) is the logit
        s, log_s = torch.sigmoid(logits), logits
    elif variant == "softmax":
        s, log_s = torch.softmax(logits, 1), F.log_softmax(logits, 1)
    else:
        raise unknown("entropy variant", variant, ("sigmoid", "softmax"))
    index = one_hot.argmax(0)  # the instance of each cell; cells without one have weight 0
    with torch.no_grad():  # the means need no gradient, as deviations from them sum to 0
        middle, middle_log = (weights @ s)[index], (weights @ log_s)[index]
    # mean[s l] - mean[s] mean[l] = mean[(s - mean s) (l - mean l)]: if the cells agree, the first form is a
    # difference of numbers that are equal to seven digits
    total = weights @ ((s - middle) * (log_s - middle_log)).sum(1)
    return total.sum() / used.sum().clamp(min=1)


def instance_matrix(labels: Tensor, count: int, weights: Tensor | None = None) -> Tensor:
    """Return the membership [count, n] float32 of cells in instances 1..count; labels [n], 0 = none.

    The matrix is dense, because sums by matmul, unlike scatter adds, repeat bit for bit.
    """
    ids = torch.arange(1, count + 1, device=labels.device)
    matrix = (labels[None, :] == ids[:, None]).float()
    return matrix if weights is None else matrix * weights[None, :]


class RefineSplatMask(PausingMask):
    """Entropy-aware local and global masks, stored per view and refreshed as the render improves."""

    config: RefineSplatConfig
    inputs: FrozenInputs
    masks: MaskStore

    def __init__(
        self,
        config: RefineSplatConfig,
        instances: Instances | None = None,
    ) -> None:
        self.config = config
        self.features = make_features(config.features)
        self.instances = instances or _instances(config)
        self.visits: dict[int, int] = {}  # view -> number of steps since masks began
        self.points: dict[str, MotionPoints] = {}  # photo's name -> its moving and static features
        self.priors: dict[int, InitialMaskPrior] = {}  # view -> its comparison with other photos, if any

    def setup(self, data: TrainData) -> None:
        self.data = data
        self.inputs = FrozenInputs(data, self.features, self.instances, self.config)
        config = self.config
        if self._reads_identities:
            _ = self.inputs.semantics  # computed now, as a cost of the method before its first step
        surfaces = static_surfaces(data.cameras, data.scene.points.sure_xyz)
        if config.first_look.on:
            moving, certain = self._moving(surfaces) if config.first_look.motion > 0 else (None, None)
            photos = (photo.cpu().numpy() for photo in data.photos)  # one at a time: all may not fit
            priors = initial_mask_prior(data.cameras, photos, surfaces, config.first_look, moving, certain)
            self.priors = {view: prior for view, prior in enumerate(priors) if prior is not None}
        labels, static = self.inputs.labels, self.inputs.static
        self.masks = MaskStore(config, data, surfaces, self.priors, labels, static, self.compare)
        # keep map of each view before masks begin, [H, W] bool; None if everything is kept
        self.first = EnlargedMaps(self._first_keep, len(data.photos), data.device)

    def _first_keep(self, view: int) -> np.ndarray | None:
        prior, camera = self.priors.get(view), self.data.cameras[view]
        return None if prior is None else prior.keep((camera.height, camera.width))

    def _moving(
        self, surfaces: list[np.ndarray | None]
    ) -> tuple[list[np.ndarray | None], list[np.ndarray | None]]:
        """Return what moves in each photo, and for certain, in the shape of its surface; None if unknown."""
        points = self.points = read_motion_points(self.data.scene.root)
        data = self.data
        by_photo: list[np.ndarray | None] = [None] * len(surfaces)
        certain: list[np.ndarray | None] = [None] * len(surfaces)
        for k, (view, surface) in enumerate(zip(data.scene.train, surfaces, strict=True)):
            of_photo, photo, labels = points.get(view.name), data.photos[k], self.inputs.labels[k]
            if of_photo is not None and surface is not None:
                labels = labels.astype(np.int32)
                labels = moving_labels(self.instances, photo, labels, of_photo, data.cache_dir)
                moving = by_photo[k] = moving_map(of_photo, labels, surface.shape)
                certain[k] = certainly_moving(of_photo, moving)
        return by_photo, certain

    def keep(self, step: Step) -> Tensor | None:
        if not self.begun(step):
            first = self.first[step.view]
            return None if first is None else shrink_keep(first.float(), step.downsampling)
        visit = self.visits.get(step.view, 0)
        due = step.view not in self.masks.keeps or visit % self.config.mask_every == 0
        if due and not self.paused(step):
            self.masks.renew(step)
        self.visits[step.view] = visit + 1
        stored = self.masks.keeps.get(step.view)
        if stored is None:
            return None
        keep = stored.float()
        return shrink_keep(1.0 - keep if self.config.factor == "transient" else keep, step.downsampling)

    def cotangent(self, step: Step, keep: Tensor | None) -> Tensor | None:
        """Return d(lambda_id L_id + lambda_cr L_cr)/dimage through the frozen features and psi."""
        config = self.config
        if not self.regularises() or not self.begun(step) or step.iteration % config.entropy_every:
            return None
        if self.inputs.semantics.psi is None:
            return None
        image = step.rendered.image.detach().clone().requires_grad_(True)
        with torch.enable_grad():
            loss = self._entropy_terms(image, step, keep)
            (gradient,) = torch.autograd.grad(loss, image)
        return self._limited(gradient, step, keep) * config.entropy_every

    def _limited(self, gradient: Tensor, step: Step, keep: Tensor | None) -> Tensor:
        """Limit the entropy terms' gradient to `entropy_limit` times the L2 norm of that of L_GS."""
        config = self.config
        if config.entropy_limit <= 0:
            return gradient
        photo = photometric(
            step.rendered.image, step.photo, keep, lambda_dssim=config.lambda_dssim, weighting=config.ssim
        )
        longest = config.entropy_limit * torch.linalg.vector_norm(photo.d_image)
        # a product instead of a test, so that the host of an accelerator does not wait
        return gradient * (longest / torch.linalg.vector_norm(gradient).clamp(min=1e-30)).clamp(max=1.0)

    def regularises(self) -> bool:
        return self.config.lambda_id > 0 or self.config.lambda_cr > 0

    def predict(self, step: Step) -> Tensor | None:
        if not self.begun(step):
            return None
        return shrink_keep(self.masks.examine(step)[1].keep, step.downsampling)

    def facts(self) -> Facts:
        shares = self.masks.shares
        rows = np.array([shares[view] for view in sorted(shares)], dtype=np.float64).reshape(-1, 4)
        finite = rows[np.isfinite(rows[:, 3]), 3]
        mean = rows[:, :3].mean(axis=0) if len(rows) else np.zeros(3)
        return {
            "masked_share": float(mean[0]),
            "masked_share_local": float(mean[1]),
            "masked_share_global": float(mean[2]),
            "t_ent_mean": float(finite.mean()) if len(finite) else None,
            "w2": self.masks.w2,
            # mean share of a photo that the prior masks
            "first_look_share": masked_share([prior.passing for prior in self.priors.values()]),
            # not if only pictures read identities
            "identities": self.inputs.semantics.association.count if self._reads_identities else None,
        }

    @property
    def _reads_identities(self) -> bool:
        """Whether masks or losses read identities; pictures always do."""
        return self.config.mask.needs_identities or self.regularises()

    @torch.no_grad()
    def compare(self, step: Step) -> ComparisonMaps:
        """Compute entropy and distances on the feature grid from the step's render."""
        frozen, mask = self.inputs.semantics, self.config.mask
        features = self.inputs.features
        image = resized(step.rendered.image, *self.data.photos[step.view].shape[:2])
        maps = compare(frozen.phi[step.view], features(image), frozen.psi, features.unit, mask)
        h, w = maps.distance.shape
        alpha = F.adaptive_avg_pool2d(step.rendered.alpha[None, None], (h, w))[0, 0]
        return mask_unlearnt(maps, alpha < mask.least_alpha)

    def _entropy_terms(self, image: Tensor, step: Step, keep: Tensor | None) -> Tensor:
        inputs, config = self.inputs.semantics, self.config
        assert inputs.psi is not None  # cotangent returned before
        logits = inputs.psi(self.inputs.features(resized(image, *self.data.photos[step.view].shape[:2])))
        h, w, channels = logits.shape
        flat = logits.reshape(-1, channels)
        # without weights the capture's own masks still apply
        own = self.data.user_keep[step.view]
        everywhere = _cells(None if own is None else shrink_keep(own, step.downsampling), h, w, image)
        kept = _cells(keep, h, w, image)
        variant = config.mask.variant
        loss = (flat * 0.0).sum()
        if config.lambda_id > 0:
            ids = inputs.identities[step.view].reshape(-1)
            weights = kept if config.weigh_id else everywhere
            loss = loss + config.lambda_id * identity_loss(flat, ids, weights, variant)
        count = self.inputs.counts[step.view]
        if config.lambda_cr > 0 and count:
            weights = kept if config.weigh_cr else everywhere
            member = instance_matrix(inputs.grid[step.view].reshape(-1), count, weights)
            loss = loss + config.lambda_cr * consistency_loss(flat, member, variant)
        return loss

    def panels(self, step: Step) -> dict[str, np.ndarray]:
        photo = (self.data.photos[step.view].cpu().numpy() * 255 + 0.5).astype(np.uint8)
        labels = self.inputs.labels[step.view]
        points = self.points.get(self.data.scene.train[step.view].name)
        return mask_pictures.panels(self.masks, step, photo, labels, points, begun=self.begun(step))

    def predict_with_reasons(self, step: Step) -> tuple[Tensor | None, MaskReasons | None]:
        if not self.begun(step):
            return None, None
        maps, masks = self.masks.examine(step)
        return masks.keep, mask_pictures.reasons(self.masks, step.view, maps, masks)

    def explain(self, step: Step, x: int, y: int) -> list[str]:
        return mask_pictures.explain(self.masks, step, x, y)

    def draw(self, folder: Path) -> list[Path]:
        return mask_pictures.draw_entropies(self.masks, folder)

    def state_dict(self) -> State:
        psi = self.inputs.semantics.psi if self.inputs.has_semantics else None
        return {
            **super().state_dict(),
            **self.masks.state_dict(),
            "visits": {str(view): count for view, count in self.visits.items()},
            # saved, because the last bits of psi's training may differ on another machine
            "psi": None if psi is None else dict(psi.state_dict()),
        }

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        self.masks.load_state_dict(state)
        self.visits = {int(v): int(count) for v, count in state["visits"].items()}
        if state["psi"] is not None and self.inputs.semantics.psi is not None:
            self.inputs.semantics.psi.load_state_dict(state["psi"])


def _cells(keep: Tensor | None, h: int, w: int, like: Tensor) -> Tensor:
    """Return weights [h * w] of cells under a keep map [H, W]: the least value in each cell."""
    if keep is None:
        return torch.ones(h * w, device=like.device)
    return smaller_keep(keep, (h, w), "any masked").reshape(-1)


def _instances(config: RefineSplatConfig) -> Instances:
    return GraphSegments(config.segments) if config.instances == "graph" else make_instances(config.instances)


def build(options: RefineSplatConfig) -> MethodHooks:
    """Return 3DGS with masks, entropy terms and density control of RefineSplat."""
    return MethodHooks(
        mask=RefineSplatMask(options),
        density=EntropyAwareDensity,
        density_config=options.density,
        lambda_dssim=options.lambda_dssim,
        weighting=options.ssim,
        schedule=Schedule(lr_opacity=options.lr_opacity),
        effects=(WildAppearance(WildGaussiansConfig()),) if options.appearance else (),
    )
