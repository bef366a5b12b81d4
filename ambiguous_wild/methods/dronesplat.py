"""DroneSplat: masks whole instances whose residual is high for their photo.

Source: "DroneSplat: 3D Gaussian Splatting for Robust 3D Reconstruction from In-the-Wild Drone Imagery",
CVPR 2025 (arXiv 2503.16964) and its released code; this is its local masking. Left out: the global step
(tracking of high-residual objects through the sequence; no constants in the paper, no code), the dense
initialisation and the voxel-guided optimisation. The released code takes instances from SAM 2
(`instances=sam2-large`); without weights they are graph segments, smaller than objects.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import Facts
from ambiguous_wild.io.palette import MASKED, faded, ramp, tint
from ambiguous_wild.methods.masking_common import CountingMask, MaskedShares, WarmUpMask, nearest
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.losses import ssim_map
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.step import Step, TrainData
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS
from ambiguous_wild.vision.backends import check_instances, make_instances
from ambiguous_wild.vision.precompute import instance_labels


@dataclass(frozen=True)
class DroneSplatConfig:
    """Times in nominal iterations (of 30 000); the `min_` fields are real iterations of the run."""

    instances: str = "graph"  # see vision/backends.py; published: sam2-large
    density: DensityConfig = field(default_factory=DensityConfig)
    lambda_dssim: float = 0.2
    mask_start: float = 500.0
    min_mask_start: int = 300  # earlier renders show too little
    t_local: float = 0.4  # standard deviations added to the threshold at the start; it falls to 0 at the end
    weight_l1: float = 4.0  # weight of L1 in the residual, where 1 - SSIM has weight 1

    def __post_init__(self) -> None:
        check_instances(self.instances)
        if self.weight_l1 < 0:
            raise AwError(f"dronesplat.weight_l1 cannot be negative, got {self.weight_l1}")


def build(options: DroneSplatConfig) -> MethodHooks:
    """Return 3DGS with local masks."""
    return MethodHooks(
        mask=DroneSplatMask(options), density_config=options.density, lambda_dssim=options.lambda_dssim
    )


def combined_residual(
    render: Tensor,  # [H, W, 3]
    photo: Tensor,  # [H, W, 3] in [0, 1]
    weight_l1: float,
) -> Tensor:
    """Return E = (w a + s) / (w + 1) [H, W] of mean |render - photo| and 1 - SSIM, each scaled to [0, 1]."""
    a = (render - photo).abs().mean(dim=2)
    s = (1.0 - ssim_map(render, photo)).mean(dim=2)
    return (weight_l1 * unit_range(a) + unit_range(s)) / (weight_l1 + 1.0)


def unit_range(values: Tensor) -> Tensor:
    """Scale values to [0, 1] by their minimum and maximum; zeros if all are equal."""
    low, high = values.min(), values.max()
    # 0 / 1 if all are equal: a test on the host would make it wait for the accelerator
    return (values - low) / (high - low).masked_fill(high <= low, 1.0)


def heat_map(
    residual: Tensor,  # [H, W]
    labels: Tensor,  # [H, W] int64, 0 = unlabelled
    count: int | None = None,  # above every label; None: read from the labels, so that the host waits
) -> Tensor:
    """Return the mean residual of each pixel's instance, scaled to [0, 1], 0 if unlabelled; [H, W]."""
    count = int(labels.max()) + 1 if count is None else count
    means = label_means(residual, labels, count)
    means[0] = 0.0
    return unit_range(means[labels])


def label_means(values: Tensor, labels: Tensor, count: int) -> Tensor:
    """Return the mean of `values` [H, W] over the pixels of each label, [count] float64; 0 for no pixels."""
    flat, weights = labels.reshape(-1), values.reshape(-1).double()
    backend = backend_of(flat.device)
    return backend.label_sums(flat, count, weights) / backend.label_sums(flat, count).clamp(min=1)


def threshold(heat: Tensor, nominal: float, t_local: float) -> Tensor:
    """Return T(it) = mu + sd + t_local sd (N - it) / N over the photo's pixels, a 0-d tensor."""
    left = max(NOMINAL_ITERATIONS - nominal, 0.0) / NOMINAL_ITERATIONS
    return heat.mean() + heat.std(correction=0) * (1.0 + t_local * left)


class DroneSplatMask(CountingMask, WarmUpMask):
    """Masks instances by statistics of the current render; nothing is learnt."""

    config: DroneSplatConfig

    def __init__(self, config: DroneSplatConfig) -> None:
        self.config = config
        self.instances = make_instances(config.instances)
        self.shares = MaskedShares()

    def setup(self, data: TrainData) -> None:
        names = [view.name for view in data.scene.train]
        by_photo = instance_labels(self.instances, data.photos, names, data.cache_dir).labels
        labels = [np.maximum(label, 0).astype(np.int64) for label in by_photo]
        self.counts = [int(label.max()) + 1 for label in labels]  # labels 0..K
        self.labels = [torch.from_numpy(label).to(data.device) for label in labels]

    def keep(self, step: Step) -> Tensor | None:
        keep = self.predict(step)
        if keep is not None:
            self.shares.take(step.view, keep)
        return keep

    @torch.no_grad()
    def predict(self, step: Step) -> Tensor | None:
        return (~self._stands_out(step)[1]).float() if self.begun(step) else None

    def _stands_out(self, step: Step) -> tuple[Tensor, Tensor]:
        """Return the heat map, and which pixels are above its threshold."""
        labels = nearest(self.labels[step.view], *step.photo.shape[:2])
        residual = combined_residual(step.rendered.image, step.photo, self.config.weight_l1)
        heat = heat_map(residual, labels, self.counts[step.view])
        # a photo of equal heat everywhere has T = 0, which would mask all of it
        return heat, (heat >= threshold(heat, step.nominal, self.config.t_local)) & (heat > 0)

    @torch.no_grad()
    def panels(self, step: Step) -> dict[str, np.ndarray]:
        heat, out = self._stands_out(step)
        photo = faded((step.photo.cpu().numpy() * 255 + 0.5).astype(np.uint8))
        used = "" if self.begun(step) else ", not used yet"
        limit = float(threshold(heat, step.nominal, self.config.t_local))
        return {
            f"heat of instances, T {limit:.2f}": ramp(heat.cpu().numpy(), 0.0, 1.0),
            f"masked {100 * float(out.float().mean()):.0f} %{used}": tint(photo, out.cpu().numpy(), MASKED),
        }

    def facts(self) -> Facts:
        return super().facts() | {
            "instances": self.instances.name,
            "instances_per_photo": float(np.mean([count - 1 for count in self.counts])),
        }
