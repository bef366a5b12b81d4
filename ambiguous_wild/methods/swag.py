"""SWAG: a net of a photo's embedding and a Gaussian's position gives its colour, and may switch it off.

Source: abstract and summaries of arXiv 2403.10427; no code was found. UNVERIFIED, hence ours: every size and
rate, the sign of the gate, its regulariser and the threshold of transients. The mechanism is theirs:
hash-encoded positions (as Instant-NGP describes), one embedding a photo, and opacity times a Binary Concrete
gate that learns without labels. Gaussians that the gate switches off in most of the photos that see them are
left out of other views. A test photo's embedding is fitted without gates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ambiguous_wild.core.config import check_limits
from ambiguous_wild.methods.masking_common import hashed_uniform
from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.cpu.compile import kernel, parallel_kernel
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.effects.autograd_effect import (
    AutogradEffect,
    Leaf,
    VisibleGaussians,
    mlp,
    mlp_leaves,
)
from ambiguous_wild.splat.effects.geometry import SceneNormaliser, in_picture, mean_of_visible, with_penalty
from ambiguous_wild.splat.gaussians import SH_C0, Gaussians
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.step import TrainData, ViewContext
from ambiguous_wild.splat.train_config import NOMINAL_ITERATIONS

PARTS = 8  # parallel parts of the positions
PRIMES = (1, 2_654_435_761, 805_459_861)  # as in Instant-NGP
_SECOND, _THIRD = np.uint64(PRIMES[1]), np.uint64(PRIMES[2])
PHOTO = 24
CLOSED, MIN_OPACITY = -20.0, 1e-7  # logit of Gaussians that are left out; least opacity under a gate


@kernel
def _corners(x, y, z, count, entries, keys, weights):
    """Write table entries and trilinear weights of the eight corners around a position in [0, 1]^3."""
    x, y, z = x * count, y * count, z * count
    i, j, k = np.floor(x), np.floor(y), np.floor(z)
    a, b, c = x - i, y - j, z - k
    one = np.uint64(1)
    for corner in range(8):
        up, right, far = corner & 1, corner >> 1 & 1, corner >> 2 & 1
        key = np.uint64(i) + (one if up else np.uint64(0))
        key ^= (np.uint64(j) + (one if right else np.uint64(0))) * _SECOND
        key ^= (np.uint64(k) + (one if far else np.uint64(0))) * _THIRD
        keys[corner] = np.int64(key % np.uint64(entries))
        weight = a if up else np.float32(1.0) - a
        weight *= b if right else np.float32(1.0) - b
        weights[corner] = weight * (c if far else np.float32(1.0) - c)


@parallel_kernel
def look_up(unit, grid, cells, code):
    """Write code [N, 2 L] of positions unit [N, 3] from tables grid [L, T, 2] with cells [L] a side."""
    for part in numba.prange(PARTS):
        keys, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(part * unit.shape[0] // PARTS, (part + 1) * unit.shape[0] // PARTS):
            for level in range(grid.shape[0]):
                _corners(unit[n, 0], unit[n, 1], unit[n, 2], cells[level], grid.shape[1], keys, weights)
                first, second = np.float32(0.0), np.float32(0.0)
                for corner in range(8):
                    first += weights[corner] * grid[level, keys[corner], 0]
                    second += weights[corner] * grid[level, keys[corner], 1]
                code[n, 2 * level], code[n, 2 * level + 1] = first, second


@parallel_kernel
def look_up_backward(unit, cells, d_code, d_grid):
    """Add to d_grid [L, T, 2]; one thread has a whole level, so that sums keep their order."""
    for level in numba.prange(d_grid.shape[0]):
        keys, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(unit.shape[0]):
            _corners(unit[n, 0], unit[n, 1], unit[n, 2], cells[level], d_grid.shape[1], keys, weights)
            first, second = d_code[n, 2 * level], d_code[n, 2 * level + 1]
            for corner in range(8):
                d_grid[level, keys[corner], 0] += weights[corner] * first
                d_grid[level, keys[corner], 1] += weights[corner] * second


def hash_encoding(unit: Tensor, grid: Tensor, coarsest: int, finer: float) -> Tensor:
    """Encode positions [N, 3] in [0, 1] by tables [L, T, 2], trilinear as in Instant-NGP, [N, 2 L].

    Level l has floor(coarsest finer^l) cells a side; a corner's entry is the exclusive or of its integer
    coordinates times `PRIMES`, modulo T. Positions are clamped to [0, 1], and get no gradient.
    """
    unit = unit.detach().to(grid).clamp(0.0, 1.0)
    cells = [float(int(coarsest * finer**level)) for level in range(len(grid))]
    if not backend_of(grid.device).kernels or grid.dtype != torch.float32:
        return hash_encoding_torch(unit, grid, cells)
    code: Tensor = _Encoding.apply(unit, grid, torch.tensor(cells))
    return code


def prepare(device: torch.device) -> None:
    """Compile the kernel if this device needs it, so that it takes no training time."""
    grid = torch.zeros(1, 1, 2, device=device, requires_grad=True)
    with torch.enable_grad():
        torch.autograd.grad(hash_encoding(grid.new_zeros(1, 3), grid, 1, 1.0).sum(), grid)


def hash_encoding_torch(unit: Tensor, grid: Tensor, cells: list[float]) -> Tensor:
    """Do as `hash_encoding` in torch, for accelerators, and to check the kernel."""
    levels, entries, _ = grid.shape
    scaled = torch.stack([unit * count for count in cells])  # [L, N, 3]
    low = scaled.floor()
    share, corner, code = scaled - low, low.long(), torch.zeros_like(scaled[:, :, :2])
    first = (torch.arange(levels, device=grid.device) * entries)[:, None]
    table = grid.reshape(levels * entries, 2)
    for number in range(8):
        weight, key = torch.ones_like(share[:, :, 0]), torch.zeros_like(corner[:, :, 0])
        for axis in range(3):
            up = number >> axis & 1
            weight = weight * (share[:, :, axis] if up else 1.0 - share[:, :, axis])
            key = key ^ ((corner[:, :, axis] + up) * PRIMES[axis])
        code = code + weight[:, :, None] * table[first + key % entries]
    return code.permute(1, 0, 2).reshape(len(unit), 2 * levels)


class _Encoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, unit: Tensor, grid: Tensor, cells: Tensor) -> Tensor:
        unit = unit.contiguous()
        ctx.save_for_backward(unit, cells)
        ctx.size = grid.shape
        code = torch.empty(len(unit), 2 * len(grid))
        look_up(unit.numpy(), grid.detach().contiguous().numpy(), cells.numpy(), code.numpy())
        return code

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_code: Tensor) -> tuple[None, Tensor, None]:
        unit, cells = ctx.saved_tensors
        d_grid = torch.zeros(ctx.size)
        look_up_backward(unit.numpy(), cells.numpy(), d_code[0].contiguous().numpy(), d_grid.numpy())
        return None, d_grid, None


@dataclass(frozen=True)
class SwagConfig:
    """Options, all of them ours; times in nominal iterations (of 30 000)."""

    density: DensityConfig = field(default_factory=DensityConfig)
    levels: int = 8  # levels of the hash grid, with two features each
    entries: int = 2**14  # entries of each level
    coarsest: int = 16  # cells along a side of the first level
    finer: float = 1.5  # ratio of cells from level to level
    width: int = 64  # units of the net's three hidden layers
    temperature: float = 0.1  # temperature of the gate
    gate_start: float = 3000.0
    start_logit: float = -4.0  # logit of being off, at the start
    off: float = 0.01  # weight of the mean gate in the loss
    transient: float = 0.5  # Gaussians that are on in a smaller share of photos are left out
    lr_grid: float = 0.01
    lr_net: float = 1e-3  # this and the next for 30 000 iterations; higher in shorter runs
    lr_photo: float = 0.01

    def __post_init__(self) -> None:
        check_limits(
            self, "swag", levels=(1, 32), entries=(1, 2**24), coarsest=(1, 4096), finer=(1, 4),
            width=(1, 4096), temperature=(1e-3, 10), transient=(0, 1),
        )  # fmt: skip


def build(options: SwagConfig) -> MethodHooks:
    """Return 3DGS with this net."""
    return MethodHooks(effects=(GatedColours(options),), density_config=options.density)


class GatedColours(AutogradEffect):
    """Draws colour + 2 sigmoid(net) - 1, and opacity (1 - z), where z = 1 switches a Gaussian off."""

    name = "swag"

    def __init__(self, config: SwagConfig) -> None:
        self.config = config

    def setup(self, data: TrainData) -> None:
        self.seed, self.unit, self.cameras = (
            data.seed,
            SceneNormaliser(data.scene.points.xyz, data.device),
            data.cameras,
        )
        self._left_out: tuple[float, int, Tensor] | None = None  # result of `_transient`, by time and number
        prepare(data.device)
        super().setup(data)

    def leaves(self, data: TrainData, rng: np.random.Generator) -> Mapping[str, Leaf]:
        c = self.config
        grid = torch.tensor(1e-4 * rng.uniform(-1, 1, (c.levels, c.entries, 2)), dtype=torch.float32)
        photo = torch.tensor(0.1 * rng.normal(size=(len(data.photos), PHOTO)), dtype=torch.float32)
        net = mlp_leaves("net", (2 * c.levels + PHOTO + 3, c.width, c.width, c.width, 4), rng, c.lr_net)
        last = net["net_bias3"].values.clone()
        last[:3], last[3] = 0.0, c.start_logit
        net["net_weight3"] = replace(net["net_weight3"], values=0.1 * net["net_weight3"].values)
        net["net_bias3"] = replace(net["net_bias3"], values=last)
        net = {name: replace(leaf, lr_decay=0.01, made_for=NOMINAL_ITERATIONS) for name, leaf in net.items()}
        codes = Leaf(photo, c.lr_photo, 0.01, per_photo=True, made_for=NOMINAL_ITERATIONS)
        return {"grid": Leaf(grid, c.lr_grid, 0.01), "photo": codes, **net}

    def encoded(self, means: Tensor, leaf: Mapping[str, Tensor]) -> Tensor:
        """Return the codes of positions, [N, 2 levels], without a gradient to the positions."""
        unit = (0.5 + 0.25 * self.unit(means.detach())).clamp(0.0, 1.0)
        return hash_encoding(unit, leaf["grid"], self.config.coarsest, self.config.finer)

    def _net(self, places: Tensor, colours: Tensor, leaf: Mapping[str, Tensor]) -> Tensor:
        photo = leaf["photo"].expand(len(places), PHOTO)
        return mlp(torch.cat([places, photo, colours], dim=1), leaf, "net")

    def forward(self, visible: VisibleGaussians, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        outputs = self._net(self.encoded(visible.means, leaf), visible.base, leaf)
        return visible.base + 2.0 * torch.sigmoid(outputs[:, :3]) - 1.0

    def change(
        self, gaussians: Gaussians, leaf: Mapping[str, Tensor], context: ViewContext
    ) -> Mapping[str, Tensor]:
        logits = gaussians.opacity_logits
        if context.nominal < self.config.gate_start or context.other_gaussians:
            return {}
        if context.view is None:
            return {"opacity_logits": torch.where(self._transient(gaussians, leaf, context), CLOSED, logits)}
        means = gaussians.means.detach()
        seen: Any = backend_of(logits.device).visible_rows(lambda: in_picture(means, context.camera))
        colours = gaussians.sh0[seen] * SH_C0 + 0.5
        a = self._net(self.encoded(gaussians.means[seen], leaf), colours, leaf)[:, 3]
        u = hashed_uniform(len(logits), (self.seed, context.iteration, 0x5A), logits.device)[seen]
        z = torch.sigmoid((a + torch.logit(u)) / self.config.temperature)
        opacity = (torch.sigmoid(logits[seen]) * (1.0 - z)).clamp(MIN_OPACITY, 1.0 - 1e-6)
        opened = logits.clone()
        opened[seen] = torch.logit(opacity)
        gate = mean_of_visible(z, means[seen], context.camera)
        return {"opacity_logits": with_penalty(opened, self.config.off * gate)}

    @torch.no_grad()
    def _transient(self, gaussians: Gaussians, leaf: Mapping[str, Tensor], context: ViewContext) -> Tensor:
        """Return Gaussians that are off, without noise, in most photos that show them, [N] bool."""
        cached = self._left_out
        if cached is None or cached[:2] != (context.nominal, len(gaussians)):
            places, colours = self.encoded(gaussians.means, leaf), gaussians.sh0 * SH_C0 + 0.5
            on, seen = torch.zeros_like(gaussians.opacity_logits), torch.zeros_like(gaussians.opacity_logits)
            for row, camera in zip(self._adam["photo"].values, self.cameras):
                inside = in_picture(gaussians.means, camera, margin=0.0).float()
                a = self._net(places, colours, {**leaf, "photo": row})[:, 3]
                on, seen = on + inside * (a <= 0.0), seen + inside
            cached = (context.nominal, len(gaussians), on < self.config.transient * seen)
            self._left_out = cached
        return cached[2]

    def step(self, own: Mapping[str, Tensor], context: ViewContext, skip_step: Tensor | None = None) -> None:
        self._left_out = None
        super().step(own, context, skip_step)
