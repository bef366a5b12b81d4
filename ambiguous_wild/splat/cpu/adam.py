"""Adam's arithmetic in sixteen lanes, one definition for every row, seen or not.

A row nobody sees has gradient zero: its moments decay and it moves on momentum alone. Both the dense step
and the postponed one run `_advance`, so that postponing changes no bit.
"""

from __future__ import annotations

import numba
import numpy as np

from ambiguous_wild.splat.cpu.compile import kernel, parallel_kernel
from ambiguous_wild.splat.cpu.simd import (
    any_lane,
    fma,
    load,
    load_some,
    magnitude,
    select,
    splat,
    square_root,
    store,
    store_some,
)

# Denormal numbers cost a hundred cycles an operation and move nothing: at |m| < 1e-30 a step is below
# 1e-15 of the learning rate even if v is 0 and only eps = 1e-15 is left below the line.
_TINY_M = np.float32(1e-30)
_TINY_V = np.float32(1.2e-38)


@kernel
def _moments(m, v, g, beta1, rest1, beta2, rest2):
    m = fma(g, rest1, m * beta1)
    v = fma(g * g, rest2, v * beta2)
    return select(magnitude(m) >= _TINY_M, m, np.float32(0.0)), select(v >= _TINY_V, v, np.float32(0.0))


@kernel
def _change(m, v, rate, root, eps):
    """rate m / (sqrt(v) root + eps), with rate = lr / bias1 and root = 1 / sqrt(bias2)."""
    return m * rate / fma(square_root(v), root, eps)


@kernel
def _read(array, at, count):
    """Up to 16 values; sixteen without a mask: the step took 0.6 ms with masks, 0.3 without."""
    return load(array, at) if count == 16 else load_some(array, at, count)


@kernel
def _write(array, at, value, count):
    """Up to 16 values, as `_read`."""
    if count == 16:
        store(array, at, value)
    else:
        store_some(array, at, value, count)


@kernel
def _dense_range(begin, end, p, m, v, g, rate, root, beta1, rest1, beta2, rest2, eps):
    """One step of values begin .. end - 1 of flat arrays."""
    for at in range(begin, end, 16):
        count = min(16, end - at)
        mean, square = _moments(
            _read(m, at, count), _read(v, at, count), _read(g, at, count), beta1, rest1, beta2, rest2
        )
        _write(m, at, mean, count)
        _write(v, at, square, count)
        _write(p, at, _read(p, at, count) - _change(mean, square, rate, root, eps), count)


@kernel
def _dense_part(part, parts, p, m, v, g, rate, root, beta1, rest1, beta2, rest2, eps):
    """The part-th of `parts` slices of a flat array, one step."""
    blocks = (p.shape[0] + 15) // 16
    begin = part * blocks // parts * 16
    end = min((part + 1) * blocks // parts * 16, p.shape[0])
    _dense_range(begin, end, p, m, v, g, rate, root, beta1, rest1, beta2, rest2, eps)


@parallel_kernel
def dense(p, m, v, g, rate, root, beta1, rest1, beta2, rest2, eps, parts):
    """One step of a flat array."""
    for part in numba.prange(parts):
        _dense_part(part, parts, p, m, v, g, rate, root, beta1, rest1, beta2, rest2, eps)


@kernel
def _advance(p, m, v, at, count, first, last, rates, roots, beta1, rest1, beta2, rest2, eps):
    """Steps first .. last - 1 with gradient zero for up to 16 values from flat index `at`."""
    value = _read(p, at, count)
    mean = _read(m, at, count)
    square = _read(v, at, count)
    zero = splat(np.float32(0.0))
    moving = any_lane(magnitude(mean) > np.float32(0.0))
    for k in range(first, last):
        mean, square = _moments(mean, square, zero, beta1, rest1, beta2, rest2)
        if moving:
            change = _change(mean, square, rates[k], roots[k], eps)
            value = value - change
            # The change shrinks by beta1 / sqrt(beta2) a step: once a thousand times it would be lost in
            # rounding, later ones are too, unless the rate rises a thousandfold.
            if k & 7 == 7:
                far = magnitude(change) * np.float32(1024.0)
                moving = any_lane(magnitude(value + far - value) > np.float32(0.0)) or any_lane(
                    magnitude(value - far - value) > np.float32(0.0)
                )
    _write(p, at, value, count)
    _write(m, at, mean, count)
    _write(v, at, square, count)


@kernel
def _row_catch_up(row, width, p, m, v, last, now, rates, roots, beta1, rest1, beta2, rest2, eps):
    if last[row] < now:
        for at in range(row * width, row * width + width, 16):
            count = min(16, row * width + width - at)
            _advance(p, m, v, at, count, last[row], now, rates, roots, beta1, rest1, beta2, rest2, eps)
        last[row] = now


@parallel_kernel
def catch_up(rows, width, p, m, v, last, now, rates, roots, beta1, rest1, beta2, rest2, eps, parts):
    """Bring rows up to step `now`; last[row] counts a row's steps, the flat arrays hold `width` a row."""
    n = rows.shape[0]
    for part in numba.prange(parts):
        for k in range(part * n // parts, (part + 1) * n // parts):
            _row_catch_up(rows[k], width, p, m, v, last, now, rates, roots, beta1, rest1, beta2, rest2, eps)


@parallel_kernel
def catch_up_all(width, p, m, v, last, now, rates, roots, beta1, rest1, beta2, rest2, eps, parts):
    """`catch_up` of every row."""
    n = last.shape[0]
    for part in numba.prange(parts):
        for row in range(part * n // parts, (part + 1) * n // parts):
            _row_catch_up(row, width, p, m, v, last, now, rates, roots, beta1, rest1, beta2, rest2, eps)


@parallel_kernel
def sparse(visible, width, p, m, v, g, last, now, rates, roots, beta1, rest1, beta2, rest2, eps, parts):
    """Step `now` (counted from 0) of the visible rows with their gradient; the others are left for later."""
    n = visible.shape[0]
    for part in numba.prange(parts):
        row = part * n // parts
        stop = (part + 1) * n // parts
        while row < stop:
            begin = row
            while row < stop and visible[row]:
                _row_catch_up(row, width, p, m, v, last, now, rates, roots, beta1, rest1, beta2, rest2, eps)
                last[row] = now + 1
                row += 1
            # neighbours in one go: a row alone ends in a vector that is not full
            tail = (rates[now], roots[now], beta1, rest1, beta2, rest2, eps)
            _dense_range(begin * width, row * width, p, m, v, g, *tail)
            row += 1
