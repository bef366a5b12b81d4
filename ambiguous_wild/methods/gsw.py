"""GS-W (Gaussian in the Wild): a net colours each Gaussian from its features and samples of maps of the
photo.

Source: EastbeanZhang/Gaussian-Wild. Ours: a small U-Net without ImageNet's weights makes the maps, from the
photo at `side` px (published: ResNet-18 at full size); no LPIPS term (it needs VGG's weights); 0.5 is added
to colours, because the renderer clamps at 0; positions are in units of the scene, without a gradient of the
net (that of the release is unverified); boxes start at the photo's size (published: 512 px); the net's output
is added to the colour in the first three intrinsic features (`residual`: 24.3 instead of 22.9 dB after 700
iterations where the time of day changes, because the net need not learn every colour).

Of a test photo the net gets only the left half (released: all of it); a camera without a photo gets the mean
of the train photos' maps. Gaussians outside of the part that may be read get the mean of their samples in at
most 64 train photos that show them, as in training: zeros instead cost 3.8 dB on a courtyard.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ambiguous_wild.core import Camera
from ambiguous_wild.core.config import State, check_limits
from ambiguous_wild.methods.masking_common import EffectMask, d_keep, hashed_uniform
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects.autograd_effect import (
    AutogradEffect,
    Leaf,
    VisibleGaussians,
    mlp,
    mlp_leaves,
)
from ambiguous_wild.splat.effects.geometry import (
    SceneNormaliser,
    conv_leaves,
    directions,
    frequencies,
    mean_of_visible,
    projected,
    with_penalty,
)
from ambiguous_wild.splat.field import GaussianAttribute
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks, Schedule
from ambiguous_wild.splat.rendered import Cotangents
from ambiguous_wild.splat.step import Step, TrainData, ViewContext

CHANNELS, FREE = 16, 2  # channels of a map; number of maps that are sampled at learnt places
DYNAMIC = (FREE + 1) * CHANNELS
INTRINSIC, OCTAVES = 48, 10  # intrinsic features of a Gaussian; octaves of the code of positions
LENGTH = 70_000  # iterations of the release's commands
MAX_AVERAGED = 64  # number of train photos whose maps are averaged for a camera without a photo


def unet_leaves(width: int, rng: np.random.Generator, rate: float) -> dict[str, Leaf]:
    """Return an encoder of three levels, a decoder of two, and the head for masks on the encoder."""
    w = width
    widths = {
        "down": (3, w, 2 * w, 4 * w),
        "up": (6 * w, 2 * w),
        "top": (3 * w, DYNAMIC),
        "mask": (4 * w, w, 1),
    }
    return {k: v for n, c in widths.items() for k, v in conv_leaves(n, c, rng, rate, final=0.1).items()}


def encode_photo(photo: Tensor, leaf: Mapping[str, Tensor], side: int) -> list[Tensor]:
    """Return the photo at `side` and the three levels of the encoder, [1, C, h, w] each."""
    share = min(side / max(photo.shape[:2]), 1.0)
    size = [max(8 * round(side * share / 8), 8) for side in photo.shape[:2]]
    levels = [F.interpolate(photo.permute(2, 0, 1)[None], size=size, mode="area") - 0.5]
    for i in range(3):
        levels.append(_normal(_conv(levels[-1], leaf, "down", i, stride=2)))
    return levels


def feature_maps(photo: Tensor, leaf: Mapping[str, Tensor], side: int) -> Tensor:
    """Return maps [3, 16, h, w]: two to sample at learnt places, one at the Gaussian's pixel."""
    _, fine, middle, coarse = encode_photo(photo, leaf, side)
    x = torch.cat([F.interpolate(coarse, size=middle.shape[2:]), middle], dim=1)
    x = _normal(_conv(x, leaf, "up"))
    x = torch.cat([F.interpolate(x, size=fine.shape[2:]), fine], dim=1)
    return _conv(x, leaf, "top").reshape(FREE + 1, CHANNELS, *fine.shape[2:])


