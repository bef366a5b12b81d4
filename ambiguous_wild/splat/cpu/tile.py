"""A tile's pixels in memory: blocks of 4 x 4, each one vector, and the blocks a Gaussian can reach.

Most Gaussians are a few pixels wide: of the 32 000 of a trained capture at 240 px, 185 000 blocks of 4 x 4
hold a pixel that is drawn, but 208 000 of 8 x 2 and 290 000 rows of 16.
"""

from __future__ import annotations

import math

import numpy as np

from ambiguous_wild.splat.cpu.bins import TILE
from ambiguous_wild.splat.cpu.compile import kernel
from ambiguous_wild.splat.cpu.project import EXTENT_X, EXTENT_Y

PIXELS = TILE * TILE
SIDE = 4  # px, both ways, of a block
BLOCK = SIDE * SIDE
ACROSS = TILE // SIDE  # blocks of a tile, both ways; block b lies in row b // 4 and column b % 4 of them


@kernel
def in_tile(x, y):
    """Where pixel (x, y) of a tile stands in its planes: block after block, each row by row."""
    return ((y // SIDE) * ACROSS + x // SIDE) * BLOCK + (y % SIDE) * SIDE + x % SIDE


@kernel
def aligned_planes(count):
    """[count, 256] float32 zeros that start on a cache line: a block that lies across two costs twice."""
    room = np.zeros(count * PIXELS + BLOCK, np.float32)
    start = (-room.ctypes.data % (4 * BLOCK)) // 4
    return room[start : start + count * PIXELS].reshape(count, PIXELS)


@kernel
def pixel_centres():
    """x and y [256] of the pixel centres of a tile, in the order of its planes."""
    planes = aligned_planes(2)
    x_centres, y_centres = planes[0], planes[1]
    for y in range(TILE):
        for x in range(TILE):
            x_centres[in_tile(x, y)] = np.float32(x) + np.float32(0.5)
            y_centres[in_tile(x, y)] = np.float32(y) + np.float32(0.5)
    return x_centres, y_centres


@kernel
def _block_range(middle, extent):
    """First and one past the last block, along one axis, with pixel centres within `extent` of `middle`."""
    low = math.ceil(middle - extent - np.float32(0.501))
    high = math.floor(middle + extent - np.float32(0.499))
    return np.int64(max(low, 0)) // SIDE, np.int64(min(high, TILE - 1)) // SIDE + 1


@kernel
def candidates(record, mx, my):
    """Blocks that the box around the contour reaches, as bits; (mx, my) is the centre in the tile."""
    left, right = _block_range(mx, record[EXTENT_X])
    low, high = _block_range(my, record[EXTENT_Y])
    if left >= right or low >= high:
        return np.int64(0)
    columns = ((1 << right) - (1 << left)) * 0x1111
    return np.int64(columns & ((1 << (ACROSS * high)) - (1 << (ACROSS * low))))
