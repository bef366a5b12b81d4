"""What the mask policies of several methods share: net, targets, bounds, warm-up, pauses, shares.

Targets and loss of RobustSplat's mask net are pure functions. Maps are [H, W] float32, 1 = static.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ambiguous_wild.core.config import Facts, State
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.effects.autograd_effect import AutogradEffect
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.method_hooks import MaskPolicy
from ambiguous_wild.splat.step import Step, TrainData

_WORD = 1 << 32


def cosine_target(cosine: Tensor) -> Tensor:
    """Return T_cos = 1 - clip(1 - (c - 0.5) / 0.5, 0, 1): 1 where photo and render agree, 0 below 0.5."""
    return 1.0 - (1.0 - (cosine - 0.5) / 0.5).clamp(0.0, 1.0)


def calibrated(cosine: Tensor, unit: float, normal: float) -> Tensor:
    """Stretch a cosine to its whole range: 0 at a distance of `normal` units, -1 from twice that on.

    Cosines of hand-made features stay above 0.99, where the published target is 1 everywhere. The unit is
    the cosine distance that blur and noise alone cause (`Features.unit`).
    """
    return 1.0 - ((1.0 - cosine) / (unit * normal)).clamp(0.0, 2.0)


def relative_target(distance: Tensor, usual: float | Tensor, reach: float) -> Tensor:
    """Return 1 up to the `usual` distance of features, 0 from `reach` times that on, linear between.

    A blurred render has a usual distance everywhere; only a larger one shows a distractor.
    """
    usual = max(usual, 1e-6) if isinstance(usual, float) else usual.clamp(min=1e-6)
    return 1.0 - ((distance / usual - 1.0) / (reach - 1.0)).clamp(0.0, 1.0)


def residual(photo: Tensor, render: Tensor) -> Tensor:
    """Return the mean over channels of |photo - render|, [H, W], of pictures [H, W, 3]; at most 1."""
    return (photo - render).abs().mean(dim=2).clamp(max=1.0)


def update_histogram(histogram: Tensor, values: Tensor, decay: float) -> Tensor:
    """Return decay h + hist(values), for `histogram` [bins] float64 over [0, 1] and values in [0, 1]."""
    bins = len(histogram)
    index = (values.reshape(-1).double() * bins).long().clamp(0, bins - 1)
    return decay * histogram + backend_of(histogram.device).label_sums(index, bins)


def percentile(histogram: Tensor, share: float) -> float | Tensor:
    """Return the smallest bin edge with at least `share` of all counts below it; 1 for an empty histogram.

    On a GPU it is a 0-d tensor, as of `Backend.number`, so that the host does not wait.
    """
    total = histogram.sum()
    # a little below the target for rounding, so that 0.6 of 10 equal counts is six of them
    reached = torch.cumsum(histogram, 0) >= share * total * (1.0 - 1e-12)
    first = reached.int().argmax()  # the first of equal values
    edge = ((first + 1).to(histogram) / len(histogram)).masked_fill(total <= 0, 1.0)
    return backend_of(histogram.device).number(edge)


def inlier_map(e: Tensor, threshold: float | Tensor) -> Tensor:
    """Return 1 where e < threshold for the pixel or for over half of its 3x3 window; outside counts as 0."""
    inlier = (e < threshold).float()
    near = F.avg_pool2d(inlier[None, None], 3, stride=1, padding=1)[0, 0]
    return ((inlier > 0) | (near > 0.5)).float()


def resized(x: Tensor, height: int, width: int) -> Tensor:
    """Resize a map [h, w] or a picture [h, w, 3], bilinear; returns it unchanged if it has that size."""
    if x.shape[:2] == (height, width):
        return x
    maps = x[None] if x.ndim == 2 else x.permute(2, 0, 1)
    large = F.interpolate(maps[None], size=(height, width), mode="bilinear", align_corners=False)[0]
    return large[0] if x.ndim == 2 else large.permute(1, 2, 0)


def nearest(labels: Tensor, height: int, width: int) -> Tensor:
    """Return the labels [height, width] at the centres of the pixels of a smaller picture."""
    if labels.shape == (height, width):
        return labels
    device = labels.device
    rows = ((torch.arange(height, device=device) * 2 + 1) * labels.shape[0]) // (2 * height)
    columns = ((torch.arange(width, device=device) * 2 + 1) * labels.shape[1]) // (2 * width)
    return labels[rows[:, None], columns[None, :]]


def keep_of(mask: Tensor, threshold: float, erosion: int) -> Tensor:
    """Return [M > threshold] with the static region eroded by a min-pool of side `erosion`."""
    kept = (mask > threshold).float()
    return -F.max_pool2d(-kept[None, None], erosion, stride=1, padding=erosion // 2)[0, 0]


class WarmUp(Protocol):
    """Options that say when masks begin."""

    @property
    def mask_start(self) -> float: ...  # nominal iterations
    @property
    def min_mask_start(self) -> int: ...  # iterations of the run; earlier renders show too little


class Pause(WarmUp, Protocol):
    """Options that also say how long masks rest after an opacity reset."""

    @property
    def reset_pause(self) -> float: ...  # nominal iterations
    @property
    def min_reset_pause(self) -> int: ...  # iterations of the run


class WarmUpMask(MaskPolicy):
    """A mask policy that keeps every pixel until the renders show something."""

    config: WarmUp

    def begun(self, step: Step) -> bool:
        """Whether masks are used at this step."""
        return step.nominal >= self.config.mask_start and step.iteration >= self.config.min_mask_start


class PausingMask(WarmUpMask):
    """A mask policy that also pauses after every opacity reset, when renders are too dark."""

    config: Pause
    last_reset = 0  # iteration, 0 = never

    def on_opacity_reset(self, step: Step) -> None:
        self.last_reset = step.iteration

    def paused(self, step: Step) -> bool:
        """Whether the last opacity reset is too recent."""
        if not self.last_reset:
            return False
        pause = max(self.pause_iterations(step), self.config.min_reset_pause)
        return step.iteration - self.last_reset < pause

    def pause_iterations(self, step: Step) -> float:
        """Return `reset_pause` in iterations of the run."""
        return self.config.reset_pause / (step.nominal / step.iteration)

    def state_dict(self) -> State:
        return {**super().state_dict(), "last_reset": self.last_reset}

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        self.last_reset = int(state["last_reset"])


class EffectMask(MaskPolicy):
    """A mask policy that reads an effect, which the run must have."""

    effect: AutogradEffect

    def required_effect(self) -> AutogradEffect:
        return self.effect

    def setup(self, data: TrainData) -> None:
        self.effect.require_setup()


class MaskedShares(dict[int, float | Tensor]):
    """The share of each view's pixels that was masked when it was last seen."""

    def take(self, view: int, keep: Tensor) -> None:
        """Store the masked share of a keep map [H, W]; on an accelerator it is read later."""
        self[view] = backend_of(keep.device).number(1.0 - keep.mean())

    def mean(self) -> float:
        """Return the mean over the views seen so far; 0 before the first."""
        shares = [float(self[view]) for view in sorted(self)]
        return sum(shares) / len(shares) if shares else 0.0

    def state_dict(self) -> dict[str, float]:
        return {str(view): float(share) for view, share in self.items()}

    @classmethod
    def from_state(cls, state: dict[str, float]) -> MaskedShares:
        """Restore what `state_dict` returned."""
        return cls({int(view): float(share) for view, share in state.items()})


