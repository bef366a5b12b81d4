"""Other views' evidence about the surfaces of one view, on the CPU: `MultiViewStore.query` in two kernels.

Tensors of n views times P pixels took half of the time of a mask. The results differ from those of the
tensors in the last bits of positions, so a test compares them.
"""

from __future__ import annotations

import numba
import numpy as np

from ambiguous_wild.splat.cpu.compile import inner_kernel, parallel_kernel

COLOURS = 511  # differences of colours, from -255 to 255
_EVERY = 2  # the offset of colours is measured on every second row and column
_ZERO, _ONE, _TWO, _HALF, _TINY = (np.float32(x) for x in (0.0, 1.0, 2.0, 0.5, 1e-6))


@inner_kernel
def _place(frame, x, y, depth):
    """Return where a surface is in a neighbour's frame, from -1 to 1 each way, and its depth there."""
    first = frame[0, 3] + (frame[0, 2] + frame[0, 1] * y + frame[0, 0] * x) * depth
    second = frame[1, 3] + (frame[1, 2] + frame[1, 1] * y + frame[1, 0] * x) * depth
    z = frame[2, 3] + (frame[2, 2] + frame[2, 1] * y + frame[2, 0] * x) * depth
    positive = max(z, _TINY)
    return min(max(first / positive, -_TWO), _TWO), min(max(second / positive, -_TWO), _TWO), z


@inner_kernel
def _in_pixels(place, share, size):
    """Return the coordinate of a position in a stack whose map covers a share of `size` pixels."""
    place = (place + _ONE) * share - _ONE
    return ((place + _ONE) * np.float32(size) - _ONE) * _HALF


@inner_kernel
def _is_near(stack, view, shares, place, z, depth):
    """Whether a view's map has a surface near depth z at a position; 0 = none, and NaN is near nothing."""
    height, width = stack.shape[2], stack.shape[3]
    column = np.rint(_in_pixels(place[0], shares[view, 0], width))
    row = np.rint(_in_pixels(place[1], shares[view, 1], height))
    if not (_ZERO <= column < width and _ZERO <= row < height):
        return False
    surface = stack[view, 0, np.int64(row), np.int64(column)]
    return abs(z - surface) < depth * surface and z > _ZERO


@inner_kernel
def _mixed(plane, left, top, right, bottom, u, v):
    above = plane[top, left] * (_ONE - u) + plane[top, right] * u
    below = plane[bottom, left] * (_ONE - u) + plane[bottom, right] * u
    return above * (_ONE - v) + below * v


@inner_kernel
def _read(evidences, colours, view, shares, place, out):
    """Read evidence and colours of a view bilinearly, the border replicated; colours are rounded."""
    height, width = evidences.shape[2], evidences.shape[3]
    x = min(max(_in_pixels(place[0], shares[view, 0], width), _ZERO), np.float32(width - 1))
    y = min(max(_in_pixels(place[1], shares[view, 1], height), _ZERO), np.float32(height - 1))
    left, top = np.int64(x), np.int64(y)
    right, bottom = min(left + 1, width - 1), min(top + 1, height - 1)
    u, v = x - np.float32(left), y - np.float32(top)
    out[0] = _mixed(evidences[view, 0], left, top, right, bottom, u, v)
    for channel in range(3):
        out[channel + 1] = np.rint(_mixed(colours[view, channel], left, top, right, bottom, u, v))


@inner_kernel
def _agrees(difference, offset, apart):
    """Whether two photos show the same colour, given the offset between them."""
    red, green, blue = difference[0] - offset[0], difference[1] - offset[1], difference[2] - offset[2]
    return apart <= _ZERO or abs(red) + abs(green) + abs(blue) < apart


@inner_kernel
def _middle(counts, rank):
    """Return the difference of colours at a rank."""
    for value in range(COLOURS):
        rank -= counts[value]
        if rank < 0:
            return np.float32(value - 255)
    return _ZERO


