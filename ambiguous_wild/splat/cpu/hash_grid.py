"""A hash grid of Instant-NGP: entries of its tables at positions, and the way back."""

from __future__ import annotations

import numba
import numpy as np

from ambiguous_wild.splat.cpu.compile import kernel, parallel_kernel

PARTS = 8  # that the positions are cut into
_SECOND, _THIRD = np.uint64(2_654_435_761), np.uint64(805_459_861)  # Instant-NGP's; the first is 1


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
def give_back(unit, cells, d_found, d_grid):
    """Adds to d_grid [L, T, 2]; a level is one thread's, so that sums keep their order."""
    for level in numba.prange(d_grid.shape[0]):
        keys, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(unit.shape[0]):
            _corners(unit[n, 0], unit[n, 1], unit[n, 2], cells[level], d_grid.shape[1], keys, weights)
            first, second = d_found[n, 2 * level], d_found[n, 2 * level + 1]
            for corner in range(8):
                d_grid[level, keys[corner], 0] += weights[corner] * first
                d_grid[level, keys[corner], 1] += weights[corner] * second
