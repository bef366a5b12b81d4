"""The hash encoding of positions that Instant-NGP describes, for effects that learn one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ambiguous_wild.splat.backend import backend_of

PRIMES = (1, 2_654_435_761, 805_459_861)  # Instant-NGP's


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
        from ambiguous_wild.splat.cpu.hash_grid import look_up

        unit = unit.contiguous()
        ctx.save_for_backward(unit, cells)
        ctx.size = grid.shape
        found = torch.empty(len(unit), 2 * len(grid))
        look_up(unit.numpy(), grid.detach().contiguous().numpy(), cells.numpy(), found.numpy())
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *d_found: Tensor) -> tuple[None, Tensor, None]:
        from ambiguous_wild.splat.cpu.hash_grid import give_back

        unit, cells = ctx.saved_tensors
        d_grid = torch.zeros(ctx.size)
        give_back(unit.numpy(), cells.numpy(), d_found[0].contiguous().numpy(), d_grid.numpy())
        return None, d_grid, None