class CountingMask(MaskPolicy):
    """A mask policy that reports and saves the share that it masks of each view."""

    shares: MaskedShares

    def facts(self) -> Facts:
        return {"masked_share": self.shares.mean()}

    def state_dict(self) -> State:
        return {**super().state_dict(), "shares": self.shares.state_dict()}

    def load_state_dict(self, state: State) -> None:
        super().load_state_dict(state)
        self.shares = MaskedShares.from_state(state["shares"])


def d_keep(render: Tensor, photo: Tensor, keep: Tensor) -> Tensor:
    """Return dL/dkeep [H, W] of 0.8 |k R - k I| + 0.2 D-SSIM(k R, k I), for nets that learn masks by it.

    Both pictures depend on k; the loss is symmetric in them, so each call gives the share of one of them.
    """
    one, other = keep[..., None] * render, keep[..., None] * photo
    mine, theirs = photometric(one, other).d_image, photometric(other, one).d_image
    return (mine * render + theirs * photo).sum(dim=2)


def hashed_uniform(count: int, key: tuple[int, ...], device: torch.device) -> Tensor:
    """Return [count] float32 in (0, 1) that depend on `key` alone: the same on every device.

    A generator would have a state to save, and its numbers would come from the host. Mixing: the finaliser
    of MurmurHash3 (public domain), once for each number of the key.
    """
    x = torch.arange(count, device=device, dtype=torch.int64)
    for number in key:
        x = (x + (number % _WORD) * 0x9E3779B1 % _WORD) % _WORD
        x = ((x ^ (x >> 16)) * 0x85EBCA6B) & (_WORD - 1)
        x = ((x ^ (x >> 13)) * 0xC2B2AE35) & (_WORD - 1)
        x = x ^ (x >> 16)
    return ((x >> 8).to(torch.float32) + 0.5).mul(2.0**-24).clamp(max=1.0 - 2.0**-24)


def sampled(keep: Tensor, probability: float, key: tuple[int, ...]) -> Tensor:
    """Draw [H, W] of 0 and 1 with probability p + (1 - p) keep: always 1 where keep is 1.

    Args:
        keep: [H, W] in [0, 1].
        probability: probability that a masked pixel is kept nevertheless.
        key: numbers that decide the draw, e.g. seed and iteration.
    """
    chance = probability + (1.0 - probability) * keep
    return (hashed_uniform(keep.numel(), key, keep.device).reshape(keep.shape) < chance).float()


