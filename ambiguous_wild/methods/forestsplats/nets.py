"""ForestSplats' options and nets: one bends the transient field for a photo, one masks the photo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from skimage.segmentation import slic
from torch import Tensor

from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.dronesplat import label_means
from ambiguous_wild.methods.robustsplat.supervision import resized
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects.learnt import Leaf, Learnt, mlp_leaves
from ambiguous_wild.splat.effects.placing import Unit, conv_leaves, frequencies
from ambiguous_wild.splat.gaussians import Gaussians
from ambiguous_wild.splat.step import Shot, TrainData

OCTAVES, LAYERS, SKIP = 10, 8, 4


@dataclass(frozen=True)
class ForestSplatsConfig:
    """Options; times in nominal iterations (of 30 000)."""

    density: DensityConfig = field(default_factory=DensityConfig)
    points: int = 5000  # transient Gaussians; their number stays
    width: int = 64  # of the bending net; published 256
    side: int = 160  # px, the longer side of the photo that the mask net sees
    segments: int = 30  # superpixels
    filled: float = 0.2  # superpixels with this mean mask are masked as a whole
    area: float = 0.05  # times mean M^2 at the start
    area_final: float = 0.006
    static: float = 0.2  # times the loss of the static picture where it is not masked
    appearance: bool = False  # published: on for photo collections
    lr_mask: float = 1e-3
    lr_bend: float = 8e-4

    def __post_init__(self) -> None:
        limits = {"points": (4, 1e7), "width": (1, 4096), "side": (16, 4096), "segments": (1, 1e5)}
        check_limits(self, "forestsplats", filled=(0, 1), **limits)


class Nets(Learnt):
    """Holds what is learnt beside Gaussians: the bending net and the mask net. Acts on no picture itself."""

    name = "forestsplats"

    def __init__(self, config: ForestSplatsConfig) -> None:
        self.config = config

    def acts(self, hook: str) -> bool:
        return hook == "step"

    def setup(self, data: TrainData) -> None:
        super().setup(data)
        self.unit = Unit(data.scene.points.xyz, data.device)
        self.segments = [self._superpixels(photo).to(data.device) for photo in data.photos]

    def _superpixels(self, photo: Tensor) -> Tensor:
        small = self._small(photo)[0].permute(1, 2, 0).cpu().numpy()
        count = self.config.segments
        labels = slic(small, n_segments=count, compactness=1.0, sigma=3, start_label=0, channel_axis=-1)
        return torch.from_numpy(np.minimum(labels, 2 * count - 1).astype(np.int64))

    def _small(self, photo: Tensor) -> Tensor:
        share = min(self.config.side / max(photo.shape[:2]), 1.0)
        size = [max(round(side * share), 4) for side in photo.shape[:2]]
        return F.interpolate(photo.permute(2, 0, 1)[None], size=size, mode="area")

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        position, w, rate = 4 * (1 + 2 * OCTAVES), self.config.width, self.config.lr_bend
        found: dict[str, Leaf] = {}
        for i in range(LAYERS):
            inputs = position if i == 0 else w + position if i == SKIP + 1 else w
            found |= mlp_leaves(f"bend{i}", (inputs, w), rng, rate)
        for key, leaf in mlp_leaves("moved", (w, 10), rng, rate).items():
            found[key] = replace(leaf, values=0.01 * leaf.values)
        for name, channels in (("stem", (3, 32, 32, 32)), ("near", (32, 64, 128)), ("far", (32, 64, 128))):
            found |= conv_leaves(name, channels, rng, self.config.lr_mask)
        return found | conv_leaves("last", (128, 1), rng, self.config.lr_mask, side=1)

    def change(self, gaussians: Gaussians, leaf: Mapping[str, Tensor], shot: Shot) -> Mapping[str, Tensor]:
        """The transient Gaussians as this photo's."""
        assert shot.view is not None
        time = torch.full_like(gaussians.means[:, :1], shot.view / max(self.photos - 1, 1))
        code = frequencies(torch.cat([self.unit(gaussians.means.detach()), time], dim=1), OCTAVES)
        x = code
        for i in range(LAYERS):
            x = torch.cat([x, code], dim=1) if i == SKIP + 1 else x
            x = F.relu(torch.addmm(leaf[f"bend{i}_bias0"], x, leaf[f"bend{i}_weight0"]))
        moved = torch.addmm(leaf["moved_bias0"], x, leaf["moved_weight0"])
        return {
            "means": gaussians.means + moved[:, :3],
            "quats": F.normalize(gaussians.quats, dim=1) + moved[:, 3:7],
            "log_scales": (gaussians.log_scales.exp() + moved[:, 7:]).clamp(min=1e-6).log(),
        }

    def masked(self, photo: Tensor, leaf: Mapping[str, Tensor]) -> Tensor:
        """M [H, W] in (0, 1), 1 = transient."""

        def conv(x: Tensor, name: str, i: int, stride: int = 1, dilation: int = 1) -> Tensor:
            weight, bias = leaf[f"{name}_weight{i}"], leaf[f"{name}_bias{i}"]
            return F.conv2d(x, weight, bias, stride, dilation * (weight.shape[2] // 2), dilation)

        x = self._small(photo) - 0.5
        for i in range(3):
            x = F.relu(conv(x, "stem", i, stride=2 if i == 0 else 1))
        for i, dilation in enumerate((2, 4)):
            both = conv(x, "near", i, 2) + conv(x, "far", i, 2, dilation)
            x = F.relu(F.group_norm(both, 1))
        small = torch.sigmoid(conv(x, "last", 0))[0, 0]
        return resized(small, *photo.shape[:2])

    def filled(self, mask: Tensor, view: int) -> Tensor:
        """M_f [H, W]: in superpixels whose mean reaches `filled` their largest value, elsewhere M."""
        segments = F.interpolate(self.segments[view][None, None].float(), size=mask.shape)[0, 0].long()
        return fill(mask, segments, 2 * self.config.segments, self.config.filled)


def fill(mask: Tensor, segments: Tensor, count: int, share: float) -> Tensor:
    """The mask [H, W], and the maximum in segments [H, W] whose mean is `share` or more."""
    flat = segments.reshape(-1)
    most = torch.zeros(count, device=mask.device).scatter_reduce(0, flat, mask.reshape(-1), "amax")
    whole = label_means(mask, segments, count) >= share
    return torch.where(whole[segments], most[segments], mask)