@parallel_kernel
def look_up(
    frames, x, y, depth, near, view, evidences, colours, depths, shares,
    rules, counts, evidence, same, difference, offset,
):  # fmt: skip
    """Look up the evidence of n neighbours about the surface at each pixel [h, w].

    Args:
        frames: [n, 3, 4] from rays of the view at depth 1 to the neighbours' frames, and their origin.
        x: [w] coordinates of the rays.
        y: [h].
        depth: [h, w] of the surface.
        near: [n] numbers of the neighbours.
        view: number of the view.
        evidences: [views, 1, H, W] evidence of every view.
        colours: [views, 3, H, W] uint8, of their photos.
        depths: [views, 1, H, W] depth of the surface, 0 = none.
        shares: [views, 2] share of the stack's width and height that each map covers.
        rules: relative difference of depth up to which two views see the same surface; sum of three
            differences of colour below which photos agree, 0 = not tested; ratio of agreeing pixels from
            which an offset of colours is accepted; `agreeing` and `known_by` of `MultiViewConfig`; sum of
            three differences below which a photo shows what the render shows.
        counts: [n, 3, 511] zeros.
        evidence, same, difference, offset: outputs [n, h, w], [n, h, w] bool, [n, h, w, 3], [n, 3].
    """
    height, width = depth.shape
    for k in numba.prange(frames.shape[0]):
        other, frame, read, total = near[k], frames[k], np.empty(4, np.float32), 0
        for row in range(height):
            for column in range(width):
                u, v, z = _place(frame, x[column], y[row], depth[row, column])
                same[k, row, column] = _is_near(depths, other, shares, (u, v), z, rules[0])
                if not same[k, row, column]:
                    continue
                _read(evidences, colours, other, shares, (u, v), read)
                evidence[k, row, column] = read[0]
                sampled = row % _EVERY == 0 and column % _EVERY == 0
                total += sampled
                for c in range(3):
                    away = colours[view, c, row, column] - read[c + 1]
                    difference[k, row, column, c] = away
                    if sampled:
                        counts[k, c, np.int64(away) + 255] += 1
        if total == 0 or rules[1] <= _ZERO:
            continue
        for c in range(3):
            low, high = _middle(counts[k, c], (total - 1) // 2), _middle(counts[k, c], total // 2)
            offset[k, c] = _HALF * (low + high)
        as_they_are, shifted, none = 0, 0, np.zeros(3, np.float32)
        for row in range(0, height, _EVERY):
            for column in range(0, width, _EVERY):
                if same[k, row, column]:
                    as_they_are += _agrees(difference[k, row, column], none, rules[1])
                    shifted += _agrees(difference[k, row, column], offset[k], rules[1])
        if shifted <= rules[2] * as_they_are:
            offset[k, :] = _ZERO


@parallel_kernel
def combine(
    frames, x, y, sparse, near, view, evidences, colours, render, depths, surfaces, shares, surface_shares,
    rules, least, pair, share, evidence, same, difference, offset, out,
):  # fmt: skip
    """Combine the neighbours' evidence at each pixel; that about the sparse points' surface if more see it.

    Args:
        sparse: [h, w] depth of the sparse points' surface, NaN = none; or [0, 0].
        render: [3, h, w] colours of the view's render, as `colours`.
        surfaces: [views, 1, H', W'] depth of the sparse points in every view, 0 = none.
        surface_shares: [views, 2], see `shares`.
        least: number of views that must see a surface; 0 = any.
        pair: [2, n + 1] ranks of the quantile for each number of values.
        share: [n + 1] weight of the second.
        out: [4, h, w]: evidence (NaN = nobody sees the surface), weight, coverage, confirmed; see
            `MultiViewEvidence`.

    The others are those of `look_up`, whose outputs are read.
    """
    n, height, width = evidence.shape
    for row in numba.prange(height):
        read, away, wrong = np.empty(4, np.float32), np.empty(3, np.float32), np.empty(3, np.float32)
        expected = np.empty(3, np.float32)  # difference of a photo that shows what the render shows
        values, sparse_values = np.empty(n, np.float32), np.empty(n, np.float32)
        for column in range(width):
            seen, agreed, shown = 0, 0, 0
            for c in range(3):  # of the photo from the render
                wrong[c] = colours[view, c, row, column] - render[c, row, column]
            for k in range(n):
                if same[k, row, column]:
                    values[seen] = evidence[k, row, column]
                    seen += 1
                    agreed += _agrees(difference[k, row, column], offset[k], rules[1])
                    for c in range(3):
                        expected[c] = offset[k, c] + wrong[c]
                    shown += _agrees(difference[k, row, column], expected, rules[5])
            few = seen < rules[4]
            if few and sparse.shape[0] > 0 and np.isfinite(sparse[row, column]):
                others, others_agreed, others_shown = 0, 0, 0
                for k in range(n):
                    u, v, z = _place(frames[k], x[column], y[row], sparse[row, column])
                    if _is_near(depths, near[k], shares, (u, v), z, rules[0]) or _is_near(
                        surfaces, near[k], surface_shares, (u, v), z, rules[0]
                    ):
                        _read(evidences, colours, near[k], shares, (u, v), read)
                        for c in range(3):
                            away[c] = colours[view, c, row, column] - read[c + 1]
                        sparse_values[others] = read[0]
                        others += 1
                        others_agreed += _agrees(away, offset[k], rules[1])
                        for c in range(3):
                            expected[c] = offset[k, c] + wrong[c]
                        others_shown += _agrees(away, expected, rules[5])
                if others > seen:
                    seen, agreed, shown, few = others, others_agreed, others_shown, False
                    values[:seen] = sparse_values[:seen]
            for k in range(1, seen):  # sorted, at most n values
                value, at = values[k], k
                while at > 0 and values[at - 1] > value:
                    values[at] = values[at - 1]
                    at -= 1
                values[at] = value
            middle = np.float32(np.nan)
            if seen > 0:
                below, above = values[pair[0, seen]], values[pair[1, seen]]
                middle = below + share[seen] * (above - below)
            out[0, row, column] = middle
            part = np.float32(agreed) / np.float32(max(seen, 1)) / rules[3]
            out[1, row, column] = _ONE if few else min(part, _ONE)
            out[2, row, column] = min(np.float32(seen) / np.float32(least), _ONE) if least > 0 else _ONE
            out[3, row, column] = _ONE if shown > 0 or least == 0 else _ZERO