def annealed(step: Step, rate: float) -> float:
    """Return exp(-rate floor((1 + s) / 1.5)), with s the smaller of real and nominal iterations.

    Source: SpotLessSplats and T-3DGS. A short run's renders are no better for its nominal count.
    """
    s = min(float(step.iteration), step.nominal)
    return math.exp(-rate * math.floor((1.0 + s) / 1.5))


def init_uniform(layers: Sequence[tuple[nn.Module, float]], seed: int) -> None:
    """Draw weights and biases of each layer from -limit to limit, with numbers from the host.

    They are the same on every device.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for layer, limit in layers:
            for values in layer.parameters():
                values.copy_((2.0 * torch.rand(values.shape, generator=generator) - 1.0) * limit)


class MaskNet(nn.Module):
    """A net for each pixel, Linear - ReLU - Linear - sigmoid: features [h, w, C] to a static map [H, W].

    Features are standardised first.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, mean: Tensor, std: Tensor, hidden: int, seed: int) -> None:
        """
        Args:
            mean, std: [C], which standardise features; zeros and ones change nothing.
            hidden: width of the hidden layer.
            seed: seed of the weights, which are initialised as by `nn.Linear`.
        """
        super().__init__()
        self.register_buffer("mean", mean.clone())
        self.register_buffer("std", std.clone())
        self.first = nn.Linear(len(mean), hidden, device=mean.device)
        self.last = nn.Linear(hidden, 1, device=mean.device)
        init_uniform([(layer, layer.in_features**-0.5) for layer in (self.first, self.last)], seed)

    def forward(self, features: Tensor, height: int, width: int) -> Tensor:
        """Return the map [height, width].

        The first layer runs on the grid, and its output is enlarged. As bilinear weights sum to one, this
        equals enlarging all C channels first, at hidden / C of the work.
        """
        z = self.first((features - self.mean) / self.std)
        if z.shape[:2] != (height, width):
            z = upsampled(z, height, width)
        return torch.sigmoid(self.last(F.relu(z)).squeeze(2))


def upsampled(z: Tensor, height: int, width: int) -> Tensor:
    """Enlarge [h, w, C] to [height, width, C], bilinear, with pixel centres in place (not align_corners).

    Two products with small matrices: with many channels on the CPU a third of the cost of `F.interpolate`
    and its backward pass, equal up to rounding.
    """
    h, w, channels = z.shape
    rows = _weights(h, height, z.dtype, z.device)
    columns = _weights(w, width, z.dtype, z.device)
    return columns @ (rows @ z.reshape(h, w * channels)).reshape(height, w, channels)


@cache
def _weights(size: int, to: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weight of each value in each enlarged one, [to, size]; rows sum to one. Copied once."""
    at = ((torch.arange(to, dtype=torch.float64) + 0.5) * (size / to) - 0.5).clamp(min=0.0)
    low = at.floor().long().clamp(max=size - 1)
    high = (low + 1).clamp(max=size - 1)
    share, number = at - low, torch.arange(to)
    weights = torch.zeros(to, size, dtype=torch.float64)
    weights[number, low] += 1.0 - share
    weights[number, high] += share
    return weights.float().to(device, dtype)


def adam_of(net: nn.Module, lr: float, device: torch.device) -> torch.optim.Adam:
    """Return Adam for the net's parameters, see `Backend.adam`."""
    return backend_of(device).adam(net.parameters(), lr)


def learner_state(net: nn.Module, optimiser: torch.optim.Adam) -> State:
    """Return the state of a net and its Adam for a checkpoint."""
    values = {name.replace(".", "_"): value for name, value in net.state_dict().items()}
    return {"net": values, "adam": adam_state(optimiser)}


def load_learner(net: nn.Module, optimiser: torch.optim.Adam, state: State) -> None:
    """Restore what `learner_state` returned."""
    net.load_state_dict({name: state["net"][name.replace(".", "_")] for name in net.state_dict()})
    load_adam_state(optimiser, state["adam"])


def adam_state(optimiser: torch.optim.Adam) -> list[State]:
    """Return moments and step count of every parameter, in order; empty before the first step."""
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    return [dict(optimiser.state[p]) for p in parameters if p in optimiser.state]


def load_adam_state(optimiser: torch.optim.Adam, rows: list[State]) -> None:
    """Restore what `adam_state` returned."""
    optimiser.state.clear()  # a state saved before the first step is empty
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    fused = bool(optimiser.defaults["fused"])
    for parameter, row in zip(parameters, rows):
        # Adam keeps the count of steps on the CPU, the fused one on the parameter's device
        optimiser.state[parameter] = {
            k: v.clone() if k == "step" and not fused else v.clone().to(parameter) for k, v in row.items()
        }
