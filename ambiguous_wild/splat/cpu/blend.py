"""Blending, tile by tile and sixteen pixels at a time, and its backward pass.

Forward: Gaussians are blended front to back, with the state of a tile in the first-level cache; the blocks of
4 x 4 pixels in which a Gaussian was drawn are noted. Backward: back to front, only through the noted blocks.
The transmittance is recovered by a division by 1 - alpha, which is never below 0.01, so its relative error
stays that of the forward product, and the light from behind is a sum without cancellation. Each (tile,
Gaussian) writes one row of sums; `reverse.py` adds the rows of a Gaussian in a fixed order.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from ambiguous_wild.splat.cpu.bins import (
    BLOCK,
    PIXELS,
    TILE,
    aligned_planes,
    candidates,
    in_tile,
    pixel_centres,
)
from ambiguous_wild.splat.cpu.compile import kernel, parallel_kernel
from ambiguous_wild.splat.cpu.project import (
    BLUE,
    CURVE_X,
    CURVE_Y,
    DEPTH,
    GREEN,
    LOG2_OPACITY,
    MX,
    MY,
    RECORD,
    RED,
    SLANT,
)
from ambiguous_wild.splat.cpu.simd import (
    any_lane,
    exp2,
    fma,
    load,
    magnitude,
    negated_magnitude,
    prefetch,
    select,
    splat,
    store,
    sum_lanes,
    trailing_zeros,
)

MAX_ALPHA = np.float32(0.99)
STOP = np.float32(1e-4)  # a Gaussian that would lower the transmittance to this or less is not drawn
LOG2_MIN_ALPHA = np.float32(-math.log2(255.0))
# Entries of a list between the one that is blended and the one whose record is prefetched: records lie in the
# order of the Gaussians, and waiting for one takes longer than blending it (backward 2.6 ms instead of 5.7).
AHEAD = 6
_ZERO = np.float32(0.0)
_ONE = np.float32(1.0)

# Columns of a row of sums: h = e dL/dalpha where nothing is clamped, u and dy as in project.py.
SUM_H, SUM_U, SUM_UU, SUM_Y, SUM_UY, SUM_YY, SUM_RED, SUM_GREEN, SUM_BLUE, SUM_DEPTH = range(10)
EXTRA_U, EXTRA_Y, ABS_U, ABS_V, SUM_SQUARED, SUM_COUNT = range(10, 16)
ROW = 16


@kernel
def _forward_tile(records, slots, begin, end, left, top, width, height, centres, state, touched):
    """Blend a tile's list into `state` = (T, red, green, blue, depth, last); notes the blocks drawn.

    T is negative once the pixel has stopped, or if it lies outside the image.
    """
    transmittance, red, green, blue, depth, last = state
    x_centres, y_centres = centres
    across = np.float32(width - left)
    down = np.float32(height - top)
    open_blocks = np.int64(0)
    for at in range(0, PIXELS, BLOCK):
        inside = (load(x_centres, at) <= across) & (load(y_centres, at) <= down)
        if any_lane(inside):
            open_blocks |= 1 << (at // (BLOCK))
        store(transmittance, at, select(inside, splat(_ONE), _ZERO))
        store(red, at, splat(_ZERO))
        store(green, at, splat(_ZERO))
        store(blue, at, splat(_ZERO))
        store(depth, at, splat(_ZERO))
        store(last, at, splat(np.float32(-1.0)))
    for k in range(begin, end):
        prefetch(records, slots[min(k + AHEAD, end - 1)] * RECORD)
        record = records[slots[k]]
        index = np.float32(k - begin)
        my = record[MY] - np.float32(top)
        mx = record[MX] - np.float32(left)
        slant, curve_x, curve_y = record[SLANT], record[CURVE_X], record[CURVE_Y]
        level = record[LOG2_OPACITY]
        r, g, b, z = record[RED], record[GREEN], record[BLUE], record[DEPTH]
        blocks = candidates(record, mx, my) & open_blocks
        drawn_blocks = np.int64(0)
        while blocks != 0:
            block = trailing_zeros(blocks)
            blocks &= blocks - 1
            at = block * BLOCK
            dy = load(y_centres, at) - my
            u = load(x_centres, at) - (mx + slant * dy)
            exponent = fma(u * u, curve_x, level + curve_y * (dy * dy))
            drawn = exponent >= LOG2_MIN_ALPHA
            e = exp2(exponent)
            alpha = select(drawn, select(e <= MAX_ALPHA, e, MAX_ALPHA), _ZERO)
            before = load(transmittance, at)
            weight = before * alpha
            after = before - weight
            live = after > STOP
            if not any_lane(live):
                open_blocks &= ~(1 << block)
            seen = live & drawn
            drawn_blocks |= np.int64(any_lane(seen)) << block
            weight = select(live, weight, _ZERO)
            store(transmittance, at, select(live, after, negated_magnitude(before)))
            store(red, at, fma(weight, r, load(red, at)))
            store(green, at, fma(weight, g, load(green, at)))
            store(blue, at, fma(weight, b, load(blue, at)))
            store(depth, at, fma(weight, z, load(depth, at)))
            store(last, at, select(seen, index, load(last, at)))
        touched[k] = drawn_blocks
        if open_blocks == 0:
            touched[k + 1 : end] = 0
            return


@kernel
def _forward_worker(
    worker, records, tile_slots, starts, tile_order, workers, width, height, background, image, alpha,
    depth, kept, touched,
):  # fmt: skip
    columns = (width + TILE - 1) // TILE
    room = aligned_planes(6)
    state = (room[0], room[1], room[2], room[3], room[4], room[5])
    centres = pixel_centres()
    for position in range(worker, tile_order.shape[0], workers):
        tile = tile_order[position]
        top = tile // columns * TILE
        left = tile % columns * TILE
        _forward_tile(
            records, tile_slots, starts[tile], starts[tile + 1], left, top, width, height, centres, state,
            touched,
        )  # fmt: skip
        for at in range(PIXELS):  # copies of slices take 1.5 s to compile, for the text of their errors
            kept[tile, 0, at] = state[0][at]
            kept[tile, 1, at] = state[5][at]
        across = min(TILE, width - left)
        for y in range(min(TILE, height - top)):
            for x in range(across):
                at = in_tile(x, y)
                through = abs(state[0][at])
                image[top + y, left + x, 0] = state[1][at] + through * background[0]
                image[top + y, left + x, 1] = state[2][at] + through * background[1]
                image[top + y, left + x, 2] = state[3][at] + through * background[2]
                alpha[top + y, left + x] = _ONE - through
                depth[top + y, left + x] = state[4][at]


@parallel_kernel
def forward(
    records, tile_slots, starts, tile_order, workers, width, height, background, image, alpha, depth, kept,
    touched,
):  # fmt: skip
    """Blend every tile.

    Args:
        records: [N, 16].
        tile_slots: [I] int32, lists of the tiles.
        starts: [tiles + 1] int64.
        tile_order: [tiles] int32, longest list first; worker i takes every `workers`-th from the i-th.
        background: [3] float32.
        image, alpha, depth: [H, W, 3], [H, W], [H, W] out.
        kept: [tiles, 2, 256] float32 out, in the order of `in_tile`: final transmittance (sign: see
            `_forward_tile`), last index drawn.
        touched: [I] uint16 out: blocks of the tile in which each entry of the lists was drawn, as bits.
    """
    for worker in numba.prange(workers):
        _forward_worker(
            0 + worker, records, tile_slots, starts, tile_order, workers, width, height, background, image,
            alpha, depth, kept, touched,
        )  # fmt: skip


@kernel
def _backward_tile(
    records, slots, instances, begin, end, top, left, centres, touched, planes, extra, with_extra, with_depth,
    absolute, tally, sums,
):  # fmt: skip
    """Walk a tile's list back to front; planes = (T, last, behind, cotangents of red, green, blue,
    alpha, depth). `extra` = (behind, red, green, blue) of the second cotangent. If one of `with_extra`,
    `with_depth`, `absolute` and `tally` is None, its code is not compiled.
    """
    transmittance, last, behind, d_red, d_green, d_blue, d_alpha, depths = planes
    x_centres, y_centres = centres
    zero = splat(_ZERO)
    for k in range(end - 1, begin - 1, -1):
        ahead = max(k - AHEAD, begin)
        prefetch(records, slots[ahead] * RECORD)
        prefetch(sums, instances[ahead] * ROW)
        blocks = np.int64(touched[k])
        if blocks == 0:
            store(sums, instances[k] * ROW, zero)
            continue
        record = records[slots[k]]
        index = np.float32(k - begin)
        my = record[MY] - np.float32(top)
        mx = record[MX] - np.float32(left)
        slant, curve_x, curve_y = record[SLANT], record[CURVE_X], record[CURVE_Y]
        level = record[LOG2_OPACITY]
        r, g, b, z = record[RED], record[GREEN], record[BLUE], record[DEPTH]
        s_h = zero
        s_u = zero
        s_uu = zero
        s_y = zero
        s_uy = zero
        s_yy = zero
        s_red = zero
        s_green = zero
        s_blue = zero
        s_depth = zero
        x_u = zero
        x_y = zero
        a_u = zero
        a_v = zero
        squares = zero
        pixels = zero
        while blocks != 0:
            at = trailing_zeros(blocks) * BLOCK
            blocks &= blocks - 1
            dy = load(y_centres, at) - my
            u = load(x_centres, at) - (mx + slant * dy)
            exponent = fma(u * u, curve_x, level + curve_y * (dy * dy))
            drawn = (exponent >= LOG2_MIN_ALPHA) & (load(last, at) >= index)
            e = exp2(exponent)
            free = e <= MAX_ALPHA
            alpha = select(drawn, select(free, e, MAX_ALPHA), _ZERO)
            inverse = _ONE / (_ONE - alpha)
            before = load(transmittance, at) * inverse
            weight = before * alpha
            store(transmittance, at, before)
            h_scale = select(drawn & free, e, _ZERO)

            red = load(d_red, at)
            green = load(d_green, at)
            blue = load(d_blue, at)
            shade = fma(red, r, fma(green, g, fma(blue, b, load(d_alpha, at))))
            if with_depth is not None:
                d_depth = load(depths, at)
                shade = fma(d_depth, z, shade)
                s_depth = fma(weight, d_depth, s_depth)
            hidden = load(behind, at)
            h = h_scale * (before * shade - hidden * inverse)
            store(behind, at, fma(weight, shade, hidden))
            if absolute is not None:
                hu_main = h * u
                a_u = a_u + magnitude(hu_main)
                # dsigma/dv without constants, by which `reverse` multiplies the sum
                a_v = a_v + magnitude(fma(hu_main, curve_x * slant, h * (dy * -curve_y)))
            if tally is not None:
                hu_one = h * u
                # as above, and dsigma/du without the same constants
                along_u = hu_one * curve_x
                along_v = fma(hu_one, curve_x * slant, h * (dy * -curve_y))
                squares = squares + fma(along_u, along_u, along_v * along_v)
                pixels = pixels + select(drawn, _ONE, _ZERO)
            if with_extra is not None:
                red2 = load(extra[1], at)
                green2 = load(extra[2], at)
                blue2 = load(extra[3], at)
                shade2 = fma(red2, r, fma(green2, g, blue2 * b))
                hidden2 = load(extra[0], at)
                h2 = h_scale * (before * shade2 - hidden2 * inverse)
                store(extra[0], at, fma(weight, shade2, hidden2))
                x_u = fma(h2, u, x_u)
                x_y = fma(h2, dy, x_y)
                h = h + h2
                red = red + red2
                green = green + green2
                blue = blue + blue2
            hu = h * u
            s_h = s_h + h
            s_u = s_u + hu
            s_uu = fma(hu, u, s_uu)
            s_y = fma(h, dy, s_y)
            s_uy = fma(hu, dy, s_uy)
            s_yy = fma(h, dy * dy, s_yy)
            s_red = fma(weight, red, s_red)
            s_green = fma(weight, green, s_green)
            s_blue = fma(weight, blue, s_blue)
        row = sum_lanes(
            (
                s_h, s_u, s_uu, s_y, s_uy, s_yy, s_red, s_green, s_blue, s_depth, x_u, x_y, a_u, a_v,
                squares, pixels,
            )
        )  # fmt: skip
        store(sums, instances[k] * ROW, row)


@kernel
def _backward_worker(
    worker, records, tile_slots, tile_instances, starts, tile_order, workers, width, height, background, kept,
    touched, d_image, d_alpha, d_depth, d_extra, absolute, tally, sums,
):  # fmt: skip
    columns = (width + TILE - 1) // TILE
    room = aligned_planes(12)
    planes = (room[0], room[1], room[2], room[3], room[4], room[5], room[6], room[7])
    extra = (room[8], room[9], room[10], room[11])
    centres = pixel_centres()
    for position in range(worker, tile_order.shape[0], workers):
        tile = tile_order[position]
        top = tile // columns * TILE
        left = tile % columns * TILE
        rows = min(TILE, height - top)
        across = min(TILE, width - left)
        if rows < TILE or across < TILE:
            # Pixels outside the picture have weight 0; 0 times a value is 0 only if the value is finite.
            room[:] = _ZERO
        for at in range(PIXELS):
            planes[0][at] = abs(kept[tile, 0, at])
            planes[1][at] = kept[tile, 1, at]
        for y in range(rows):
            for x in range(across):
                at = in_tile(x, y)
                red = d_image[top + y, left + x, 0]
                green = d_image[top + y, left + x, 1]
                blue = d_image[top + y, left + x, 2]
                planes[3][at] = red
                planes[4][at] = green
                planes[5][at] = blue
                shade = red * background[0] + green * background[1] + blue * background[2]
                planes[2][at] = planes[0][at] * shade
                if d_alpha is not None:
                    planes[6][at] = d_alpha[top + y, left + x]
                if d_depth is not None:
                    planes[7][at] = d_depth[top + y, left + x]
                if d_extra is not None:
                    red = d_extra[top + y, left + x, 0]
                    green = d_extra[top + y, left + x, 1]
                    blue = d_extra[top + y, left + x, 2]
                    extra[1][at] = red
                    extra[2][at] = green
                    extra[3][at] = blue
                    shade = red * background[0] + green * background[1] + blue * background[2]
                    extra[0][at] = planes[0][at] * shade
        _backward_tile(
            records, tile_slots, tile_instances, starts[tile], starts[tile + 1], top, left,
            centres, touched, planes, extra, d_extra, d_depth, absolute, tally, sums,
        )  # fmt: skip


@parallel_kernel
def backward(
    records, tile_slots, tile_instances, starts, tile_order, workers, width, height, background, kept,
    touched, d_image, d_alpha, d_depth, d_extra, absolute, tally, sums,
):  # fmt: skip
    """Write the row of sums of every (tile, Gaussian).

    Args:
        d_image: [H, W, 3]; d_alpha, d_depth: [H, W] or None; d_extra: [H, W, 3] or None.
        absolute, tally: True or None; the tally holds squared sums and pixel counts.
        sums: [I * 16] float32 out, row `tile_instances[k]` for list entry k.
        others: as in `forward`.
    """
    for worker in numba.prange(workers):
        _backward_worker(
            0 + worker, records, tile_slots, tile_instances, starts, tile_order, workers, width, height,
            background, kept, touched, d_image, d_alpha, d_depth, d_extra, absolute, tally, sums,
        )  # fmt: skip
