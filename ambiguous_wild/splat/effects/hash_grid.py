"""The hash encoding of positions that Instant-NGP describes, for effects that learn one."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ambiguous_wild.splat.backend import backend_of
from ambiguous_wild.splat.cpu.compile import kernel, parallel_kernel

PARTS = 8  # that the positions are cut into
PRIMES = (1, 2_654_435_761, 805_459_861)  # Instant-NGP's
_SECOND, _THIRD = np.uint64(PRIMES[1]), np.uint64(PRIMES[2])


@kernel
def _corners(x, y, z, count, entries, keys, weights):
    """Entries and trilinear weights of the eight corners around a position in [0, 1]^3."""
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
def look_up(unit, grid, cells, found):
    """found[n, 2 l + f] of positions unit [N, 3] from tables grid [L, T, 2] with cells [L] a side."""
    for part in numba.prange(PARTS):
        keys, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(part * unit.shape[0] // PARTS, (part + 1) * unit.shape[0] // PARTS):
            for level in range(grid.shape[0]):
                _corners(unit[n, 0], unit[n, 1], unit[n, 2], cells[level], grid.shape[1], keys, weights)
                first, second = np.float32(0.0), np.float32(0.0)
                for corner in range(8):
                    first += weights[corner] * grid[level, keys[corner], 0]
                    second += weights[corner] * grid[level, keys[corner], 1]
                found[n, 2 * level], found[n, 2 * level + 1] = first, second


@parallel_kernel
def look_up_backward(unit, cells, d_found, d_grid):
    """Adds to d_grid [L, T, 2]; a level is one thread's, so that sums keep their order."""
    for level in numba.prange(d_grid.shape[0]):
        keys, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(unit.shape[0]):
            _corners(unit[n, 0], unit[n, 1], unit[n, 2], cells[level], d_grid.shape[1], keys, weights)
            first, second = d_found[n, 2 * level], d_found[n, 2 * level + 1]
            for corner in range(8):
                d_grid[level, keys[corner], 0] += weights[corner] * first
                d_grid[level, keys[corner], 1] += weights[corner] * second


def hash_encoding(unit: Tensor, grid: Tensor, coarsest: int, finer: float) -> Tensor:
    """[N, 2 L] of positions [N, 3] in [0, 1] from tables [L, T, 2]: trilinear, as Instant-NGP's.

    Level l has floor(coarsest finer^l) cells a side; a corner's entry is the exclusive or of its integer
    coordinates times `PRIMES`, modulo T. Positions outside of [0, 1] count as its ends, and learn nothing.
    """
    unit = unit.detach().to(grid).clamp(0.0, 1.0)
    cells = [float(int(coarsest * finer**level)) for level in range(len(grid))]
    if not backend_of(grid.device).kernels or grid.dtype != torch.float32:
        return in_torch(unit, grid, cells)
    found: Tensor = _Encoding.apply(unit, grid, torch.tensor(cells))
    return found


def prepare(place: torch.device) -> None:
    """Compile the kernel if it is needed there and was not yet, so that no training time goes into it."""
    grid = torch.zeros(1, 1, 2, device=place, requires_grad=True)
    with torch.enable_grad():
        torch.autograd.grad(hash_encoding(grid.new_zeros(1, 3), grid, 1, 1.0).sum(), grid)


def in_torch(unit: Tensor, grid: Tensor, cells: list[float]) -> Tensor:
    """The same in torch, for accelerators, and to check the kernel by."""
    levels, entries, _ = grid.shape
    scaled = torch.stack([unit * count for count in cells])  # [L, N, 3]
    low = scaled.floor()
    share, corner, found = scaled - low, low.long(), torch.zeros_like(scaled[:, :, :2])
    first = (torch.arange(levels, device=grid.device) * entries)[:, None]
    table = grid.reshape(levels * entries, 2)
    for number in range(8):
        weight, key = torch.ones_like(share[:, :, 0]), torch.zeros_like(corner[:, :, 0])
        for axis in range(3):
            up = number >> axis & 1
            weight = weight * (share[:, :, axis] if up else 1.0 - share[:, :, axis])
            key = key ^ ((corner[:, :, axis] + up) * PRIMES[axis])
        found = found + weight[:, :, None] * table[first + key % entries]
    return found.permute(1, 0, 2).reshape(len(unit), 2 * levels)


class _Encoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, unit: Tensor, grid: Tensor, cells: Tensor) -> Tensor:
        unit = unit.contiguous()
        ctx.save_for_backward(unit, cells)
        ctx.size = grid.shape
        found = torch.empty(len(unit), 2 * len(grid))
        look_up(unit.numpy(), grid.detach().contiguous().numpy(), cells.numpy(), found.numpy())
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_found: Tensor) -> tuple[None, Tensor, None]:
        unit, cells = ctx.saved_tensors
        d_grid = torch.zeros(ctx.size)
        look_up_backward(unit.numpy(), cells.numpy(), d_found[0].contiguous().numpy(), d_grid.numpy())
        return None, d_grid, None
