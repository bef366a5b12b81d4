"""Which Gaussians are drawn in which tile, front to back, and which blocks of pixels of a tile they can
reach.

Visible Gaussians are sorted by depth once, then by tile in a counting sort. The tile test is exact
(AccuTile of Speedy-Splat): for each row of tiles it finds the interval of x that the 1/255 contour reaches
among the pixel centres of that row. Every loop splits into a fixed number of parts, so the lists do not
depend on the number of threads.

A tile's pixels lie in memory as blocks of 4 x 4, each one vector. Most Gaussians are a few pixels wide: for
the 32 000 of a trained capture at 240 px, 185 000 blocks of 4 x 4 hold a pixel that is drawn, but 208 000 of
8 x 2 and 290 000 rows of 16.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from ambiguous_wild.splat.cpu.compile import kernel, parallel_kernel
from ambiguous_wild.splat.cpu.project import (
    CHUNK,
    DEPTH,
    EXTENT_X,
    EXTENT_Y,
    HALF_WIDTH,
    MX,
    MY,
    RECORD,
    SLANT,
    VARIANCE_X,
    VARIANCE_Y,
)
from ambiguous_wild.splat.cpu.simd import ceiling, floor, prefetch

TILE = 16  # px, width and height; a row of a tile is one vector
PARTS = 16  # work items of the parallel loops over ranks
SPAN_ROWS = 3  # rows of tiles whose spans are stored between the two passes; few Gaussians reach more
SPANS = 2 + 2 * SPAN_ROWS  # int16 values of a Gaussian: first and last row, first and last column of each row
_AHEAD = 8  # ranks between a record that is used and one that is prefetched; records lie in another order
_SLACK = 1e-3  # px, so that float32 rounding loses no pixel; the alpha test decides
PIXELS = TILE * TILE
SIDE = 4  # px, width and height of a block
BLOCK = SIDE * SIDE
ACROSS = TILE // SIDE  # blocks along a side of a tile; block b lies in row b // 4 and column b % 4


@kernel
def visible_slots(ids, counts):
    """Return the slots of the records in use, in the order of their Gaussians."""
    total = 0
    for chunk in range(counts.shape[0]):
        total += counts[chunk]
    slots = np.empty(total, np.int32)
    k = 0
    for chunk in range(counts.shape[0]):
        for slot in range(chunk * CHUNK, chunk * CHUNK + counts[chunk]):
            if ids[slot] >= 0:
                slots[k] = slot
                k += 1
    return slots[:k]


@kernel
def depth_order(slots, record_bits):
    """Sort the slots by depth, stably: a radix sort of the float bits, 11 bits a pass.

    Args:
        slots: [M] int32.
        record_bits: [N, RECORD] uint32, a view of the records: a view made here takes 1.5 s to compile.
    """
    n = slots.shape[0]
    keys = np.empty(n, np.uint32)
    hist = np.zeros((3, 2048), np.int64)
    for i in range(n):
        key = record_bits[slots[i], DEPTH]
        keys[i] = key
        hist[0, key & 2047] += 1
        hist[1, (key >> 11) & 2047] += 1
        hist[2, key >> 22] += 1
    source_keys, source = keys, slots.copy()
    target_keys, target = np.empty_like(keys), np.empty_like(slots)
    for step in range(3):
        total = 0
        for b in range(2048):
            count = hist[step, b]
            hist[step, b] = total
            total += count
        shift = np.uint32(11 * step)
        for i in range(n):
            key = source_keys[i]
            b = (key >> shift) & np.uint32(2047)
            at = hist[step, b]
            hist[step, b] = at + 1
            target_keys[at] = key
            target[at] = source[i]
        source_keys, target_keys = target_keys, source_keys
        source, target = target, source
    return source


@kernel
def first_pixel(border, size):
    """Return the first pixel whose centre is not before `border`: at least 0, past the end if none."""
    # bounded before conversion to an integer: for a distant centre, centre - extent can round to any value
    return ceiling(min(max(border - 0.5 - _SLACK, 0.0), size + TILE))


@kernel
def last_pixel(border, size):
    """Return the last pixel whose centre is not behind `border`: at most size - 1, negative if none."""
    return floor(max(min(border - 0.5 + _SLACK, size - 1.0), -1.0))


@kernel
def tile_rows(record, height):
    """Return the first and last row of tiles with a pixel centre within the contour's y extent."""
    low = first_pixel(record[MY] - record[EXTENT_Y], height)
    high = last_pixel(record[MY] + record[EXTENT_Y], height)
    return int(low) // TILE, int(high) // TILE


@kernel
def tile_span(record, row, width):
    """Return the first and last tile column that the contour reaches in a row; last < first if none.

    Over a band of y the right border of an ellipse is largest at its rightmost point if that lies in
    the band, else at the band's edge nearest to it; the left border is its mirror image.
    """
    low = first_pixel(record[MX] - record[EXTENT_X], width)
    high = last_pixel(record[MX] + record[EXTENT_X], width)
    if low > high:
        return 1, 0
    if int(low) // TILE == int(high) // TILE:  # a single column cannot be narrowed
        return int(low) // TILE, int(high) // TILE
    ex = np.float64(record[EXTENT_X])
    ey = np.float64(record[EXTENT_Y])
    tilt = record[SLANT] * record[VARIANCE_Y] / record[VARIANCE_X] * ex  # y of the rightmost point
    top = max(row * TILE + 0.5 - record[MY], -ey)
    bottom = min(row * TILE + TILE - 0.5 - record[MY], ey)
    right = ex
    left = -ex
    if not (top <= tilt <= bottom):
        dy = min(max(tilt, top), bottom)
        rest = max(1.0 - (dy / ey) * (dy / ey), 0.0)
        right = record[SLANT] * dy + record[HALF_WIDTH] * math.sqrt(rest)
    if not (top <= -tilt <= bottom):
        dy = min(max(-tilt, top), bottom)
        rest = max(1.0 - (dy / ey) * (dy / ey), 0.0)
        left = record[SLANT] * dy - record[HALF_WIDTH] * math.sqrt(rest)
    low = first_pixel(record[MX] + left, width)
    high = last_pixel(record[MX] + right, width)
    if low > high:
        return 1, 0
    return int(low) // TILE, int(high) // TILE