def visibility_map(photo: Tensor, leaf: Mapping[str, Tensor], side: int) -> Tensor:
    """Return M [H, W] in (0, 1), 1 = static, from the encoder's last level."""
    x = F.interpolate(_normal(_conv(encode_photo(photo, leaf, side)[3], leaf, "mask")), scale_factor=2.0)
    x = torch.sigmoid(_conv(x, leaf, "mask", 1))
    return F.interpolate(x, size=photo.shape[:2])[0, 0]


def _conv(x: Tensor, leaf: Mapping[str, Tensor], name: str, i: int = 0, stride: int = 1) -> Tensor:
    return F.conv2d(x, leaf[f"{name}_weight{i}"], leaf[f"{name}_bias{i}"], stride=stride, padding=1)


def _normal(x: Tensor) -> Tensor:
    return F.relu(F.group_norm(x, 1))


def sample(maps: Tensor, at: Tensor) -> Tensor:
    """Sample a map [C, h, w] at (x, y) [M, 2] in [-1, 1]^2, bilinear, with border values outside, [M, C]."""
    samples = F.grid_sample(maps[None], at[None, None], padding_mode="border", align_corners=False)
    return samples[0, :, 0].T


@dataclass(frozen=True)
class GswConfig:
    """Options; times in nominal iterations (of 30 000)."""

    density: DensityConfig = field(default_factory=lambda: DensityConfig(grow_grad=4e-4))
    side: int = 128  # px, the longer side of the photo that the U-Net sees
    width: int = 16  # channels of its first level
    lr_unet: float = 2e-3  # decays to a tenth
    lr_colour: float = 5e-4  # for 70 000 iterations; higher in shorter runs
    lr_places: float = 1.0  # rate of free coordinates, and of boxes in px; decays to a hundredth
    residual: bool = True  # the net's output is added to the intrinsic colour; published: it is the colour
    lr_intrinsic: float = 2.5e-3  # as 3DGS's colours; published 1.25e-4, for 70 000 iterations
    dropout: float = 0.1  # share of samples
    mask_start: float = 2500.0
    mask_prior: float = 0.15  # weight of mean (1 - M)^2
    outside: float = 1e-3  # weight of the mean distance of coordinates from [-1, 1]

    def __post_init__(self) -> None:
        check_limits(self, "gs-w", side=(16, 4096), width=(1, 512), dropout=(0, 0.9))


def build(options: GswConfig) -> MethodHooks:
    """Return 3DGS with such colours, masks of the same U-Net, and a higher threshold of growth."""
    effect = GswAppearance(options)
    return MethodHooks(
        mask=VisibilityMask(effect), density_config=options.density, weighting="images",
        schedule=Schedule(lr_means_final=1.6e-7), effects=(effect,),
    )  # fmt: skip