@parallel_kernel
def count_tiles(order, records, width, height, columns, instances, histogram, spans):
    """Count the tiles of each slot, and for each part the ranks in each tile.

    Args:
        order: [M] int32 slots by depth.
        instances: [N] int32 out, number of tiles of each slot.
        histogram: [PARTS, tiles] int32 out, number of ranks.
        spans: [M, SPANS] int16 out, rows and columns of each rank.
    """
    n = order.shape[0]
    for part in numba.prange(PARTS):
        histogram[part, :] = 0
        for rank in range(part * n // PARTS, (part + 1) * n // PARTS):
            prefetch(records, order[min(rank + _AHEAD, n - 1)] * RECORD)
            record = records[order[rank]]
            first, last = tile_rows(record, height)
            spans[rank, 0] = first
            spans[rank, 1] = last
            total = 0
            for row in range(first, last + 1):
                low, high = tile_span(record, row, width)
                at = 2 + 2 * (row - first)
                if at < SPANS:
                    spans[rank, at] = low
                    spans[rank, at + 1] = high
                total += max(high - low + 1, 0)
                for column in range(low, high + 1):
                    histogram[part, row * columns + column] += 1
            instances[order[rank]] = total


@kernel
def prefix(slots, instances, offsets, histogram, starts):
    """Sum exclusively: offsets of each slot's instances, starts of tiles, cursors of the parts in them."""
    total = 0
    for k in range(slots.shape[0]):
        offsets[slots[k]] = total
        total += instances[slots[k]]
    at = 0
    for tile in range(histogram.shape[1]):
        starts[tile] = at
        for part in range(histogram.shape[0]):
            count = histogram[part, tile]
            histogram[part, tile] = at
            at += count
    starts[histogram.shape[1]] = at


@parallel_kernel
def scatter(order, records, width, columns, spans, offsets, histogram, tile_slots, tile_instances):
    """Write each tile's list: the record's slot, and the number of the instance.

    Instances are numbered in the order of the slots, so that `reverse` reads its rows one after the other.
    """
    n = order.shape[0]
    for part in numba.prange(PARTS):
        for rank in range(part * n // PARTS, (part + 1) * n // PARTS):
            slot = order[rank]
            instance = offsets[slot]
            first, last = spans[rank, 0], spans[rank, 1]
            for row in range(first, last + 1):
                at = 2 + 2 * (row - first)
                if at < SPANS:
                    low, high = np.int64(spans[rank, at]), np.int64(spans[rank, at + 1])
                else:
                    low, high = tile_span(records[slot], row, width)
                for column in range(low, high + 1):
                    tile = row * columns + column
                    at = histogram[part, tile]
                    histogram[part, tile] = at + 1
                    tile_slots[at] = slot
                    tile_instances[at] = instance
                    instance += 1


@kernel
def in_tile(x, y):
    """Return the index of pixel (x, y) of a tile in its planes: block after block, each row by row."""
    return ((y // SIDE) * ACROSS + x // SIDE) * BLOCK + (y % SIDE) * SIDE + x % SIDE


@kernel
def aligned_planes(count):
    """Return zeros [count, 256] float32 that start on a cache line: a block across two lines costs twice."""
    room = np.zeros(count * PIXELS + BLOCK, np.float32)
    start = (-room.ctypes.data % (4 * BLOCK)) // 4
    return room[start : start + count * PIXELS].reshape(count, PIXELS)


@kernel
def pixel_centres():
    """Return x and y [256] of the pixel centres of a tile, in the order of its planes."""
    planes = aligned_planes(2)
    x_centres, y_centres = planes[0], planes[1]
    for y in range(TILE):
        for x in range(TILE):
            x_centres[in_tile(x, y)] = np.float32(x) + np.float32(0.5)
            y_centres[in_tile(x, y)] = np.float32(y) + np.float32(0.5)
    return x_centres, y_centres


@kernel
def _block_range(middle, extent):
    """Return the first block, and one past the last, with pixel centres within `extent` of `middle`."""
    low = ceiling(middle - extent - np.float32(0.501))
    high = floor(middle + extent - np.float32(0.499))
    return np.int64(max(low, 0)) // SIDE, np.int64(min(high, TILE - 1)) // SIDE + 1


@kernel
def candidates(record, mx, my):
    """Return the blocks that the contour's box reaches, as bits; (mx, my) is the centre in the tile."""
    left, right = _block_range(mx, record[EXTENT_X])
    low, high = _block_range(my, record[EXTENT_Y])
    if left >= right or low >= high:
        return np.int64(0)
    columns = ((1 << right) - (1 << left)) * 0x1111
    return np.int64(columns & ((1 << (ACROSS * high)) - (1 << (ACROSS * low))))