class GswAppearance(AutogradEffect):
    """Colours Gaussians by net(position, intrinsic feature, samples of three maps, direction)."""

    name, reads_photo = "gs-w", True

    def __init__(self, config: GswConfig) -> None:
        self.config = config

    def setup(self, data: TrainData) -> None:
        self.seed, self.points, self.all_photos = data.seed, data.sfm_points, data.photos
        self.unit = SceneNormaliser(data.scene.points.xyz, data.device)
        self.cameras, count = data.cameras, len(data.photos)
        self.chosen = sorted({k * count // min(count, MAX_AVERAGED) for k in range(min(count, MAX_AVERAGED))})
        self._cached: tuple[float, list[Tensor]] | None = None  # nominal iteration, and maps of those photos
        super().setup(data)

    def acts(self, hook: str) -> bool:
        return hook != "fit" and super().acts(hook)  # a test photo is read; nothing is fitted to it

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        lr, position = self.config.lr_colour, 3 * (1 + 2 * OCTAVES)
        nets = mlp_leaves("encoder", (position + DYNAMIC + INTRINSIC, 128, 96, 64, 48), rng, lr)
        nets |= mlp_leaves("decoder", (48 + INTRINSIC, 48, 48, 48), rng, lr)
        nets |= mlp_leaves("head", (48 + 3, 48, 3), rng, lr)
        nets = {name: replace(leaf, made_for=LENGTH) for name, leaf in nets.items()}
        return unet_leaves(self.config.width, rng, self.config.lr_unet) | nets

    def rows(self, gaussians: Gaussians) -> Mapping[str, GaussianAttribute]:
        rng, means, rate = np.random.default_rng([self.seed, 0x65]), gaussians.means, self.config.lr_places
        low, high = self.points.amin(dim=0), self.points.amax(dim=0)  # a skybox would shrink the scene
        unit = (2.0 * (means - low) / (high - low).clamp(min=1e-9) - 1.0).clamp(-1.0, 1.0)
        weights = rng.uniform(size=(FREE * 2, 3))
        weights /= weights.sum(axis=1, keepdims=True)
        mixing = torch.tensor(weights, dtype=torch.float32).to(means.device)
        intrinsic = torch.cat([gaussians.sh0, torch.zeros_like(gaussians.sh0).repeat(1, 15)], dim=1)
        box = rate / max(self.all_photos[0].shape[:2])
        return {
            "gsw_intrinsic": GaussianAttribute(intrinsic.contiguous(), self.config.lr_intrinsic),
            "gsw_places": GaussianAttribute((unit @ mixing.T).contiguous(), rate, rate / 100),
            "gsw_box": GaussianAttribute(torch.ones(len(means), 2, device=means.device), box, box / 100),
        }

    def forward(self, visible: VisibleGaussians, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        photo, means = self._seen(context), visible.means.detach()
        intrinsic = visible.attributes["gsw_intrinsic"]
        maps = (
            self._mean_maps(context, leaf) if photo is None else feature_maps(photo, leaf, self.config.side)
        )
        places, box = visible.attributes["gsw_places"], visible.attributes["gsw_box"]
        free = [sample(maps[k], places[:, 2 * k : 2 * k + 2]) for k in range(FREE)]
        width = context.camera.width // 2 if context.fitting else context.camera.width  # of the picture read
        own, inside = sample_at_projections(maps[FREE], means, context.camera, width, box)
        if context.fitting or photo is None:
            usual = self._usual(context, leaf, means, box)
            own = usual if photo is None else torch.where(inside[:, None], own, usual)
        else:
            own = own * inside[:, None]
        dynamic = torch.cat([*free, own], dim=1)
        if context.view is not None and self.config.dropout:
            key = (self.seed, context.iteration)
            kept = hashed_uniform(dynamic.numel(), key, dynamic.device) >= self.config.dropout
            dynamic = dynamic * kept.reshape(dynamic.shape) / (1.0 - self.config.dropout)
        code = frequencies(self.unit(means), OCTAVES)
        hidden = mlp(torch.cat([code, dynamic, intrinsic], dim=1), leaf, "encoder")
        hidden = mlp(torch.cat([hidden, intrinsic], dim=1), leaf, "decoder")
        colours = 0.5 + mlp(torch.cat([hidden, directions(means, context.camera)], dim=1), leaf, "head")
        if self.config.residual:
            colours = colours + SH_C0 * intrinsic[:, :3]
        beyond = mean_of_visible(F.relu(places.abs() - 1.0), means, context.camera)
        return with_penalty(colours, self.config.outside * beyond)

    def _seen(self, context: ViewContext) -> Tensor | None:
        """Return the input of the U-Net: the photo, or the left half of a test photo."""
        if context.photo is None or context.neutral:
            return None
        return context.photo[:, : context.photo.shape[1] // 2] if context.fitting else context.photo

    @torch.no_grad()
    def _maps(self, context: ViewContext, leaf: Mapping[str, Tensor]) -> list[Tensor]:
        """Return maps of at most `MAX_AVERAGED` train photos, evenly chosen; computed once an iteration."""
        if self._cached is None or self._cached[0] != context.nominal:
            maps = [feature_maps(self.all_photos[k], leaf, self.config.side) for k in self.chosen]
            self._cached = context.nominal, maps
        return self._cached[1]

    @torch.no_grad()
    def _mean_maps(self, context: ViewContext, leaf: Mapping[str, Tensor]) -> Tensor:
        """Return the mean of `_maps`, at the size of the first."""
        maps = self._maps(context, leaf)
        size = maps[0].shape[2:]
        return torch.stack([F.interpolate(m, size=size, mode="bilinear") for m in maps]).mean(dim=0)

    @torch.no_grad()
    def _usual(self, context: ViewContext, leaf: Mapping[str, Tensor], means: Tensor, box: Tensor) -> Tensor:
        """Return the mean sample of each Gaussian in the train photos that show it, [M, 16]."""
        total, count = means.new_zeros(len(means), CHANNELS), means.new_zeros(len(means), 1)
        for k, maps in zip(self.chosen, self._maps(context, leaf)):
            own, inside = sample_at_projections(
                maps[FREE], means, self.cameras[k], self.cameras[k].width, box
            )
            total, count = total + own * inside[:, None], count + inside[:, None].float()
        return total / count.clamp(min=1.0)

    def step(self, own: Mapping[str, Tensor], context: ViewContext, skip_step: Tensor | None = None) -> None:
        self._cached = None
        super().step(own, context, skip_step)

    def load_state_dict(self, state: State) -> None:
        self._cached = None
        super().load_state_dict(state)

    def learnable(self, context: ViewContext) -> dict[str, Tensor]:
        """Return copies of all leaves that can be differentiated."""
        return {name: value.requires_grad_() for name, value in self._leaf(context).items()}


def sample_at_projections(
    maps: Tensor, means: Tensor, camera: Camera, width: int, box: Tensor
) -> tuple[Tensor, Tensor]:
    """Sample a map [16, h, w] at the pixels of Gaussians in a camera.

    Args:
        maps: map of the camera's photo, or of its left part.
        means: [M, 3] in the world.
        width: width in px of the part of the photo that the map covers.
        box: [M, 2] share of width and height that counts as the whole for a Gaussian.

    Returns:
        Samples [M, 16], and whether the pixel is inside, [M] bool.
    """
    pixels, z = projected(means, camera)
    at = torch.stack([pixels[:, 0] / width, pixels[:, 1] / camera.height], dim=1) / box
    inside = (z > 0) & (at > 0).all(dim=1) & (at < 1).all(dim=1)
    return sample(maps, 2.0 * at - 1.0), inside


class VisibilityMask(EffectMask):
    """Masks by M, which learns from the weighted residual and the prior that nothing is masked."""

    effect: GswAppearance
    learns_by_gradients = True

    def __init__(self, effect: GswAppearance) -> None:
        self.effect, self.config = effect, effect.config

    def keep(self, step: Step) -> Tensor | None:
        return self.predict(step) if step.nominal > self.config.mask_start else None

    @torch.no_grad()
    def predict(self, step: Step) -> Tensor:
        return visibility_map(step.photo, self.effect._leaf(step), self.config.side)

    def cotangent(self, step: Step, keep: Tensor | None) -> Cotangents | None:
        if keep is None or step.nominal <= self.config.mask_start:
            return None
        with torch.enable_grad():
            leaf = self.effect.learnable(step)
            mask = visibility_map(step.photo, leaf, self.config.side)
            d_leaves = torch.autograd.grad(
                mask, list(leaf.values()), self.d_mask(step, mask.detach()), allow_unused=True
            )
        own = {name: d for name, d in zip(leaf, d_leaves) if d is not None}
        return Cotangents(effect_grads={self.effect.name: own})

    def d_mask(self, step: Step, mask: Tensor) -> Tensor:
        """Return dL/dM [H, W] of 0.8 |M R - M I| + 0.2 D-SSIM(M R, M I) + prior mean (1 - M)^2."""
        through = d_keep(step.rendered.image.detach(), step.photo, mask)
        return through - 2.0 * self.config.mask_prior / mask.numel() * (1.0 - mask)
